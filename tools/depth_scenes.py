"""Scenes of random depths: heaps of tiles, and cards with holes before nothing."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter

import mitsuba_plenoptic as mp

HALF = {"detector_width": "4.096", "resolution": "2048"}
"""The paper's camera, and those like it, with half the lenses along each axis."""


def made(number: int, camera: mp.PlenopticCamera | None = None, near: float = 205, far: float = 290) -> Any:
    """Heap tiles at random places, turned and textured at random, before a wall; a third of them without texture.

    Parameters
    ----------
    number : int
        Another one is another heap.
    camera : PlenopticCamera, optional
        Default: the paper's, with half the lenses along each axis.
    near, far : float
        Distances between which the tiles' middles are; the wall is some of that range farther.
    """
    random = np.random.default_rng(number)
    camera = camera or _paper()
    field = camera.detector_width / camera.mla_distance
    # Tiles are as large as the field is, and as flat as the range of distances is small beside it.
    size = field * (near + far) / 2 / (4.096 / 120 * 247.5)
    steepest = 50 * min(1.0, (far - near) / size / 85)

    def tile(at: np.ndarray, half: float, tilt: float, plain: bool) -> dict[str, Any]:
        x, y, g = at
        axis = random.normal(size=3)
        place = mi.ScalarTransform4f().translate([x, y, g]).rotate(list(axis / np.linalg.norm(axis)), tilt)
        pattern = gaussian_filter(random.normal(size=(96, 96)), random.uniform(0.6, 2.5), mode="wrap")
        pattern = np.clip(0.45 + 0.22 * pattern / pattern.std(), 0.02, 0.95)
        if plain:
            pattern[:] = random.uniform(0.1, 0.8)
        return {
            "type": "rectangle",
            "to_world": place.rotate([0, 1, 0], 180).scale(half),
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": _texture(pattern)}},
        }

    objects = {"wall": tile(np.array([0, 0, far + (far - near) / 8.5]), 8.0 * size, 8.0 * steepest / 50, False)}
    for index in range(18):
        g = random.uniform(near, far)
        place = np.array([*(random.uniform(-0.5, 0.5, 2) * 4.096 * g / 120), g])
        objects[f"tile_{index}"] = tile(
            place, size * random.uniform(0.5, 1.6), random.uniform(0, steepest), index % 3 == 0
        )
    light = {"type": "point", "position": [30.0, 40.0, 100.0], "intensity": 4e4}
    return _scene(camera, objects | {"sky": {"type": "constant", "radiance": 0.4}, "lamp": light})


def cards(number: int, camera: mp.PlenopticCamera | None = None, near: float = 205, far: float = 290) -> Any:
    """Stand luminous cards with holes of random shapes side by side before nothing, each as far away as it happens.

    Parameters
    ----------
    number, camera, near, far
        As for `made`: the cards are between near and far.
    """
    random = np.random.default_rng(number)
    camera = camera or _paper()
    count, rows = 3, 2
    objects: dict[str, Any] = {}
    width, height = camera.detector_width, camera.detector_width * camera.resolution[1] / camera.resolution[0]
    for row in range(rows):
        for column in range(count):
            g = random.uniform(near, far)
            x = ((column + 0.5) / count - 0.5) * width * g / camera.mla_distance
            y = ((row + 0.5) / rows - 0.5) * height * g / camera.mla_distance
            half = [0.46 * width / count * g / camera.mla_distance, 0.46 * height / rows * g / camera.mla_distance, 1]
            fineness = random.uniform(2, 14)
            shapes = gaussian_filter(random.normal(size=(256, 256)), fineness) > 0
            place = mi.ScalarTransform4f().translate([x, y, g]).rotate([0, 1, 0], 180).scale(half)
            objects[f"card_{row}_{column}"] = {
                "type": "rectangle",
                "to_world": place,
                "bsdf": {"type": "mask", "opacity": _texture(shapes.astype(float)), "nested": {"type": "diffuse"}},
                "emitter": {"type": "area", "radiance": float(random.uniform(0.3, 1))},
            }
    return _scene(camera, objects)


def _paper() -> mp.PlenopticCamera:
    return mp.PlenopticCamera(detector_width=4.096, resolution=(2048, 2048))


def _texture(values: np.ndarray) -> dict[str, Any]:
    return {"type": "bitmap", "raw": True, "data": mi.TensorXf(values[..., None].astype(np.float32))}


def _scene(camera: mp.PlenopticCamera, objects: dict[str, Any]) -> Any:
    return mp.load_scene({"type": "scene", "integrator": {"type": "direct"}, "sensor": camera.to_sensor(), **objects})
