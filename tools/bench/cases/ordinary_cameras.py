"""Ordinary cameras, without a microlens array: accuracy and price of wave captures."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Iterator

import mitsuba as mi
import numpy as np
from cases import (
    APERTURES,
    ORDINARY_WAVELENGTH,
    WIDE,
    blurred,
    diffracted,
    facing,
    ordinary_camera,
    radiating,
    relative,
    scene_of,
    textured_wall,
)

from mitsuba_plenoptic import PlenopticCamera, load_scene, render_capture, with_camera

from .. import Row, at_most, case
from ..measures import mean_of_seeds, without_noise
from ..timing import in_process, once, peak_memory

_WAVES_OF_PATH = 633 / ORDINARY_WAVELENGTH

ABERRATIONS = {
    "none": ((), None),
    "defocus": ((0.0,) * 3 + (0.15,), lambda x, y: 0.15 * _WAVES_OF_PATH * math.sqrt(3) * (2 * (x * x + y * y) - 1)),
    "astigmatism": ((0.0,) * 5 + (0.1,), lambda x, y: 0.1 * _WAVES_OF_PATH * math.sqrt(6) * (x * x - y * y)),
    "coma": ((0.0,) * 7 + (0.15,), lambda x, y: 0.15 * _WAVES_OF_PATH * math.sqrt(8) * (3 * (x * x + y * y) - 2) * x),
    "spherical": (
        (0.0,) * 10 + (0.12,),
        lambda x, y: 0.12 * _WAVES_OF_PATH * math.sqrt(5) * (6 * (x * x + y * y) ** 2 - 6 * (x * x + y * y) + 1),
    ),
}
"""Coefficients of Zernike polynomials in waves of 633 nm, and the path in waves of the light."""


@case(
    "ordinary.accuracy",
    "Wave captures of a textured wall by an ordinary camera against a sum over the pupil",
    {
        "pixel (Airy radii)": "{airy:g}", "blur (lambda b / R)": "{blur:g}", "aberration": "{aberration}",
        "capture": "{kind}", "waves": "{waves:.2%}", "light": "{light:.4f}", "rays": "{rays:.2%}",
        "noise": "{noise:.2%}",
    },
    (at_most("waves", "limit"),),
    page="docs/theory/ordinary.md",
    quick={"pixels": (1.0,), "blurs": (0.0,), "aberrations": ("none",), "spp": 256},
)  # fmt: skip
def accuracy(
    *,
    pixels: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0, 4.0, 10.0),
    blurs: tuple[float, ...] = (0.0, 1.0, 4.0),
    aberrations: tuple[str, ...] = ("none", "coma"),
    finer: tuple[bool, ...] = (False,),
    spp: int = 2048,
) -> Iterator[Row]:
    """Compare captures of walls whose texels are at least two pixels and 2.4 Airy radii wide."""
    mi.set_variant("llvm_ad_mono")
    for airy, blur, name, fine in itertools.product(pixels, blurs, aberrations, finer):
        wavefront, path = ABERRATIONS[name]
        camera = ordinary_camera(airy, wavefront=wavefront)
        texel = max(2, round(4 / airy))
        scene, picture = textured_wall(camera, texel, blur)
        expected = diffracted(camera, picture, texel, blur, path)
        options = {"accuracy": 0.004} if fine else {}

        def taken(seed: int, scene: mi.Scene = scene, options: dict[str, float] = options) -> np.ndarray:
            return render_capture(
                scene, model="wave", spp=spp, seed=seed, wavelength=ORDINARY_WAVELENGTH, **options
            ).image

        image, noise = mean_of_seeds(taken, 2)
        yield {
            "airy": airy, "blur": blur, "aberration": name, "kind": "finer" if fine else "usual", "noise": noise,
            "waves": without_noise(relative(image, expected), noise), "light": float(image.mean() / expected.mean()),
            "rays": relative(render_capture(scene, model="ray", spp=spp).image, expected),
            "limit": 0.01 if path is None else 0.02,
        }  # fmt: skip


@case(
    "ordinary.apertures",
    "Wave captures of a textured wall through apertures by an ordinary camera against a sum over the pupil",
    {
        "aperture": "{aperture}", "blur (lambda b / R)": "{blur:g}", "waves": "{waves:.2%}", "light": "{light:.4f}",
        "rays": "{rays:.2%}", "noise": "{noise:.2%}",
    },
    (at_most("waves", 0.01),),
    page="docs/theory/ordinary.md",
    quick={"apertures": ("two holes",), "blurs": (4.0,), "spp": 256, "film": 16},
)  # fmt: skip
def apertures(
    *,
    apertures: tuple[str, ...] = tuple(APERTURES),
    blurs: tuple[float, ...] = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0),
    spp: int = 512,
    film: int = 32,
) -> Iterator[Row]:
    """Compare captures with pixels of an Airy radius, through the open pupil, of walls whose texels are four wide."""
    mi.set_variant("llvm_ad_mono")
    for name, blur in itertools.product(apertures, blurs):
        parameters, mask = APERTURES[name]
        camera = ordinary_camera(1.0, film, **parameters)
        # Light of single cells goes far.
        scene, picture = textured_wall(camera, 4, blur, WIDE)
        expected = diffracted(camera, picture, 4, blur, mask=mask)

        def taken(seed: int, scene: mi.Scene = scene) -> np.ndarray:
            return render_capture(scene, model="wave", spp=spp, seed=seed, wavelength=ORDINARY_WAVELENGTH).image

        image, noise = mean_of_seeds(taken, 4)
        yield {
            "aperture": name, "blur": blur, "noise": noise, "light": float(image.mean() / expected.mean()),
            "waves": without_noise(relative(image, expected), noise),
            "rays": relative(render_capture(scene, model="ray", spp=spp).image, expected),
        }  # fmt: skip


def noisy_scene(kind: str, airy: float, film: int) -> mi.Scene:
    """Return a scene of the noise's table: a wall whose texels pixels divide, or a small lamp before a dim wall."""
    camera = ordinary_camera(airy, film)
    if kind == "textured wall":
        whole = textured_wall(
            camera.replace(detector_width=camera.detector_width * 1.07), max(2, round(4 / airy)), 0.5
        )[0]
        return with_camera(whole, camera)
    distance, _ = blurred(camera, 0.5)
    lamp = facing(distance, 1.5 * camera.pixel_size * distance / camera.mla_distance, **radiating())
    return scene_of(camera.to_sensor(), "direct", lamp=lamp, dim=facing(2 * distance, 100.0, **radiating(0.01)))


def _captured(resolution: int, spp: int, model: str, seed: int = 0) -> np.ndarray:
    """Return a capture of the still life by an ordinary camera with the main lens of the scene's."""
    scene = load_scene("still_life", parameters={"resolution": str(resolution)})
    camera = PlenopticCamera.from_sensor(scene.sensors()[0]).replace(mla_lattice="none")
    return render_capture(with_camera(scene, camera), model=model, spp=spp, seed=seed).image


def _peak(resolution: int, spp: int, model: str) -> float:
    """Return the peak memory of this process in GiB, which captures the still life once."""
    _captured(resolution, spp, model)
    return peak_memory()


@case(
    "ordinary.cost",
    "Time of wave captures of the still life by an ordinary camera over that of ray captures, in turn in one process",
    {
        "film": "{film}", "samples": "{spp}", "rays (s)": "{rays:.1f}", "waves (s)": "{waves:.1f}",
        "waves over rays": "{ratio:.2f}", "at equal noise": "{equal:.2f}", "memory of rays (GiB)": "{ray_memory:.2f}",
        "memory of waves (GiB)": "{memory:.2f}",
    },
    (at_most("ratio", 2.0),),
    page="docs/theory/ordinary.md",
    quick={"resolution": 256, "runs": 1, "spp": 16},
)  # fmt: skip
def cost(*, resolution: int = 2048, spp: int = 64, runs: int = 2, variant: str = "llvm_ad_rgb") -> Iterator[Row]:
    """Time captures after a small one, and compare their noise."""
    mi.set_variant(variant)
    for model in ("ray", "wave"):
        _captured(64, 4, model)
    taken: dict[str, list[tuple[np.ndarray, float]]] = {"ray": [], "wave": []}
    for seed, (model, own) in itertools.product(range(1 + runs), taken.items()):
        image, seconds, _ = once(lambda model=model, seed=seed: _captured(resolution, spp, model, seed))
        own.append((image.astype(float), seconds))
    (rays, ray_noise), (waves, noise) = (
        (statistics.mean(each[1] for each in own[1:]), relative(own[0][0], own[1][0])) for own in taken.values()
    )
    yield {
        "film": f"{resolution} x {resolution}", "spp": spp, "rays": rays, "waves": waves, "ratio": waves / rays,
        "equal": waves / rays * (noise / ray_noise) ** 2,
        "ray_memory": in_process(_peak, resolution, spp, "ray", variant=variant),
        "memory": in_process(_peak, resolution, spp, "wave", variant=variant),
    }  # fmt: skip
