"""Sampling of the points around microlenses at which rays meet the array, with a density near that of their light.

At each node of a plan's table the window around a lens is divided into strips, and each strip into cells, all of which
receive equally many rays. Cells are narrow where the first coefficient, which contains a ray's light, is large.
"""

from __future__ import annotations

import functools
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .phase_space import PhaseSpace
from .ray_coefficients import TableNodes

_CELLS = 64
"""Number of strips of a window, and of cells of a strip."""

_LEAST = 0.05
"""Fraction of the mean density that is added: other coefficients may be nonzero where the first is 0."""


class LensPoints:
    """Sampler of points around lenses, for rays with the coefficients of a plan's table."""

    def __init__(self, plan: PhaseSpace) -> None:
        self._lattice = plan.lattice
        self._nodes = TableNodes(plan)
        rows, columns = _edges(plan)
        first = np.cumsum([0] + [len(part) for part in plan.table])[:-1]
        self._first = mi.UInt32(first.astype(np.uint32))
        self._sides = [mi.Float([node.sides[axis] for node in plan.nodes]) for axis in (0, 1)]
        self._rows, self._columns = mi.Float(rows), mi.Float(columns)

    def draw(self, pupil: tuple[Any, Any], chance: Any, random: Any) -> tuple[tuple[Any, Any], Any]:
        """Return points, and the reciprocals of their density over the aperture, for rays to points of the pupil."""
        lattice = self._lattice
        Pu, Pv = lattice.to_frame(*pupil)
        _, radial = self._nodes.along(Pu, Pv, chance[0])
        part = dr.gather(mi.UInt32, self._first, radial) + self._nodes.around(Pu, Pv, radial, chance[1])
        places, weight = [], mi.Float(1 / float(lattice.lens_area))
        for axis, edges in ((1, self._rows), (0, self._columns)):
            number = mi.UInt32(random[axis] * _CELLS)
            low, high = (dr.gather(mi.Float, edges, part * (_CELLS + 1) + number + end) for end in (0, 1))
            side = dr.gather(mi.Float, self._sides[axis], radial)
            places.append(dr.lerp(low, high, random[axis] * _CELLS - mi.Float(number)) * side)
            weight *= (high - low) * side * _CELLS
            part = part * _CELLS + number
        v, u = (dr.select(P < 0, -place, place) for P, place in zip((Pv, Pu), places, strict=True))
        return lattice.from_frame(u, v), weight


@functools.lru_cache(maxsize=8)
def _edges(plan: PhaseSpace) -> list[NDArray[np.float32]]:
    """Return the edges of the strips of all nodes and of their cells, in sides of the windows, as flat arrays."""
    parts = [divided(density_of(values)) for part in plan.table for values in part[..., 0]]
    return [np.ravel(each).astype(np.float32) - np.float32(0.5) for each in zip(*parts, strict=True)]


def density_of(values: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the sampling density for samples of a coefficient, which may be negative."""
    square = values.astype(np.float64) ** 2
    # Between samples a ray takes one of the nearest ones.
    for axis in (0, 1):
        square = (np.roll(square, 1, axis) + 2 * square + np.roll(square, -1, axis)) / 4
    root = np.sqrt(square)
    return np.asarray(root + _LEAST * root.mean())


def divided(density: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Divide a window into parts over which a density, constant within each sample, has equal integrals.

    Returns the edges of the strips, (n + 1,), and those of their cells, (n, n + 1).
    """
    rows, columns = density.shape
    upto = np.concatenate([np.zeros((1, columns)), np.cumsum(density, axis=0)])
    parts = np.linspace(0, 1, _CELLS + 1)
    total = upto.sum(1)
    edges = np.interp(parts * total[-1], total, np.arange(rows + 1))
    low = np.minimum(edges.astype(int), rows - 1)
    strips = np.diff(upto[low] + (edges - low)[:, None] * density[low], axis=0)
    sums = np.concatenate([np.zeros((_CELLS, 1)), np.cumsum(strips, axis=1)], axis=1)
    cells = [np.interp(parts * each[-1], each, np.arange(columns + 1)) for each in sums]
    return edges / rows, np.stack(cells) / columns
