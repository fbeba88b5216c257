"""Ground truth of captures, and of light fields decoded from them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera
from ..choices import QUANTITIES
from ..errors import refuse_if, suggest_keywords
from ..io import GroundTruth, require_quantities
from ..runtime import Array, Pair, drjit_array, one_at_a_time, require_memory
from ..scene import as_scene, plenoptic_sensor
from .coordinates import lens_places, pupil_places
from .decoding import view_window
from .grid import bin_grid, lens_grid

_LANES = 2**21
"""Rays that are traced at once."""


class FirstHits:
    """Finder of the surfaces that rays meet first in a scene, as in Mitsuba's integrator ``aov``."""

    def __init__(
        self,
        scene: Any,
        sensor: Any,
        # What to find, of `QUANTITIES`.
        names: Sequence[str],
    ):
        refuse_if(
            mi.is_spectral and "albedo" in names,
            f"aov = 'albedo': variant {mi.variant()} has a spectrum; load the scene in an rgb variant",
        )
        self._scene = scene
        self._names = names
        world = sensor.world_transform()
        self._origin = world @ mi.Point3f(0, 0, 0)
        self._axis = world @ mi.Vector3f(0, 0, 1)
        self._albedo = mi.load_dict({"type": "aov", "aovs": "albedo:albedo"})
        self._sampler = mi.load_dict({"type": "independent"})
        registered = dr.reinterpret_array(mi.UInt32, scene.shapes_dr()).numpy()
        self._index = np.zeros(registered.max(initial=0) + 1, np.float32)
        self._index[registered] = np.arange(1, len(registered) + 1)

    def along(self, rays: Callable[[Any], Pair], count: int) -> dict[str, Array]:
        """Return float32 arrays (count[, 3]) by name for the first hits of rays."""
        hits = {
            name: np.empty((count, len(letters))[: 1 + (len(letters) > 1)], np.float32)
            for name, letters in QUANTITIES.items()
            if name in self._names
        }
        for start in range(0, count, _LANES):
            lanes = dr.opaque(mi.UInt32, start) + dr.arange(mi.UInt32, min(_LANES, count - start))
            for name, values in self._trace(*rays(lanes)).items():
                hits[name][start : start + _LANES] = values
        return hits

    def _trace(self, ray: Any, open_: Any) -> dict[str, Array]:
        hit = self._scene.ray_intersect(ray, _flags(), True, open_)
        met = hit.is_valid() & open_
        quantities = {}
        if "depth" in self._names:
            depth = dr.dot(ray.o - self._origin, self._axis) + hit.t * dr.dot(ray.d, self._axis)
            quantities["depth"] = dr.select(met, depth, dr.select(open_, dr.inf, dr.nan))
        if "virtual_depth" in self._names:
            depth = dr.dot(ray.o - self._origin, self._axis) + self._unfolded(ray, hit, met) * dr.dot(ray.d, self._axis)
            quantities["virtual_depth"] = dr.select(open_, depth, dr.nan)
        if "position" in self._names:
            quantities["position"] = dr.select(met, hit.p, dr.nan)
        if "normal" in self._names:
            quantities["normal"] = dr.select(met, hit.sh_frame.n, dr.nan)
        if "albedo" in self._names:
            self._sampler.seed(0, dr.width(met))
            aovs = mi.SamplingIntegrator.sample(self._albedo, self._scene, self._sampler, ray, None, met)[2]
            quantities["albedo"] = dr.select(met, mi.Color3f(*aovs), dr.nan)
        if "shape_index" in self._names:
            # What is placed by an instance is that instance.
            placed = dr.reinterpret_array(mi.UInt32, hit.instance)
            shape = dr.select(placed != 0, placed, dr.reinterpret_array(mi.UInt32, hit.shape))
            quantities["shape_index"] = dr.gather(mi.Float, drjit_array(mi.Float, self._index), shape, met)
        dr.eval(quantities)
        return {name: values.numpy().T for name, values in quantities.items()}

    def _unfolded(self, ray: Any, hit: Any, met: Any) -> Any:
        """Return lengths of rays unfolded at plane mirrors, up to the mirror image."""
        length = dr.select(met, hit.t, dr.inf)
        # Plane mirrors that a ray is followed over, one after the other, at most.
        for _ in range(8):
            # Plane surfaces that only reflect, without scattering.
            flags = hit.bsdf(ray).flags()
            reflects = (flags & int(mi.BSDFFlags.All)) == int(mi.BSDFFlags.DeltaReflection)
            both_sides = mi.has_flag(flags, mi.BSDFFlags.BackSide)
            is_plane = dr.squared_norm(hit.dn_du) + dr.squared_norm(hit.dn_dv) == 0
            met = met & reflects & is_plane & (both_sides | (hit.wi.z > 0))
            onward = hit.to_world(mi.reflect(hit.wi))
            # Mitsuba's rays start off the surface, along its normal; these start as far off it along themselves.
            gap = dr.dot(hit.spawn_ray(onward).o - hit.p, hit.n) / dr.dot(onward, hit.n)
            ray = mi.Ray3f(hit.p + gap * onward, onward)
            hit = self._scene.ray_intersect(ray, _flags(), True, met)
            length = dr.select(met, length + dr.select(hit.is_valid(), gap + hit.t, dr.inf), length)
            dr.eval(ray, hit, met, length)
        return length


def _flags() -> Any:
    """Return the flags of an intersection with derivatives of normals, by which plane surfaces are recognised."""
    return mi.RayFlags.All | mi.RayFlags.dNSdUV


@suggest_keywords
@one_at_a_time
def ground_truth(scene: Any, names: Iterable[str] = tuple(QUANTITIES), *, sensor: int | Any = 0) -> GroundTruth:
    """Return a plenoptic camera's ground truth in a scene, for each pixel and each sample of the light field.

    A pixel sees a part of the scene, through all of its lens and so through a part of the pupil. Its ground truth is
    that of one ray, from its middle through the centre of its lens. A sample of the light field from `decode`
    represents a point of the pupil and a bin; its ground truth is that of the ray through these two, whichever pixels
    it is interpolated from. Without a microlens array there are pixels alone, whose rays pass the middle of the pupil.
    Rays end at the first surface, as in Mitsuba's integrator ``aov``: also at mirrors, glass,
    masks and cut-outs. Only ``virtual_depth`` follows rays over plane mirrors, up to eight in a row; pixels where it
    exceeds ``depth`` show a mirror. Curved mirrors, and surfaces that also scatter or transmit light, are not followed.

    Parameters
    ----------
    scene : mitsuba.Scene
        A scene with a sensor of type ``plenoptic``.
    names : sequence of str
        Quantities: ``depth``, ``virtual_depth``, ``position``, ``normal``, ``albedo``, ``shape_index``; see
        `GroundTruth`.
    sensor : int or mitsuba.Sensor
        As for `render_capture`.

    Returns
    -------
    GroundTruth

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> size = {"detector_width": 0.256, "resolution": 128}
    >>> scene = mp.load_scene("letters", variant="llvm_ad_mono", parameters=size)
    >>> truth = mp.ground_truth(scene, ["depth"])
    >>> truth.pixels["depth"].shape
    (128, 128)
    """
    names = require_quantities([names] if isinstance(names, str) else names)
    scene = as_scene(scene)
    chosen = plenoptic_sensor(scene, sensor)
    camera = PlenopticCamera.from_sensor(chosen)
    sizes, of_views = _rays_of_views(camera, chosen) if camera.has_array else ((0, 0, 0, 0), None)
    rows, columns = camera.shape
    values = sum(len(QUANTITIES[name]) for name in names)
    require_memory(
        8.0 * values * (rows * columns + math.prod(sizes)),
        f"ground truth of {columns} x {rows} pixels and {sizes[1]} x {sizes[0]} views",
    )
    hits = FirstHits(scene, chosen, names)

    def of_pixels(index: Any) -> Pair:
        row = index // columns
        position = mi.Point2f((index - row * columns + 0.5) / columns, (row + 0.5) / rows)
        return chosen.chief_ray(position)

    pixels = hits.along(of_pixels, rows * columns)
    views = hits.along(of_views, math.prod(sizes)) if of_views else {}
    return GroundTruth(
        camera,
        {name: values.reshape(rows, columns, *values.shape[1:]) for name, values in pixels.items()},
        {name: values.reshape(*sizes, *values.shape[1:]) for name, values in views.items()},
        tuple(shape.id() for shape in scene.shapes()),
        np.array(chosen.world_transform().matrix, np.float64).reshape(4, 4),
    )


def _rays_of_views(camera: PlenopticCamera, sensor: Any) -> tuple[tuple[int, int, int, int], Callable[[Any], Pair]]:
    """Return the shape (v, u, t, s) of the light field of a camera, and the rays of its samples by their indices."""
    regular = camera.regular
    bins = bin_grid(regular)
    half, _ = view_window(regular, lens_grid(regular))
    rows, columns = bins.shape
    views = 2 * half + 1
    pupil = drjit_array(mi.Float, pupil_places(camera, views))
    across, down = (drjit_array(mi.Float, lens_places(regular, bins, axis)) for axis in (0, 1))

    def rays(index: Any) -> Pair:
        coordinates_of = []
        for size, coordinates in ((columns, across), (rows, down), (views, pupil), (views, pupil)):
            following = index // size
            coordinates_of.append(dr.gather(mi.Float, coordinates, index - following * size))
            index = following
        s, t, u, v = coordinates_of
        return sensor.pupil_ray((u, v), (s, t))

    return (views, views, rows, columns), rays
