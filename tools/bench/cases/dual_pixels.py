"""Dual pixels: centroids of a point's halves against the closed form and against rays traced from the scene.

The double Gauss has the focal length with which its field of 14 degrees reaches the corners of a full frame, and lenses
of 10.72 um, twice as wide as those of real cameras, so that blurs have fewer lenses.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import j1

from mitsuba_plenoptic import LensSystem, PlenopticCamera, bank_disparity, half_disparity, psf_bank
from mitsuba_plenoptic.report.framing import Canvas, annotate, show

from .. import Row, at_most, case, pick

WIDTH = 0.01072
"""Width in millimetres of the pixels of a lens."""

FILLED = 0.95
"""Diameter of a micro-image over this width."""

FIELDS = {"axis": (0.0, 0.0), "edge": (16.5, 0.0), "corner": (16.5, 10.5)}
"""Positions on the detector in millimetres."""

ACROSS = 1201
"""Traced rays across the first surface."""

WAVELENGTH = 550.0


def dual(**lens: Any) -> PlenopticCamera:
    """Return a full-frame camera whose micro-images nearly fill its lenses, shifted to the chief rays."""
    size = {"detector_width": 36.0192, "resolution": (6720, 4480), "focus_distance": 3000.0}
    camera = PlenopticCamera(focal_length=85.0, **lens, **size)
    b = camera.pupil_distance
    z = FILLED * WIDTH * b / (2 * camera.pupil_radius)
    return camera.replace(mla_focal_length=z, detector_distance=z, mla_pitch=WIDTH * b / (b + z))


def cameras() -> dict[str, PlenopticCamera]:
    """Return the cameras by name."""
    return {
        "thin, f/3": dual(aperture_radius=14.0),
        "double Gauss, f/3": dual(aperture_radius=14.0, main_lens="double_gauss"),
        "double Gauss, f/8": dual(aperture_radius=85 / 16, main_lens="double_gauss"),
    }


def traced(camera: PlenopticCamera, middle: tuple[float, float], distance: float) -> tuple[float, float]:
    """Return the distance of the halves' centroids in lenses, and the left one's fraction of the light.

    Rays start at the scene's point and are followed surface by surface. Behind a microlens they meet the detector where
    its centre, moved by their slope, lies; positions are those of the pairs of pixels that they hit.
    """
    z, pitch = camera.detector_distance, camera.mla_pitch
    lens = LensSystem.of(camera, WAVELENGTH)
    start, slope, _ = lens.ray((0.0, 0.0), (middle[0] * pitch / WIDTH, middle[1] * pitch / WIDTH))
    X, Y = (float(start[i] + (distance - start[2]) * slope[i]) for i in (0, 1))
    reach = float(lens.scale) * max(surface.semi_aperture for surface in camera.prescription.surfaces)
    x, y = np.meshgrid(*[((np.arange(ACROSS) + 0.5) / ACROSS * 2 - 1) * reach] * 2)
    ahead = distance - float(lens.front)
    slopes = (X - x) / ahead, (Y - y) / ahead
    (m, _), (t, _), passes, _ = lens.through((X + 0 * x, Y + 0 * x, distance + 0 * x), slopes)
    power = passes * (1 + slopes[0] ** 2 + slopes[1] ** 2) ** -1.5
    # In pixel pairs, from the axis.
    position = ((np.floor(m / pitch) + 0.5) * pitch - z * t) / WIDTH
    index = np.floor(position)
    is_left = position - index < 0.5
    left, right = (np.average(index, weights=power * side) for side in (is_left, ~is_left))
    return float(right - left), float(np.sum(power * is_left) / power.sum())


@case(
    "dual-pixels.centroids",
    "Distance of the centroids of a defocused point's halves, against the closed form (thin) or traced rays",
    {
        "lens": "{lens}", "field": "{field}", "8R/3pi": "{half_discs:.2f}", "distance": "{found:.3f}",
        "expected": "{expected:.3f}", "off": "{off:.2%}", "light left": "{left:.3f}",
        "expected left": "{expected_left:.3f}",
    },
    (at_most("off", 0.005), at_most("off_light", 0.003)),
    page="docs/howto/dual_pixel.md",
    quick={"names": ("thin",)},
)  # fmt: skip
def centroids(*, names: tuple[str, ...] = (), distance: float = 2000.0) -> Iterator[Row]:
    """Compare the halves of point spreads on and off the axis."""
    for name, camera in pick(cameras(), names).items():
        bank = psf_bank(camera, [distance], list(FIELDS.values()), wavelength=WAVELENGTH)
        half_discs, distances = half_disparity(camera, distance), bank_disparity(bank).values[0]
        fractions = bank.isel(u=0).sum(("v", "t", "s")).values[0] / bank.sum(("v", "u", "t", "s")).values[0]
        for number, field in enumerate(FIELDS):
            middle = float(bank.x[number]), float(bank.y[number])
            value, left = float(distances[number]), float(fractions[number])
            real = camera.prescription is not None
            expected, expected_left = traced(camera, middle, distance) if real else (half_discs, 0.5)
            yield {
                "lens": name, "field": field, "half_discs": half_discs, "found": value, "expected": expected,
                "off": abs(value / expected - 1), "left": left, "expected_left": expected_left,
                "off_light": abs(left - expected_left),
            }  # fmt: skip


@case(
    "dual-pixels.light",
    "Light of a point in focus within squares of lenses by waves, and that of the Airy pattern in the same square",
    {
        "f-number": "f/{f_number:g}", "lens": "{pitch:g} µm", "lenses across": "{across}", "Airy pattern": "{airy:.3f}",
        "full_field": "{full_field:.3f}", "patch": "{patch:.3f}",
    },
    (at_most("full_field_off", 0.004), at_most("patch_off", 0.01)),
    page="docs/howto/dual_pixel.md",
    quick={"sizes": (9,), "lenses": ((2.44, 4.0),)},
)  # fmt: skip
def light(
    *,
    sizes: tuple[int, ...] = (9, 31, 121),
    lenses: tuple[tuple[float, float], ...] = ((2.44, 1.8), (2.44, 4.0)),
) -> Iterator[Row]:
    """Sum spreads of both methods behind main lenses of 6.86 mm; `lenses` are pitches in micrometres and f-numbers."""
    for pitch, f_number in lenses:
        width = 1e-3 * pitch
        camera = PlenopticCamera(
            focal_length=6.86, aperture_radius=3.43 / f_number, focus_distance=1000.0, mla_focal_length=0.0045,
            mla_medium=1.5, detector_width=200 * width, resolution=(400, 400), mla_pitch=0.999 * width,
        )  # fmt: skip
        b = camera.mla_distance
        camera = camera.replace(mla_pitch=width * b / (b + camera.reduced_distance))
        for across in sizes:
            row: dict[str, Any] = {"f_number": f_number, "pitch": pitch, "across": across}
            half = across / 2 * camera.mla_pitch * 2 * np.pi * camera.aperture_radius / (WAVELENGTH * 1e-6 * b)
            x = (np.arange(2000) + 0.5) / 2000 * half
            radius = np.hypot(x[:, None], x)
            row["airy"] = float(((2 * j1(radius) / radius) ** 2).sum()) * (half / 2000) ** 2 / np.pi
            for method in ("full_field", "patch"):
                bank = psf_bank(
                    camera, [1000.0], model="wave", wavelength=WAVELENGTH, method=method, size=across
                )  # fmt: skip
                row[method] = float(bank.sum())
                row[f"{method}_off"] = abs(row[method] - row["airy"])
            yield row


@case(
    "dual-pixels.pictures",
    "Point spreads of left (red) and right halves (blue) on and off the axis, before the plane in focus and behind it",
    {"lens": "{lens}", "lenses across": "{across}"},
    page="docs/howto/dual_pixel.md",
    quick={"names": ("thin",)},
)
def pictures(output: Path, *, names: tuple[str, ...] = (), across: int = 61) -> Iterator[Row]:
    """Draw the spreads."""
    chosen = pick(cameras(), names)
    size, gap = 1.5, 0.3
    depths = {"2 m": 2000.0, "7 m": 7000.0}
    canvas = Canvas(0.4 + 6 * (size + 0.1), 0.1 + len(chosen) * (size + gap))
    for row, (name, camera) in enumerate(chosen.items()):
        bank = psf_bank(camera, list(depths.values()), list(FIELDS.values()), wavelength=WAVELENGTH, size=across)
        for column, (depth, field) in enumerate((d, f) for d in range(2) for f in range(len(FIELDS))):
            axes = canvas.axes(0.3 + column * (size + 0.1), gap + row * (size + gap), size, size)
            title = f"{list(depths)[depth]}, {list(FIELDS)[field]}"
            show(axes, coloured(bank.values[depth, field, 0]), title, peak=1.0)
            annotate(axes, title=title, side="" if column else name)
        yield {"lens": name, "across": across}
    canvas.save(output / "halves.png")


def coloured(halves: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return left as red and right as blue, which together are white."""
    left, right = halves / np.percentile(halves[halves > 0], 99)
    return np.stack([left, np.minimum(left, right), right], axis=-1)
