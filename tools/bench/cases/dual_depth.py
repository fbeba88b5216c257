"""Disparity of dual pixels against depth, by rays and by waves, and the bias of a matcher calibrated on rays.

Planes and steps radiate with textures that are given over the picture, so that blurs in lenses, and not distances, are
equal for all f-numbers. The left and the right picture of a pair are from captures with different seeds: the noise of
one wave capture is common to both pictures, which pulls disparities towards zero.
"""

from __future__ import annotations

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

MARGIN = WINDOW // 2 + 7
"""Lenses around a window whose light does not enter it: half of it, and the largest blur's radius."""

BLURS = (-6.0, -4.0, -2.0, 0.0, 2.0, 4.0, 6.0)
"""Blur radii in lenses of the planes that calibrate, negative for those nearer than the plane in focus."""

Depths = Callable[[Any, Any], Any]
"""Signed blur radius as a function of positions across the picture, from -1 to 1."""


def camera_of(f_number: float, lenses: tuple[int, ...]) -> PlenopticCamera:
    """Return a telephone's camera with lenses of 2.8 um that are aligned to chief rays."""
    b = 1 / (1 / FOCAL_LENGTH - 1 / FOCUS)
    return PlenopticCamera(
        focal_length=FOCAL_LENGTH, aperture_radius=FOCAL_LENGTH / f_number / 2, focus_distance=FOCUS,
        mla_focal_length=HEIGHT, mla_medium=MEDIUM, mla_pitch=2 * PIXEL * b / (b + HEIGHT / MEDIUM),
        detector_width=2 * PIXEL * lenses[0], resolution=(2 * lenses[0], 2 * lenses[1]),
    )  # fmt: skip


def disparities(
    camera: PlenopticCamera, depths: Depths, model: str, rays: int, texture: int
) -> NDArray[np.float64]:
    """Return the disparity of each lens, the mean of two pairs; `rays` rays of a lens pass the pupil."""

    def inverse_depth(x: Any, y: Any) -> Any:
        half = camera.detector_width / 2
        radius = depths(x / half, y / half)
        return 1 / FOCUS - radius * camera.mla_pitch / (camera.aperture_radius * camera.mla_distance)

    scene = scene_of(camera.to_sensor(), **relief(camera, inverse_depth, MARGIN, texture))
    # Of the rays of a pixel, those within the image of the pupil pass it.
    within = math.pi / 4 * (camera.micro_image_diameter / camera.mla_pitch) ** 2
    options: dict[str, Any] = {"model": model, "spp": math.ceil(rays / (4 * within))}
    if model == "wave":
        options["wavelength"] = WAVELENGTH
    pairs = [dual_pixel(render_capture(scene, seed=seed, **options)) for seed in (0, 1)]
    mixed = [one.copy(data=np.stack([one.values[:, 0], other.values[:, 1]], 1)) for one, other in (pairs, pairs[::-1])]
    return np.nanmean([match_halves(pair, window=WINDOW).values for pair in mixed], axis=0)


def curve(camera: PlenopticCamera, model: str, rays: int, texture: int) -> NDArray[np.float64]:
    """Return the disparity of planes with the blurs `BLURS`: the mean over the picture."""
    inner = slice(MARGIN, -MARGIN)
    return np.array(
        [
            np.nanmean(disparities(camera, lambda x, y, r=radius: r + 0 * x, model, rays, texture)[inner, inner])
            for radius in BLURS
        ]
    )


RAMP, STEPS = 5.0, (-4.5, 1.5, 5.0)
"""Largest blur of the tilted plane in the upper half of the picture, and blurs of the steps in the lower half."""


def tilted_and_steps(x: Any, y: Any) -> Any:
    """Return the blur radius of a tilted plane above planes with steps."""
    step = np.clip(((x + 1) / 2 * len(STEPS)).astype(int), 0, len(STEPS) - 1)
    return np.where(y > 0, RAMP * x, np.array(STEPS)[step])


def parts(camera: PlenopticCamera, blurs: NDArray[np.float64]) -> Iterator[tuple[slice, slice]]:
    """Yield the rows and columns of lenses of each step, and of thirds of the tilted plane, without their margins."""
    rows, columns = blurs.shape
    edges = np.linspace(0, columns, len(STEPS) + 1).astype(int)
    halves = slice(MARGIN, rows // 2 - MARGIN), slice(rows // 2 + MARGIN, rows - MARGIN)
    for half in halves:
        for low, high in zip(edges[:-1], edges[1:], strict=True):
            yield half, slice(low + MARGIN, high - MARGIN)


@case(
    "dual-pixels.depth",
    "Disparity of a tilted plane and of steps in depth against the curve that planes facing the camera calibrate: the "
    "largest difference of the mean over one of six parts of the picture, over the largest disparity",
    {
        "f-number": "f/{f_number:g}", "model": "{model}", "disparity at blurs of -6, -2, 2, 6 lenses": "{shown}",
        "of half discs": "{ratio:.2f}", "off": "{off:.1%}", "one lens": "{rms:.1%}",
    },
    (at_most("off", 0.03),),
    page="docs/numbers.md",
    quick={"f_numbers": (1.8,), "rays": 20, "lenses": (120, 80)},
)  # fmt: skip
def depth(
    *, f_numbers: tuple[float, ...] = (1.8, 4.0, 8.0), rays: int = 250, lenses: tuple[int, ...] = (180, 120)
) -> Iterator[Row]:
    """Compare the disparities of a scene with the curve; ``rays`` rays of each lens pass the pupil."""
    for f_number in f_numbers:
        camera = camera_of(f_number, lenses)
        x, y = (np.arange(count) * 2 + 1 - count for count in lenses)
        blurs = tilted_and_steps(*np.meshgrid(x / lenses[0], y / lenses[0]))
        for model in ("ray", "wave"):
            known = curve(camera, model, rays, 1)
            found, expected = disparities(camera, tilted_and_steps, model, rays, 2), np.interp(blurs, BLURS, known)
            places = list(parts(camera, blurs))
            means = np.array([(np.nanmean(found[at]), expected[at].mean()) for at in places])
            errors = np.concatenate([(found[at] - expected[at]).ravel() for at in places])
            largest = np.abs(known).max()
            yield {
                "f_number": f_number, "model": model, "curve": known,
                "shown": ", ".join(f"{known[BLURS.index(each)]:.2f}" for each in (-6, -2, 2, 6)),
                # Those of half discs are 8R/(3 pi).
                "ratio": float((known[-1] - known[0]) / 12 / (8 / (3 * math.pi))),
                "means": means, "off": float(np.abs(means[:, 0] - means[:, 1]).max() / largest),
                "rms": float(np.sqrt(np.nanmean(errors**2)) / largest),
            }  # fmt: skip
