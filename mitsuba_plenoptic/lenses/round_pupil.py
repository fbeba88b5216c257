"""A map from a real lens's exit pupil, as positions off the axis see it, to the round pupil near the axis.

The spread of a ray by the pupil depends on the distance and the direction of the nearest edge. A pupil that is
vignetted or displaced off the axis is therefore described by a map to the round pupil near the axis, to points at the
same distance from its edge in the same direction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .lens_system import LensSystem

_FIELDS, _ANGLES, _DENSE, _ACROSS = 17, 256, 4096, 97
"""Distances from the axis, directions in which edges are searched and interpolated, and map nodes across the pupil."""

_WIDER, _BISECTIONS, _TRIED = 1.1, 24, 65
"""Extent of the map over that of the pupil and of the detector's corner; bisections that find an edge; rays across the
pupil that find its centre."""


@dataclass(frozen=True, eq=False)
class RoundMap:
    """Points of the round pupil that correspond to points of the exit pupil, as seen from fields along x."""

    # Distance of the last field from the axis, on the array; the first is 0.
    field: float
    # Largest coordinate of the nodes in the plane of the pupil, along x and y.
    half: float
    # Corresponding point of each node, (fields, rows, columns, 2).
    points: NDArray[np.float32]


def round_map(lens: LensSystem, reach: float, corner: float) -> RoundMap:
    """Return the map of a lens."""
    from scipy.spatial import cKDTree

    radius, half, last = float(lens.pupil_radius), _WIDER * reach, _WIDER * corner
    heights = np.linspace(0, last, _FIELDS)
    axis = np.linspace(-half, half, _ACROSS)
    nodes = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    # The initial value is a point outside the round pupil.
    result = np.full((_FIELDS, len(nodes), 2), 2 * radius, np.float32)
    for field, height in enumerate(heights):
        edge = _edge(lens, height, half)
        if edge is None:
            continue
        along = np.roll(edge, -1, 0) - np.roll(edge, 1, 0)
        normals = np.stack([along[:, 1], -along[:, 0]], -1) / np.hypot(*along.T)[:, None]
        _, nearest = cKDTree(edge).query(nodes)
        outward = normals[nearest]
        inside = ((edge[nearest] - nodes) * outward).sum(1)
        result[field] = outward * (radius - inside)[:, None]
        # The round pupil has no points farther from its edge than its centre.
        result[field][inside > radius] = 0
    if not (np.hypot(*result[0].T) <= radius).any():
        raise InputError("main_lens: no ray gets through it to the middle of the array")
    return RoundMap(last, half, result.reshape(_FIELDS, _ACROSS, _ACROSS, 2))


def _edge(lens: LensSystem, height: float, reach: float) -> NDArray[np.float64] | None:
    """Return points of the pupil's edge, seen from a position on the array's x axis; None if nothing is open."""

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
