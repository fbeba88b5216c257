"""Rays by the tables of `phase_space`, on the active device: where they meet the array, and their coefficients.

Points around microlenses are drawn with a density near that of the rays' light. At each node of a plan's table the
window around a lens is divided into strips, and each strip into cells, all of which receive equally many rays. Cells
are narrow where the first coefficient, which contains a ray's light, is large.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .phase_space import PhaseSpace


def coefficients_of(plan: PhaseSpace) -> RayCoefficients | Polynomials:
    """Return the object that computes the coefficients of rays for a plan."""
    return Polynomials(plan) if plan.by_points else RayCoefficients(plan, plan.table)


class TableNodes:
    """The nodes of a plan's table; a ray takes one of those around its pupil point at random."""

    def __init__(self, plan: PhaseSpace) -> None:
        self._radial, self._radius = plan.radial, plan.camera.pupil_radius
        self._angular = mi.Float([node.angular for node in plan.nodes])

    def along(self, Pu: Any, Pv: Any, chance: Any) -> tuple[Any, Any]:
        """Return distances from the pupil's centre, over its radius, and a random neighbouring node of the radius."""
        distance = dr.sqrt(Pu * Pu + Pv * Pv) / self._radius
        place = (1 - dr.sqrt(dr.maximum(1 - distance, 0))) * self._radial
        return distance, mi.UInt(dr.minimum(dr.floor(place + chance), self._radial))

    def around(self, Pu: Any, Pv: Any, radial: Any, chance: Any) -> Any:
        """Return a random neighbouring node of the angle, at a node of the radius."""
        turn = dr.atan2(dr.abs(Pv), dr.abs(Pu)) * (2 / math.pi) * dr.gather(mi.Float, self._angular, radial)
        return mi.UInt(dr.floor(turn + chance))


class RayCoefficients:
    """The table of a `PhaseSpace`, or one of the same layout, on the device of the active variant."""

    def __init__(self, plan: PhaseSpace, table: Sequence[NDArray[np.float32]]) -> None:
        self.plan = plan
        count, self._packets = len(plan.exponents), -(-len(plan.exponents) // 4)
        # Coefficients are gathered four at a time.
        parts = [np.pad(part, [(0, 0)] * 3 + [(0, 4 * self._packets - count)]).ravel() for part in table]
        self._table = mi.Float(np.concatenate(parts))
        first = np.cumsum([0] + [part.size // 4 // self._packets for part in parts])[:-1]
        self._first = mi.Int(first.astype(np.int32))
        sides, counts = np.array([n.sides for n in plan.nodes]), np.array([n.counts for n in plan.nodes])
        self._sides = [mi.Float(column) for column in sides.T]
        self._counts = [mi.Int(column.astype(np.int32)) for column in counts.T]
        self._nodes = TableNodes(plan)

    def __call__(
        self, point: tuple[Any, Any], pupil: tuple[Any, Any], jitter: tuple[Any, Any, Any, Any], active: Any
    ) -> list[Any]:
        """Return the coefficients of rays from points of a lens through points of the pupil.

        Each ray takes one node of the table at random, so that the expectation is the linear interpolation between the
        sixteen nodes around it.
        """
        plan = self.plan
        lattice = plan.lattice
        (u, v), (Pu, Pv) = lattice.to_frame(*point), lattice.to_frame(*pupil)
        distance, radial = self._nodes.along(Pu, Pv, jitter[0])
        active = active & (distance <= 1)
        # The table covers a quarter of the pupil; the symmetry of the lenses gives the others.
        mirrored = Pu < 0, Pv < 0
        u, v = (dr.select(turned, -place, place) for turned, place in zip(mirrored, (u, v), strict=True))
        index = dr.gather(mi.Int, self._first, radial)
        sizes = [dr.gather(mi.Int, each, radial) for each in self._counts]
        index += mi.Int(self._nodes.around(Pu, Pv, radial, jitter[1])) * (sizes[0] * sizes[1])
        for axis, place, chance, row in ((1, v, jitter[2], sizes[0]), (0, u, jitter[3], 1)):
            side, size = dr.gather(mi.Float, self._sides[axis], radial), sizes[axis]
            active &= dr.abs(place) <= side / 2
            count = mi.Float(size)
            node = mi.Int(dr.floor(place * (count / side) + (count / 2 - 0.5) + chance))
            # The window is periodic.
            index += dr.select(node < 0, node + size, dr.select(node >= size, node - size, node)) * row
        values = [
            value
            for packet in range(self._packets)
            for value in dr.gather(mi.Vector4f, self._table, mi.UInt(index * self._packets + packet), active)
        ]
        return plan.mirrored(values, *mirrored)

    def slopes(
        self, point: tuple[Any, Any], pupil: tuple[Any, Any], jitter: tuple[Any, Any, Any, Any], active: Any
    ) -> tuple[list[Any], list[Any]]:
        """Return the derivatives of the coefficients by the point, along the lattice's axes; see `__call__`."""
        Pu, Pv = self.plan.lattice.to_frame(*pupil)
        _, radial = self._nodes.along(Pu, Pv, jitter[0])
        result = []
        for axis, P in enumerate((Pu, Pv)):
            # This is the slope of linear interpolation between nodes.
            before, after = (
                self(point, pupil, (*jitter[:2], *(end if i == 1 - axis else jitter[2 + i] for i in range(2))), active)
                for end in (mi.Float(0), mi.Float(1))
            )
            density = mi.Float(dr.gather(mi.Int, self._counts[axis], radial)) / dr.gather(
                mi.Float, self._sides[axis], radial
            )
            density = dr.select(P < 0, -density, density)
            result.append([(b - a) * density for a, b in zip(before, after, strict=True)])
        return result[0], result[1]


class Polynomials:
    """The polynomials of a `PhaseSpace`, as coefficients of rays that land by their own points of a lens."""

    def __init__(self, plan: PhaseSpace) -> None:
        self.plan = plan

    def __call__(self, point: tuple[Any, Any], pupil: Any, jitter: Any, active: Any) -> list[Any]:
        """Return the values of the polynomials at points of a lens."""
        plan = self.plan
        u, v = (place / plan.lattice.pitches[0] for place in plan.lattice.to_frame(*point))
        powers = [[mi.Float(1)], [mi.Float(1)]]
        for _ in range(plan.degree):
            for each, place in zip(powers, (u, v), strict=True):
                each.append(each[-1] * place)
        monomials = [powers[0][i] * powers[1][j] for i, j in plan.exponents]
        return [
            sum((m * float(c) for m, c in zip(monomials, column, strict=True) if c), mi.Float(0))
            for column in plan.triangle.T
        ]


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
