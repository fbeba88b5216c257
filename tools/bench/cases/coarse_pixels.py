"""Wave captures by cameras whose pixels are large beside the spots of their microlenses: price, noise and accuracy.

Cells of the detector's grid are at least a third of a pixel wide, however small spots are.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any
from unittest import mock

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import PlenopticCamera, render_capture
from mitsuba_plenoptic.light import array_kernels, phase_space, signed_capture

from .. import Row, at_most, case
from ..measures import mean_of_seeds, relative, without_noise
from ..timing import in_process, once, peak_memory
from .lens_models import WAVELENGTH, camera_of, distance_of, scene_of

_COLOURS = {"mono": "llvm_ad_mono", "rgb": "llvm_ad_rgb"}
_MOST = {8: 4.0, 64: 2.0}
_MOST_MEMORY = 1.5


def _camera(f_number: float, pixels: int, film: int, lattice: str) -> PlenopticCamera:
    """Return a camera with some pixels to a lens, and a square film of some pixels."""
    camera = camera_of(f_number)
    pixel = 10 * camera.pixel_size / pixels
    return camera.replace(resolution=(film, film), detector_width=film * pixel, mla_lattice=lattice)


@case(
    "coarse-pixels.cost",
    "Processor time of wave captures over that of ray captures in the same process, second runs, with planning",
    {
        "f-number": "{f_number:g}", "pixels a lens": "{pixels}", "film": "{film}", "lattice": "{lattice}",
        "colours": "{colours}", "blur (lenses)": "{blur:g}", "samples": "{spp}", "rays (s)": "{rays:.2f}",
        "waves (s)": "{waves:.2f}", "waves over rays": "{ratio:.2f}", "noise of rays": "{ray_noise:.2%}",
        "noise of waves": "{noise:.2%}", "waves over rays, at equal noise": "{equal:.2f}",
        "memory above that of rays (GiB)": "{memory:.2f}",
    },
    (at_most("ratio", "limit"), at_most("memory", _MOST_MEMORY)),
    page="docs/theory/cost.md",
    quick={"films": (100,), "f_numbers": (5.6,), "samples": (8,)},
)  # fmt: skip
def cost(
    *,
    films: tuple[int, ...] = (400, 1000),
    f_numbers: tuple[float, ...] = (1.8, 2.8, 5.6, 10.0),
    pixels: tuple[int, ...] = (10,),
    lattices: tuple[str, ...] = ("square",),
    colours: tuple[str, ...] = ("mono",),
    blurs: tuple[float, ...] = (2.0,),
    samples: tuple[int, ...] = (8, 64),
) -> Iterator[Row]:
    """Time captures of a textured wall."""
    for colour in colours:
        mi.set_variant(_COLOURS[colour])
        for film, number, count, lattice, blur in (
            (film, number, count, lattice, blur)
            for film in films for number in f_numbers for count in pixels for lattice in lattices for blur in blurs
        ):  # fmt: skip
            camera = _camera(number, count, film, lattice)
            scene = scene_of(camera, distance_of(camera, blur))
            for spp in samples:
                found: dict[str, Any] = {}
                peaks = {
                    model: in_process(_peak, camera, blur, spp, model, variant=_COLOURS[colour])
                    for model in ("ray", "wave")
                }
                for model in ("ray", "wave"):
                    images, seconds = [], 0.0
                    for seed in (0, 1):
                        image, _, seconds = once(functools.partial(_captured, scene, spp, model, seed))
                        images.append(image.astype(float))
                    found[model] = seconds, relative(*images) / 2**0.5
                (rays, ray_noise), (waves, noise) = found["ray"], found["wave"]
                yield {
                    "f_number": number, "pixels": count, "film": film, "lattice": lattice, "colours": colour,
                    "blur": blur, "spp": spp, "rays": rays, "waves": waves, "ratio": waves / rays,
                    "ray_noise": ray_noise, "noise": noise, "limit": _MOST.get(spp),
                    "equal": waves / rays * (noise / ray_noise) ** 2, "memory": peaks["wave"] - peaks["ray"],
                }  # fmt: skip


def _captured(scene: mi.Scene, spp: int, model: str, seed: int = 0) -> np.ndarray:
    """Return the image of a capture, by waves in a monochrome variant at one wavelength."""
    options = {"wavelength": WAVELENGTH} if model == "wave" and mi.variant() == _COLOURS["mono"] else {}
    return render_capture(scene, model=model, spp=spp, seed=seed, **options).image


def _peak(camera: PlenopticCamera, blur: float, spp: int, model: str) -> float:
    """Return the peak memory of this process in GiB, which captures a wall once."""
    _captured(scene_of(camera, distance_of(camera, blur)), spp, model)
    return peak_memory()


@case(
    "coarse-pixels.accuracy",
    "Wave captures with at most three cells across a pixel against those with all cells that resolve the spots",
    {
        "f-number": "{f_number:g}", "blur (lenses)": "{blur:g}", "capture": "{kind}", "cells": "{cells}",
        "all cells": "{every}",
        "difference": "{difference:.2%}", "light": "{light:.4f}", "noise": "{noise:.2%}",
    },
    (at_most("difference", "limit"),),
    page="docs/theory/phase_space.md",
    quick={"f_numbers": (5.6,), "blurs": (0.0,), "lenses": 4, "spp": 512},
)  # fmt: skip
def accuracy(
    *,
    f_numbers: tuple[float, ...] = (1.8, 2.8, 5.6, 10.0),
    blurs: tuple[float, ...] = (0.0, 2.0),
    lenses: int = 6,
    spp: int = 2048,
) -> Iterator[Row]:
    """Compare captures of a textured wall with ten pixels a lens, usual ones and finer ones."""
    for number in f_numbers:
        for blur in blurs:
            camera = camera_of(number, lenses=lenses)
            scene = scene_of(camera, distance_of(camera, blur))
            with mock.patch.object(phase_space, "_MOST_CELLS", 10**6):
                every = phase_space.parts_of(camera, WAVELENGTH, False)
            # Of a finer plan, without tolerance for missing functions.
            with (
                mock.patch.object(array_kernels, "_FUNCTIONS", 0.0),
                mock.patch.object(signed_capture, "parts_of", lambda *_, every=every: every),
            ):
                phase_space.plan_of.cache_clear()
                reference, noise = _taken(scene, spp, True)
            phase_space.plan_of.cache_clear()
            for finer, limit in ((False, 0.01), (True, 0.005)):
                cells = phase_space.parts_of(camera, WAVELENGTH, finer)
                image, own = _taken(scene, spp, finer)
                yield {
                    "f_number": number, "blur": blur, "kind": "finer" if finer else "usual", "cells": cells,
                    "every": every, "noise": max(noise, own),
                    "difference": without_noise(relative(image, reference), noise, own),
                    "light": float(image.mean() / reference.mean()), "limit": limit,
                }  # fmt: skip


def _taken(scene: mi.Scene, spp: int, finer: bool) -> tuple[np.ndarray, float]:
    """Return the mean of two captures of a scene, usual or finer ones, and its noise."""
    options = {"accuracy": 0.8 * phase_space.FINE} if finer else {}
    return mean_of_seeds(
        lambda seed: render_capture(scene, model="wave", spp=spp, seed=seed, wavelength=WAVELENGTH, **options).image, 2
    )
