"""What rays of the camera meet first, and what is known of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import InputError
from ..io.ground_truth import QUANTITIES

_LANES = 2**21
"""Rays that are traced at once."""


class FirstHits:
    """Finds what rays meet first in a scene: the surface that Mitsuba's integrator ``aov`` tells of.

    Parameters
    ----------
    scene, sensor
        Scene and camera.
    names : sequence of str
        What to find, of `QUANTITIES`.

    Raises
    ------
    InputError
        If the albedo is asked for in a spectral variant, where it has no three channels.
    """

    def __init__(self, scene: Any, sensor: Any, names: Sequence[str]) -> None:
        if mi.is_spectral and "albedo" in names:
            raise InputError(f"aov = 'albedo': variant {mi.variant()} has a spectrum; load the scene in an rgb variant")
        self._scene, self._names = scene, names
        world = sensor.world_transform()
        self._origin, self._axis = world @ mi.Point3f(0, 0, 0), world @ mi.Vector3f(0, 0, 1)
        self._albedo = mi.load_dict({"type": "aov", "aovs": "albedo:albedo"})
        self._sampler = mi.load_dict({"type": "independent"})
        numbers = dr.reinterpret_array(mi.UInt32, scene.shapes_dr()).numpy()
        self._index = np.zeros(numbers.max(initial=0) + 1, np.float32)
        self._index[numbers] = np.arange(1, len(numbers) + 1)

    def along(self, rays: Callable[[Any], tuple[Any, Any]], count: int) -> dict[str, np.ndarray]:
        """Trace rays, and return float32 arrays (count[, 3]) by name.

        Parameters
        ----------
        rays : callable
            Given the numbers of some rays, returns them and whether the main lens lets each through.
        count : int
            How many there are.
        """
        found = {
            name: np.empty((count, len(letters))[: 1 + (len(letters) > 1)], np.float32)
            for name, letters in QUANTITIES.items()
            if name in self._names
        }
        for start in range(0, count, _LANES):
            lanes = dr.opaque(mi.UInt32, start) + dr.arange(mi.UInt32, min(_LANES, count - start))
            for name, values in self._trace(*rays(lanes)).items():
                found[name][start : start + _LANES] = values
        return found

    def _trace(self, ray: Any, open_: Any) -> dict[str, np.ndarray]:
        hit = self._scene.ray_intersect(ray, mi.RayFlags.All, True, open_)
        met = hit.is_valid() & open_
        found: dict[str, Any] = {}
        if "depth" in self._names:
            depth = dr.dot(ray.o - self._origin, self._axis) + hit.t * dr.dot(ray.d, self._axis)
            found["depth"] = dr.select(met, depth, dr.select(open_, dr.inf, dr.nan))
        if "position" in self._names:
            found["position"] = dr.select(met, hit.p, dr.nan)
        if "normal" in self._names:
            found["normal"] = dr.select(met, hit.sh_frame.n, dr.nan)
        if "albedo" in self._names:
            self._sampler.seed(0, dr.width(met))
            aovs = mi.SamplingIntegrator.sample(self._albedo, self._scene, self._sampler, ray, None, met)[2]
            found["albedo"] = dr.select(met, mi.Color3f(*aovs), dr.nan)
        if "shape_index" in self._names:
            # What is placed by an instance is that instance.
            placed = dr.reinterpret_array(mi.UInt32, hit.instance)
            number = dr.select(placed != 0, placed, dr.reinterpret_array(mi.UInt32, hit.shape))
            found["shape_index"] = dr.gather(mi.Float, mi.Float(self._index), number, met)
        dr.eval(found)
        return {name: values.numpy().T for name, values in found.items()}
