"""Dual pixels: centroids of a point's halves against the closed form and against rays traced from the scene.

The double Gauss has the focal length with which its field of 14 degrees reaches the corners of a full frame, and lenses
of 10.72 um, twice as wide as those of real cameras, so that blurs have fewer lenses.

Disparity of dual pixels against depth, by rays and by waves, and the bias of a matcher calibrated on rays.

Planes and steps radiate with textures that are given over the picture, so that blurs in lenses, and not distances, are
equal for all f-numbers. The left and the right picture of a pair are from captures with different seeds: the noise of
one wave capture is common to both pictures, which pulls disparities towards zero.

Halves of dual pixels in a medium: even scenes and points by rays and by waves, against sums of rays and of waves.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.special import j1
from scipy.stats import qmc

from mitsuba_plenoptic import (
    LensSystem,
    PlenopticCamera,
    bank_disparity,
    design,
    dual_pixel,
    half_disparity,
    match_halves,
    psf_bank,
    render_capture,
)
from mitsuba_plenoptic.report.plots import Plot, annotate, show

from .. import Row, at_most, case, pick
from ..scenes.light_paths import scene_of
from ..scenes.textured import relief

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


@case(
    "dual-pixels.light",
    "Light of a point in focus within squares of lenses by waves, and that of the Airy pattern in the same square",
    {
        "f-number": "f/{f_number:g}", "lens": "{pitch:g} µm", "lenses across": "{across}", "Airy pattern": "{airy:.3f}",
        "full_field": "{full_field:.3f}", "patch": "{patch:.3f}",
    },
    (at_most("full_field_off", 0.004), at_most("patch_off", 0.01)),
    page="docs/guides/dual_pixel.md",
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
    page="docs/guides/dual_pixel.md",
    quick={"names": ("thin",)},
)
def pictures(output: Path, *, names: tuple[str, ...] = (), across: int = 61) -> Iterator[Row]:
    """Draw the spreads."""
    chosen = pick(cameras(), names)
    depths = {"2 m": 2000.0, "7 m": 7000.0}
    plot = Plot(10.0)
    panels = plot.panels(len(chosen), len(depths) * len(FIELDS))
    for row, (name, camera) in enumerate(chosen.items()):
        bank = psf_bank(camera, list(depths.values()), list(FIELDS.values()), wavelength=WAVELENGTH, size=across)
        for column, (depth, field) in enumerate((d, f) for d in range(2) for f in range(len(FIELDS))):
            axes = panels[row, column]
            title = f"{list(depths)[depth]}, {list(FIELDS)[field]}"
            show(axes, coloured(bank.values[depth, field, 0]), title, peak=1.0)
            annotate(axes, title=title, side="" if column else name)
        yield {"lens": name, "across": across}
    plot.save(output / "halves.png")


def coloured(halves: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return left as red and right as blue, which together are white."""
    left, right = halves / np.percentile(halves[halves > 0], 99)
    return np.stack([left, np.minimum(left, right), right], axis=-1)


FOCAL_LENGTH, FOCUS, PIXEL, HEIGHT, MEDIUM = 24.0, 400.0, 0.0014, 0.004, 1.5


WINDOW = 21
"""Lenses across the matcher's window."""

BLURS = (-5.0, -3.0, -1.0, 1.0, 3.0, 5.0)
"""Blur radii in lenses of the planes that calibrate, negative for those nearer than the plane in focus."""

MARGIN = WINDOW // 2 + 6
"""Lenses around a part of the picture whose light does not enter its windows."""

RAMP, STEPS = 4.5, (-4.0, 1.5, 4.5)
"""Largest blur of the tilted plane of the scene, and blurs of its steps."""

HALF_DISCS = 8 / (3 * math.pi)
"""Disparity over the radius of blur."""

Depths = Callable[[Any, Any], Any]
"""Signed blur radius as a function of positions across the picture, over half its width."""


def camera_of(f_number: float, lenses: tuple[int, ...]) -> PlenopticCamera:
    """Return a telephone's camera with lenses of 2.8 um that are aligned to chief rays."""
    b = 1 / (1 / FOCAL_LENGTH - 1 / FOCUS)
    return PlenopticCamera(
        focal_length=FOCAL_LENGTH, aperture_radius=FOCAL_LENGTH / f_number / 2, focus_distance=FOCUS,
        mla_focal_length=HEIGHT, mla_medium=MEDIUM, mla_pitch=2 * PIXEL * b / (b + HEIGHT / MEDIUM),
        detector_width=2 * PIXEL * lenses[0], resolution=(2 * lenses[0], 2 * lenses[1]),
    )  # fmt: skip


def inverse_depth(camera: PlenopticCamera, blur: Any) -> Any:
    """Return the reciprocal depth at which points have a signed blur radius in lenses."""
    return 1 / FOCUS - blur * (camera.mla_pitch / (camera.aperture_radius * camera.mla_distance))


def planes(x: Any, y: Any) -> Any:
    """Return the blurs of planes that face the camera, in two rows and three columns of the picture."""
    return np.array(BLURS)[_column(x) + 3 * (y > 0)]


def tilted_and_steps(x: Any, y: Any) -> Any:
    """Return the blurs of a tilted plane above planes with steps."""
    return np.where(y > 0, RAMP * x, np.array(STEPS)[_column(x)])


def _column(x: Any) -> Any:
    return np.clip(((x + 1) * 1.5).astype(int), 0, 2)


def parts(lenses: tuple[int, ...]) -> Iterator[tuple[slice, slice]]:
    """Yield rows and columns of the lenses of each part of a picture, without margins."""
    columns, rows = lenses
    for half in (slice(MARGIN, rows // 2 - MARGIN), slice(rows // 2 + MARGIN, rows - MARGIN)):
        for low, high in itertools.pairwise(range(0, columns + 1, columns // 3)):
            yield half, slice(low + MARGIN, high - MARGIN)


@functools.cache
def disparities(
    f_number: float, lenses: tuple[int, ...], depths: Depths, model: str, rays: int, texture: int
) -> NDArray[np.float64]:
    """Return the disparity of each part of a picture, the median; about `rays` rays of each lens pass the pupil."""
    camera = camera_of(f_number, lenses)
    half = camera.detector_width / 2

    def surface(x: Any, y: Any) -> Any:
        return inverse_depth(camera, depths(x / half, y / half))

    scene = scene_of(camera.to_sensor(), **relief(camera, surface, MARGIN, texture))
    # Of the rays of a pixel, those within the image of the pupil pass it.
    within = math.pi / 4 * (camera.micro_image_diameter / camera.mla_pitch) ** 2
    spp = rays / (4 * within)
    if model == "ray":
        pairs = [dual_pixel(render_capture(scene, model=model, spp=math.ceil(spp)))]
    else:
        # The noise of wave captures grows with the coherence width.
        options = {"wavelength": WAVELENGTH, "spp": math.ceil(spp * (f_number / 1.8) ** 1.5)}
        made = [dual_pixel(render_capture(scene, model=model, seed=seed, **options)) for seed in (0, 1)]
        pairs = [
            one.copy(data=np.stack([one.values[:, 0], other.values[:, 1]], 1)) for one, other in (made, made[::-1])
        ]
    found = np.nanmean([match_halves(pair, window=WINDOW).values for pair in pairs], axis=0)
    return np.array([np.nanmedian(found[at]) for at in parts(lenses)])


@case(
    "dual-pixels.depth",
    "Disparity of a tilted plane and of steps in depth against the curve that planes facing the camera calibrate: "
    "slope of the medians of six parts of the picture over the curve, and their residual over the largest disparity",
    {
        "f-number": "f/{f_number:g}", "model": "{model}", "disparity at blurs of -5, -1, 1, 5 lenses": "{shown}",
        "over that of half discs": "{ratio:.2f}", "slope": "{slope:.3f}", "off": "{off:.1%}",
        "residual": "{residual:.1%}",
    },
    (at_most("off", 0.03),),
    page="docs/guides/dual_pixel.md",
    quick={"f_numbers": (1.8,), "rays": 20, "lenses": (120, 80), "textures": 1},
)  # fmt: skip
def depth(
    *,
    f_numbers: tuple[float, ...] = (1.8, 2.8, 4.0, 8.0),
    rays: int = 30,
    lenses: tuple[int, ...] = (240, 160),
    textures: int = 3,
) -> Iterator[Row]:
    """Compare the disparities of a scene with the curve; about ``rays`` rays of each lens pass the pupil."""
    x, y = (np.arange(count) * 2 + 1 - count for count in lenses)
    blurs = tilted_and_steps(*np.meshgrid(x / lenses[0], y / lenses[0]))
    for f_number in f_numbers:
        for model in ("ray", "wave"):
            own = f_number, lenses
            known = np.mean([disparities(*own, planes, model, rays, number) for number in range(textures)], 0)
            found = np.mean(
                [disparities(*own, tilted_and_steps, model, rays, textures + number) for number in range(textures)], 0
            )
            curve = np.interp(blurs, BLURS, known)
            expected = np.array([float(np.median(curve[at])) for at in parts(lenses)])
            slope = float(found @ expected / (expected @ expected))
            yield {
                "f_number": f_number, "model": model, "curve": known, "found": found, "expected": expected,
                "shown": ", ".join(f"{known[BLURS.index(each)]:.2f}" for each in (-5, -1, 1, 5)),
                "ratio": float((known[-1] - known[0]) / (BLURS[-1] - BLURS[0]) / HALF_DISCS),
                "slope": slope, "off": abs(slope - 1),
                "residual": float(np.sqrt(np.mean((found - slope * expected) ** 2)) / np.abs(known).max()),
            }  # fmt: skip


@case(
    "dual-pixels.matching",
    "Depths of planes that a block matcher finds in wave pairs after calibration with ray pairs, at blurs of -5 and of "
    "5 lenses: error of the disparity, of the defocus and of the depth, and its standard deviation between textures",
    {
        "f-number": "f/{f_number:g}", "blur (lenses)": "{blur:g}", "ray disparity": "{rays:.2f}",
        "bias of waves (lenses)": "{bias:.2f} +- {deviation:.2f}", "of the defocus": "{defocus:.0%}",
        "of the depth": "{depth:.1%} +- {depth_deviation:.1%}",
    },
    page="docs/guides/dual_pixel.md",
    quick={"f_numbers": (1.8,), "rays": 20, "lenses": (120, 80), "textures": 2},
)  # fmt: skip
def matching(
    *,
    f_numbers: tuple[float, ...] = (1.8, 2.8, 4.0, 8.0),
    rays: int = 30,
    lenses: tuple[int, ...] = (240, 160),
    textures: int = 3,
) -> Iterator[Row]:
    """Read disparities of wave pairs with the mean curve of ray pairs; captures are those of the other case."""
    for f_number in f_numbers:
        camera = camera_of(f_number, lenses)
        known, waves = (
            np.array([disparities(f_number, lenses, planes, model, rays, number) for number in range(textures)])
            for model in ("ray", "wave")
        )
        mean = known.mean(0)
        read = np.array([np.interp(each, mean, BLURS) for each in waves])
        for place in (0, -1):
            blur = BLURS[place]
            depths = inverse_depth(camera, blur) / inverse_depth(camera, read[:, place]) - 1
            yield {
                "f_number": f_number, "blur": blur, "rays": mean[place],
                "bias": float(waves[:, place].mean() - mean[place]), "deviation": float(waves[:, place].std(ddof=1)),
                "defocus": float(read[:, place].mean() / blur - 1),
                "depth": float(depths.mean()), "depth_deviation": float(depths.std(ddof=1)),
            }  # fmt: skip


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
        banks = [
            psf_bank(camera, [1 / inverse_depth(camera, blur)], model=model, wavelength=WAVELENGTH, size=size)
            for model in ("ray", "wave")
        ]
        rays, waves = (float(bank_disparity(bank).values[0, 0]) for bank in banks)
        light = float(banks[1].sum())
        yield {
            "f_number": f_number, "rays": rays, "waves": waves, "ratio": waves / rays, "light": light,
            "off": abs(1 - light),
        }  # fmt: skip


LENSES = 12
"""Lenses across the recorded window."""

SAMPLES = 64
"""Samples across a lens for waves."""

AROUND = 17
"""Lenses across the window of a star's waves."""


def window(angle: float, **changes: Any) -> tuple[PlenopticCamera, tuple[float, float]]:
    """Return a telephone's camera that records lenses around a chief-ray angle in degrees, and the place of one."""
    camera = PlenopticCamera.preset("phone_quad").replace(**changes)
    width, height = camera.resolution
    across = round(camera.mla_distance * math.tan(math.radians(angle)) / camera.mla_pitch)
    camera = camera.replace(
        crop_offset=(width // 2 + 2 * across - LENSES, height // 2 - LENSES), crop_size=(2 * LENSES, 2 * LENSES)
    )
    return camera, ((across + 0.5) * camera.mla_pitch, 0.5 * camera.mla_pitch)


def left_of_even(camera: PlenopticCamera, model: str, spp: int) -> tuple[float, float]:
    """Return the part of an even scene's light in the left halves, and its light over the closed form by ideal rays."""
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "direct"}, "sky": {"type": "constant"},
        "camera": camera.to_sensor(),
    })  # fmt: skip
    wavelength = {"wavelength": WAVELENGTH} if model == "wave" else {}
    halves = dual_pixel(render_capture(scene, model=model, spp=spp, **wavelength)).values[0, :, 2:-2, 2:-2]
    left, right = halves.mean((1, 2), dtype=float)
    return left / (left + right), (left + right) / 4 / design.white_mean(camera)


def left_of_point(camera: PlenopticCamera, field: tuple[float, float], model: str) -> float:
    """Return the part of the light of a point in focus in its left half."""
    bank = psf_bank(camera, [1000.0], [field], model=model, wavelength=WAVELENGTH, size=9)
    left, right = bank.sum(("t", "s")).values.ravel()
    return float(left / (left + right))


def _through(camera: PlenopticCamera, field: tuple[float, float], count: int) -> tuple[Any, ...]:
    """Return the lens's distance from its pixels' middle, points of it, and the direction cosines of its light."""
    n, b = camera.mla_medium, camera.mla_distance
    # The chief ray's way in the medium, by Snell's law.
    height = math.hypot(*field)
    way = 0.0
    for _ in range(20):
        sine = math.sin(math.atan((height - way) / b)) / n
        way = camera.detector_distance * sine / math.sqrt(1 - sine * sine)
    shift = np.array(field) * (way / height)
    u = qmc.Sobol(4, seed=0).random(count)
    d = (u[:, :2] - 0.5) * camera.mla_pitch
    radius, angle = camera.aperture_radius * np.sqrt(u[:, 2]), 2 * np.pi * u[:, 3]
    slope = (np.array(field) - shift + d - np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)) / b
    return shift, d, slope / np.sqrt(1 + (slope**2).sum(1, keepdims=True))


def left_by_cosines(camera: PlenopticCamera, field: tuple[float, float], count: int = 2**17) -> float:
    """Return the left half's part of the light of all points of the pupil through all of a lens, ray by ray.

    The lens turns direction cosines, and Snell's law holds behind it.
    """
    shift, d, cosine = _through(camera, field, count)
    behind = (cosine - d * (camera.mla_medium / camera.mla_focal_length)) / camera.mla_medium
    landed = d - shift + camera.detector_distance * behind / np.sqrt(1 - (behind**2).sum(1, keepdims=True))
    return float((np.floor(landed[:, 0] / camera.pixel_size) % 2 == 1).mean())


def left_by_waves(camera: PlenopticCamera, field: tuple[float, float], count: int = 2**9) -> float:
    """Return the same for plane waves through the array of lenses, which are thin phases, and exact propagation."""
    shift, _, cosine = _through(camera, field, count)
    n, k = camera.mla_medium, 2e6 * math.pi / WAVELENGTH
    x = ((np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5) * camera.mla_pitch
    along = np.exp(-0.5j * k * n * x**2 / camera.mla_focal_length)
    orders = np.fft.fft2(np.outer(along, along))
    step = np.fft.fftfreq(SAMPLES, 1 / SAMPLES) * (2 * math.pi / k / camera.mla_pitch)
    # Samples move from those of the lens to those of its pixels.
    moved = np.exp(1j * k * (step[:, None] * shift[1] + step * shift[0]))
    total: NDArray[np.float64] = np.zeros(SAMPLES)
    for sx, sy in cosine:
        square = n * n - (sx + step) ** 2 - (sy + step[:, None]) ** 2
        axial = np.where(square > 0, np.exp(1j * k * camera.detector_distance * np.sqrt(np.abs(square))), 0)
        total += (np.abs(np.fft.ifft2(orders * axial * moved)) ** 2).sum(0)
    return float(total[: SAMPLES // 2].sum() / total.sum())


def left_of_star(camera: PlenopticCamera, field: tuple[float, float], count: int = 2**12) -> float:
    """Return the same for a point whose image by the main lens is a lens's centre: these waves are coherent."""
    shift, *_ = _through(camera, field, 1)
    centre = np.array(field) - shift
    n, k, pitch = camera.mla_medium, 2e6 * math.pi / WAVELENGTH, camera.mla_pitch
    u = qmc.Sobol(2, seed=0).random(count)
    radius, angle = camera.aperture_radius * np.sqrt(u[:, 0]), 2 * np.pi * u[:, 1]
    pupil = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    slope, chief = (centre - pupil) / camera.mla_distance, centre / camera.mla_distance
    cosine = slope / np.sqrt(1 + (slope**2).sum(1, keepdims=True))
    base = chief / math.sqrt(1 + chief @ chief)
    across = SAMPLES // 2
    x = ((np.arange(AROUND * across) + 0.5) / across - AROUND / 2) * pitch
    waves = [np.exp(1j * k * np.outer(x, cosine[:, axis] - base[axis])) for axis in (0, 1)]
    # Equal powers from equal areas of the pupil.
    arriving = (waves[1] * (1 - (cosine**2).sum(1))) @ waves[0].T
    inner = x - np.round(x / pitch) * pitch
    along = np.exp(-0.5j * k * n * inner**2 / camera.mla_focal_length)
    step = np.fft.fftfreq(len(x), 1 / len(x)) * (2 * math.pi / k / (AROUND * pitch))
    square = n * n - (base[0] + step) ** 2 - (base[1] + step[:, None]) ** 2
    axial = np.where(square > 0, np.exp(1j * k * camera.detector_distance * np.sqrt(np.abs(square))), 0)
    moved = np.exp(1j * k * (step[:, None] * shift[1] + step * shift[0]))
    light = (np.abs(np.fft.ifft2(np.fft.fft2(arriving * np.outer(along, along)) * axial * moved)) ** 2).sum(0)
    return float(light.reshape(AROUND, 2, -1)[:, 0].sum() / light.sum())


@case(
    "dual-pixels.medium",
    "Part of the light in the left halves of a telephone by the chief-ray angle: lenses are aligned by Snell's law",
    {
        "angle": "{angle:g}°", "ideal rays": "{ideal:.3f}", "a point": "{ideal_point:.3f}",
        "parabolic rays": "{parabolic:.3f}", "their sum": "{parabolic_sum:.3f}", "its point": "{parabolic_point:.3f}",
        "waves": "{wave:.3f}", "sum of waves": "{wave_sum:.3f}", "a star": "{wave_point:.3f}",
        "its sum": "{star_sum:.3f}", "light": "{ideal_light:.4f}, {parabolic_light:.4f}, {wave_light:.4f}",
    },
    (
        at_most("off", 0.01), at_most("off_parabolic", 0.005), at_most("off_wave", 0.005),
        at_most("off_light", 0.005),
    ),
    page="docs/theory/rays.md",
    quick={"angles": (30.0,)},
)  # fmt: skip
def medium(*, angles: tuple[float, ...] = (8.0, 20.0, 30.0, 35.0), spp: int = 16384) -> Iterator[Row]:
    """Compare the halves, and the light over that of the closed form."""
    mi.set_variant("llvm_ad_mono")
    for angle in angles:
        row: Row = {"angle": angle}
        for name in ("ideal", "parabolic"):
            camera, field = window(angle, lens_model=name)
            row[name], row[f"{name}_light"] = left_of_even(camera, "ray", spp)
            row[f"{name}_point"] = left_of_point(camera, field, "ray")
        row["parabolic_sum"] = left_by_cosines(camera, field)
        camera, field = window(angle)
        row["wave"], row["wave_light"] = left_of_even(camera, "wave", spp // 16)
        row["wave_sum"], row["wave_point"] = left_by_waves(camera, field), left_of_point(camera, field, "wave")
        row["star_sum"] = left_of_star(camera, field)
        row["off"] = max(abs(row[name] - 0.5) for name in ("ideal", "ideal_point"))
        row["off_parabolic"] = abs(row["parabolic"] - row["parabolic_sum"])
        row["off_wave"] = max(abs(row["wave"] - row["wave_sum"]), abs(row["wave_point"] - row["star_sum"]))
        row["off_light"] = max(abs(row[f"{name}_light"] - 1) for name in ("ideal", "parabolic", "wave"))
        yield row
