"""Disparity of dual pixels against depth, by rays and by waves, and the bias of a matcher calibrated on rays.

Planes and steps radiate with textures that are given over the picture, so that blurs in lenses, and not distances, are
equal for all f-numbers. The left and the right picture of a pair are from captures with different seeds: the noise of
one wave capture is common to both pictures, which pulls disparities towards zero.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsuba_plenoptic import PlenopticCamera, bank_disparity, dual_pixel, match_halves, psf_bank, render_capture

from .. import Row, at_most, case
from ..scenes.light_paths import scene_of
from ..scenes.textured import relief

FOCAL_LENGTH, FOCUS, PIXEL, HEIGHT, MEDIUM = 24.0, 400.0, 0.0014, 0.004, 1.5

WAVELENGTH = 550.0

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
    page="docs/howto/dual_pixel.md",
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
    page="docs/howto/dual_pixel.md",
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
    page="docs/howto/dual_pixel.md",
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
