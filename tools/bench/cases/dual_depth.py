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

from mitsuba_plenoptic import PlenopticCamera, dual_pixel, match_halves, render_capture

from .. import Row, at_most, case
from ..scenes.light_paths import scene_of
from ..scenes.textured import relief

FOCAL_LENGTH, FOCUS, PIXEL, HEIGHT, MEDIUM = 6.0, 100.0, 0.0014, 0.004, 1.5

WAVELENGTH = 550.0

WINDOW = 21
"""Lenses across the matcher's window."""

BLURS = (-5.0, -3.0, -1.0, 0.0, 1.0, 3.0, 5.0)
"""Blur radii in lenses of the planes that calibrate, negative for those nearer than the plane in focus."""

MARGIN = WINDOW // 2 + 6
"""Lenses around a part of the picture whose light does not enter its windows."""

CALIBRATED = 96, 64
"""Lenses of a camera before the planes."""

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


def disparities(
    f_number: float, lenses: tuple[int, ...], depths: Depths, model: str, rays: int, texture: int
) -> NDArray[np.float64]:
    """Return the disparity of each lens; about `rays` rays of each lens pass the pupil."""
    camera = camera_of(f_number, lenses)
    half = camera.detector_width / 2

    def surface(x: Any, y: Any) -> Any:
        return inverse_depth(camera, depths(x / half, y / half))

    scene = scene_of(camera.to_sensor(), **relief(camera, surface, MARGIN, texture))
    # Of the rays of a pixel, those within the image of the pupil pass it.
    within = math.pi / 4 * (camera.micro_image_diameter / camera.mla_pitch) ** 2
    spp = rays / (4 * within)
    if model == "ray":
        return match_halves(dual_pixel(render_capture(scene, model=model, spp=math.ceil(spp))), window=WINDOW).values
    # The noise of wave captures grows with the coherence width.
    options = {"wavelength": WAVELENGTH, "spp": math.ceil(spp * f_number / 1.8)}
    pairs = [dual_pixel(render_capture(scene, model=model, seed=seed, **options)) for seed in (0, 1)]
    mixed = [one.copy(data=np.stack([one.values[:, 0], other.values[:, 1]], 1)) for one, other in (pairs, pairs[::-1])]
    return np.nanmean([match_halves(pair, window=WINDOW).values for pair in mixed], axis=0)


@functools.cache
def curve(f_number: float, model: str, rays: int, texture: int) -> NDArray[np.float64]:
    """Return the disparity of planes with the blurs `BLURS`: the median over the picture."""
    inner = slice(MARGIN, -MARGIN)
    return np.array(
        [
            np.nanmedian(
                disparities(f_number, CALIBRATED, lambda x, y, r=radius: r + 0 * x, model, rays, texture)[inner, inner]
            )
            for radius in BLURS
        ]
    )


RAMP, STEPS = 4.5, (-4.0, 1.5, 4.5)
"""Largest blur of the tilted plane in the upper half of the picture, and blurs of the steps in the lower half."""


def tilted_and_steps(x: Any, y: Any) -> Any:
    """Return the blur radius of a tilted plane above planes with steps."""
    step = np.clip(((x + 1) / 2 * len(STEPS)).astype(int), 0, len(STEPS) - 1)
    return np.where(y > 0, RAMP * x, np.array(STEPS)[step])


def parts(lenses: tuple[int, ...]) -> Iterator[tuple[slice, slice]]:
    """Yield the rows and columns of lenses of each step, and of thirds of the tilted plane, without their margins."""
    columns, rows = lenses
    edges = np.linspace(0, columns, len(STEPS) + 1).astype(int)
    for half in (slice(MARGIN, rows // 2 - MARGIN), slice(rows // 2 + MARGIN, rows - MARGIN)):
        for low, high in itertools.pairwise(edges):
            yield half, slice(int(low) + MARGIN, int(high) - MARGIN)


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
    page="docs/numbers.md",
    quick={"f_numbers": (1.8,), "rays": 20, "lenses": (120, 80), "textures": 1},
)  # fmt: skip
def depth(
    *,
    f_numbers: tuple[float, ...] = (1.8, 2.8, 4.0, 8.0),
    rays: int = 70,
    lenses: tuple[int, ...] = (180, 130),
    textures: int = 3,
) -> Iterator[Row]:
    """Compare the disparities of a scene with the curve; ``rays`` rays of each lens pass the pupil."""
    x, y = (np.arange(count) * 2 + 1 - count for count in lenses)
    blurs = tilted_and_steps(*np.meshgrid(x / lenses[0], y / lenses[0]))
    for f_number in f_numbers:
        for model in ("ray", "wave"):
            known = np.mean([curve(f_number, model, rays, texture) for texture in range(textures)], axis=0)
            expected = np.interp(blurs, BLURS, known)
            found = [
                disparities(f_number, lenses, tilted_and_steps, model, rays, textures + number)
                for number in range(textures)
            ]
            pairs = np.array(
                [[float(np.nanmedian(one[at])) for at in parts(lenses)] for one in (np.mean(found, 0), expected)]
            )
            slope = float(pairs[0] @ pairs[1] / (pairs[1] @ pairs[1]))
            yield {
                "f_number": f_number, "model": model, "curve": known, "parts": pairs,
                "shown": ", ".join(f"{known[BLURS.index(each)]:.2f}" for each in (-5, -1, 1, 5)),
                "ratio": float((known[-1] - known[0]) / (BLURS[-1] - BLURS[0]) / HALF_DISCS),
                "slope": slope, "off": abs(slope - 1),
                "residual": float(np.sqrt(np.mean((pairs[0] - slope * pairs[1]) ** 2)) / np.abs(known).max()),
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
    page="docs/numbers.md",
    quick={"f_numbers": (1.8,), "rays": 20, "textures": 2},
)  # fmt: skip
def matching(
    *, f_numbers: tuple[float, ...] = (1.8, 2.8, 4.0, 8.0), rays: int = 70, textures: int = 3
) -> Iterator[Row]:
    """Read disparities of wave pairs with the mean curve of ray pairs."""
    for f_number in f_numbers:
        camera = camera_of(f_number, CALIBRATED)
        known, waves = (
            np.array([curve(f_number, model, rays, texture) for texture in range(textures)])
            for model in ("ray", "wave")
        )
        mean = known.mean(0)
        read = np.interp(waves, mean, BLURS)
        for place in (0, -1):
            blur = BLURS[place]
            depths = inverse_depth(camera, blur) / inverse_depth(camera, read[:, place]) - 1
            yield {
                "f_number": f_number, "blur": blur, "rays": mean[place],
                "bias": float(waves[:, place].mean() - mean[place]), "deviation": float(waves[:, place].std(ddof=1)),
                "defocus": float(read[:, place].mean() / blur - 1),
                "depth": float(depths.mean()), "depth_deviation": float(depths.std(ddof=1)),
            }  # fmt: skip
