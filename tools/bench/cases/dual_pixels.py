"""Dual pixels: centroids of a point's halves against the closed form and against rays traced from the scene.

The double Gauss has the focal length with which its field of 14 degrees reaches the corners of a full frame, and lenses
of 10.72 um, twice as wide as those of real cameras, so that blurs have fewer lenses.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from mitsuba_plenoptic import LensSystem, PlenopticCamera, bank_disparity, half_disparity, psf_bank

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
    z, pitch = camera.detector_distance, camera.row_pitch
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
    page="docs/guides/dual_pixel.md",
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


FOCAL_LENGTH, FOCUS, PIXEL, HEIGHT, MEDIUM = 24.0, 400.0, 0.0014, 0.004, 1.5


def camera_of(f_number: float, lenses: tuple[int, ...]) -> PlenopticCamera:
    """Return a telephone's camera with lenses of 2.8 um that are aligned to chief rays."""
    b = 1 / (1 / FOCAL_LENGTH - 1 / FOCUS)
    return PlenopticCamera(
        focal_length=FOCAL_LENGTH, aperture_radius=FOCAL_LENGTH / f_number / 2, focus_distance=FOCUS,
        mla_focal_length=HEIGHT, mla_medium=MEDIUM, mla_pitch=2 * PIXEL * b / (b + HEIGHT / MEDIUM),
        detector_width=2 * PIXEL * lenses[0], resolution=(2 * lenses[0], 2 * lenses[1]),
    )  # fmt: skip


@case(
    "dual-pixels.spreads",
    "Distances of the centroids of halves in point spreads by waves over those by rays, at a blur of 5 lenses behind "
    "the plane in focus, and the light of the waves",
    {
        "f-number": "f/{f_number:g}", "rays (lenses)": "{rays:.2f}", "waves (lenses)": "{waves:.2f}",
        "waves over rays": "{ratio:.2f}", "light": "{light:.3f}",
    },
    (at_most("off", 0.04),),
    page="docs/guides/dual_pixel.md",
    quick={"f_numbers": (1.8,)},
)  # fmt: skip
def spreads(*, f_numbers: tuple[float, ...] = (1.8, 2.8, 4.0, 8.0), blur: float = 5.0, size: int = 25) -> Iterator[Row]:
    """Compare banks of spreads on the axis; the limit is on the light that is lost."""
    for f_number in f_numbers:
        camera = camera_of(f_number, (2 * size, 2 * size))
        # Where points have this signed blur radius in lenses.
        depth = 1 / (1 / FOCUS - blur * (camera.row_pitch / (camera.aperture_radius * camera.mla_distance)))
        options = {"wavelength": WAVELENGTH, "size": size}
        banks = [psf_bank(camera, [depth], model=model, **options) for model in ("ray", "wave")]
        rays, waves = (float(bank_disparity(bank).values[0, 0]) for bank in banks)
        light = float(banks[1].sum())
        yield {
            "f_number": f_number, "rays": rays, "waves": waves, "ratio": waves / rays, "light": light,
            "off": abs(1 - light),
        }  # fmt: skip
