"""A map from the exit pupil of a real main lens, as places off the axis see it, onto the round one near the axis.

How far the pupil spreads a ray depends on how near to its edge the ray passes it, and on which side. A pupil that
surfaces vignette, or that stands elsewhere off the axis, is therefore described by a map onto the round one near the
axis: to points as far from its edge, in the same direction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .lens_system import LensSystem

_FIELDS, _ANGLES, _DENSE, _ACROSS = 17, 256, 4096, 97
"""Distances from the axis, directions in which edges are looked for and their interpolated ones, nodes of the map."""

_WIDER, _BISECTIONS, _TRIED = 1.1, 24, 65
"""How far beyond the pupil and the detector's corner the map goes; steps by which edges are found; rays across the
pupil by which its middle is."""


@dataclass(frozen=True, eq=False)
class RoundMap:
    """Points of the round pupil that stand for points of it, seen from fields along x."""

    # Distance from the axis, on the array, of the last field; the first is 0.
    field: float
    # Distance of the outer nodes from the middle of the pupil's plane, along x and y.
    half: float
    # At each node; (fields, rows, columns, 2).
    points: NDArray[np.float32]


def round_map(lens: LensSystem, reach: float, corner: float) -> RoundMap:
    """Return the map of a lens."""
    from scipy.spatial import cKDTree

    radius, half, last = float(lens.pupil_radius), _WIDER * reach, _WIDER * corner
    heights = np.linspace(0, last, _FIELDS)
    axis = np.linspace(-half, half, _ACROSS)
    nodes = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    # Outside the round pupil.
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
        # Beyond the middle of a wide pupil there is no place for them.
        result[field][inside > radius] = 0
    if not (np.hypot(*result[0].T) <= radius).any():
        raise InputError("main_lens: no ray gets through it to the middle of the array")
    return RoundMap(last, half, result.reshape(_FIELDS, _ACROSS, _ACROSS, 2))


def _edge(lens: LensSystem, height: float, reach: float) -> NDArray[np.float64] | None:
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
