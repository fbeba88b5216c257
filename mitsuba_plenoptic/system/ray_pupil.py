"""The exit pupil of the main lens as rays from the detector through microlenses see it.

How far the pupil spreads a ray depends on how near to its edge the ray passes it, and on which side. A pupil that
surfaces vignette, or that stands elsewhere off the axis, is therefore described by a map onto the round one near the
axis: to points as far from its edge, in the same direction.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError
from ..lenses.base import MainLens
from .optical_system import OpticalSystem

Pair = tuple[Any, ...]

_FIELDS, _ANGLES, _DENSE, _ACROSS = 17, 256, 4096, 97
"""Distances from the axis, directions in which edges are looked for and their interpolated ones, nodes of the map."""

_WIDER, _BISECTIONS, _TRIED = 1.1, 24, 65
"""How far beyond the pupil and the detector's corner the map goes; steps by which edges are found; rays across the
pupil by which its middle is."""


@dataclass(frozen=True)
class RayPupil:
    """The exit pupil of a camera, and the rays through it.

    Parameters
    ----------
    system : OpticalSystem
        The camera; its wavelength counts for a main lens with surfaces.
    """

    system: OpticalSystem

    @property
    def radius(self) -> float:
        """Radius of the pupil near the axis in millimetres."""
        return self.system.camera.pupil_radius

    @property
    def reach(self) -> float:
        """Radius of a circle about the axis that holds the pupil, seen from anywhere on the detector."""
        return self.system.lens.reach

    def chief_point(self, p: Any, detector_distance: Any) -> Any:
        """Return where rays from the detector to the pupil's middle pass the array."""
        return self.system.lens.chief_point(p, detector_distance)

    def distance_from(self, detector_distance: float) -> float:
        """Return the distance from the pupil to so far behind the array: what turns directions into its points."""
        return self.system.lens.pupil_distance_from(detector_distance)

    def seen(self, detector: Pair, centre: Pair, detector_distance: float, height: Any) -> Pair:
        """Return the points of the pupil that the detector sees through the centres of lenses.

        The lenses stand by a height nearer to the main lens than so far from the detector.
        """
        slopes = ((c - p) / (detector_distance + height) for c, p in zip(centre, detector, strict=True))
        lens = self.system.lens
        return tuple(lens.pupil_point(c, slope, height) for c, slope in zip(centre, slopes, strict=True))

    def trace(self, place: Pair, pupil: Pair, height: Any) -> tuple[tuple[Any, Any, Any], Pair]:
        """Return where rays from places on the array through points of the pupil start to the scene, and their slopes.

        The places are by a height nearer to the main lens than the array on the axis.
        """
        lens = self.system.lens
        x, y = (lens.slope_to(P, m, height) for P, m in zip(pupil, place, strict=True))
        start = tuple(m - height * t for m, t in zip(place, (x, y), strict=True))
        point, slope, _ = lens.trace((start[0], start[1]), (x, y))
        return point, slope

    def inner(self, pupil: Pair, centre: Pair) -> Pair:
        """Return the points of the round pupil that stand for points of it, seen from lenses; others stand for none."""
        if self.system.lens.is_open_evenly:
            return pupil
        (x, y), (cx, cy) = pupil, centre
        field = dr.sqrt(cx * cx + cy * cy)
        # The map is that of fields along x.
        c, s = dr.select(field > 0, cx / field, 1), dr.select(field > 0, cy / field, 0)
        corner, half = _field(self.system.camera), _WIDER * self.reach
        u, v = x * c + y * s, y * c - x * s
        across = [(value / half + 1) * ((_ACROSS - 1) / (2 * _ACROSS)) + 0.5 / _ACROSS for value in (u, v)]
        u, v = self._map.eval(mi.Point3f(*across, field / corner * ((_FIELDS - 1) / _FIELDS) + 0.5 / _FIELDS))
        return u * c - v * s, u * s + v * c

    @functools.cached_property
    def _map(self) -> Any:
        # Beyond its border the map goes on as there, outside of the pupil.
        return mi.Texture3f(
            mi.TensorXf(_inner(self.system)),
            filter_mode=dr.FilterMode.Linear,
            wrap_mode=dr.WrapMode.Clamp,
        )


def _field(camera: PlenopticCamera) -> float:
    """Return the distance from the axis, on the array, up to which the pupil is mapped."""
    return _WIDER * math.hypot(camera.detector_width, camera.detector_height) / 2


def _inner(system: OpticalSystem) -> NDArray[np.float32]:
    """Return the map of a pupil onto the round one at fields along x; (fields, rows, columns, 2)."""
    from scipy.spatial import cKDTree

    lens, radius, reach = system.lens, system.camera.pupil_radius, _WIDER * system.lens.reach
    heights = np.linspace(0, _field(system.camera), _FIELDS)
    axis = np.linspace(-reach, reach, _ACROSS)
    nodes = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    # Outside the round pupil.
    result = np.full((_FIELDS, len(nodes), 2), 2 * radius, np.float32)
    for field, height in enumerate(heights):
        edge = _edge(lens, height, reach)
        if edge is None:
            continue
        along = np.roll(edge, -1, 0) - np.roll(edge, 1, 0)
        normals = np.stack([along[:, 1], -along[:, 0]], -1) / np.hypot(*along.T)[:, None]
        _, nearest = cKDTree(edge).query(nodes)
        outward = normals[nearest]
        inside = ((edge[nearest] - nodes) * outward).sum(1)
        result[field] = outward * (radius - inside)[:, None]
        # Beyond the middle of a wide pupil there is no place for them.
        result[field][inside > radius] = 0
    if not (np.hypot(*result[0].T) <= radius).any():
        raise InputError("main_lens: no ray gets through it to the middle of the array")
    return result.reshape(_FIELDS, _ACROSS, _ACROSS, 2)


def _edge(lens: MainLens, height: float, reach: float) -> NDArray[np.float64] | None:
    """Return points of the edge of the pupil, seen from a place on the array's x axis; None if nothing is open."""

    def is_open(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray(lens.ray((x, y), (np.full_like(x, height), np.zeros_like(x)))[2])

    x, y = np.meshgrid(*[np.linspace(-reach, reach, _TRIED)] * 2)
    passed = is_open(x, y)
    if not passed.any():
        return None
    middle = float(x[passed].mean()), float(y[passed].mean())
    angle = 2 * math.pi * np.arange(_ANGLES) / _ANGLES
    low, high = np.zeros(_ANGLES), np.full(_ANGLES, 2 * reach)
    for _ in range(_BISECTIONS):
        between = (low + high) / 2
        within = is_open(middle[0] + between * np.cos(angle), middle[1] + between * np.sin(angle))
        low, high = np.where(within, between, low), np.where(within, high, between)
    dense = 2 * math.pi * np.arange(_DENSE) / _DENSE
    distance = np.interp(dense, angle, low, period=2 * math.pi)
    return np.stack([middle[0] + distance * np.cos(dense), middle[1] + distance * np.sin(dense)], -1)
