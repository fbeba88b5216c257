"""Coefficients of rays from the tables of `phase_space`, interpolated with Dr.Jit on the active device."""

from __future__ import annotations

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
