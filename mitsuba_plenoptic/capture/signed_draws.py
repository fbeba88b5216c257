"""Rays that signed captures draw: from cells of the detector, through points about lenses and points of the pupil."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..optics import rays
from ..optics.phase import in_millimetres
from ..optics.phase_space import PhaseSpace, RayCoefficients
from ..runtime.batches import Box

Pair = tuple[Any, Any]

_STEPS = 1.1673039782614187 ** -np.arange(1.0, 5.0)
"""Steps of an additive sequence that fills four dimensions evenly: powers of 1 over the root of x^5 = x + 1."""

_FALL = 1.2
"""Distance, from a lens, over which the density of drawn points begins to fall off, in lambda b / 4 h."""

_TURNED = 1.0
"""That distance over the width of a lens from which on points are drawn along the pupil's radius and across it."""

_WIDEST = 4.0
"""That distance over the width of a lens, at most."""

ORDER = 2
"""Points of the detector about a cell are drawn with the density of a B-spline of this order, so that what varies from
cell to cell faster than the grid can hold does not fold back into it."""

_RADIAL, _ANGULAR, _POINTS = 96, 24, 2**13
"""Nodes of the table of means along the radius and over a quarter turn, and points over which each is taken."""


class Drawn(NamedTuple):
    """Rays that are drawn for cells of the detector.

    Attributes
    ----------
    pupil, point, place : (Float, Float)
        Where they pass the pupil; the array, from the centre of the lens; and the array in the camera frame.
    weight : Float
        One over the density of the points over the aperture.
    open, active : Bool
        Whether the pupil lets them through, and whether they may bring light, too.
    middle : (Float, Float)
        Where the ray through the centre of the lens passes the pupil's plane.
    kind : UInt32
        Type of the lens.
    """

    pupil: Pair
    point: Pair
    place: Pair
    weight: Any
    open: Any
    active: Any
    middle: Pair
    kind: Any


@dataclass(frozen=True)
class Cells:
    """Cells of the detector's grid.

    Attributes
    ----------
    box : Box
        A rectangle of the grid.
    index : UInt32
        Their numbers in it, row by row.
    steps : int array (2,)
        Their lenses, in steps of the lattice's indices from those of their chief rays.
    """

    box: Box
    index: Any
    steps: NDArray[np.int64]


class Draws:
    """How rays are drawn for the cells of a camera's detector.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    plans : sequence of PhaseSpace
        Of all wavelengths.
    step : float
        Width of a cell in millimetres.
    """

    def __init__(self, camera: PlenopticCamera, plans: Sequence[PhaseSpace], step: float) -> None:
        self._camera, self._step = camera, step
        self._spread = _FALL * in_millimetres(max(plan.wavelength for plan in plans)) * camera.mla_distance / 4
        self._lens_area = float(camera.lattice.lens_area)
        self._window = max(math.hypot(*node.sides) / 2 for plan in plans for node in plan.nodes)
        shifts = [plans[0].shift(kind) for kind in range(len(camera.mla_focal_lengths))]
        self.turns = [shift * camera.mla_distance / camera.detector_distance for shift in shifts]
        """How far apart rays from one point of the detector pass the pupil, over their distance on lenses of types."""

    @property
    def widest(self) -> float:
        """Distance from the axis, on the pupil's plane, within which the ray from a lit cell's middle comes."""
        camera = self._camera
        # Other points of the cell, and of the lens, look aside.
        cell = self._step * camera.mla_distance / camera.detector_distance * ORDER / math.sqrt(2)
        return float(camera.aperture_radius + self._aside + cell)

    @property
    def _aside(self) -> float:
        return float(max(abs(turn) for turn in self.turns) * self._camera.lattice.aperture_reach)

    @cached_property
    def candidates(self) -> NDArray[np.int64]:
        """Lenses that can light a cell, in steps from that of its chief ray."""
        b, z = self._camera.mla_distance, self._camera.detector_distance
        return self._camera.lattice.neighbours(self.widest * z / (b + z))

    @property
    def lit_lenses(self) -> float:
        """Mean number of lenses that light a cell."""
        camera = self._camera
        reach = self.widest * camera.detector_distance / (camera.mla_distance + camera.detector_distance)
        return float(math.pi * reach**2 / camera.lattice.cell_area)

    def centres(self, cells: Cells) -> tuple[Pair, Pair, Any]:
        """Return the middles of cells, and the centres and types of their lenses."""
        camera, lattice = self._camera, self._camera.lattice
        # Opaque numbers do not compile the kernels again.
        columns = dr.opaque(mi.UInt32, cells.box.columns)
        left, top = (dr.opaque(mi.Int32, number) for number in (cells.box.left, cells.box.top))
        row = cells.index // columns
        x, y = (
            (mi.Float(mi.Int32(index) + low) + 0.5) * self._step - 0.5 * camera.resolution[axis] * camera.pixel_size
            for axis, index, low in ((0, cells.index - row * columns, left), (1, row, top))
        )
        i, j = lattice.cell(*(rays.chief_point(p, camera.mla_distance, camera.detector_distance) for p in (x, y)))
        i, j = (index + dr.opaque(mi.Float, float(step)) for index, step in zip((i, j), cells.steps, strict=True))
        kind = mi.UInt32(lattice.lens_type(i, j)) if len(self.turns) > 1 else dr.zeros(mi.UInt32, dr.width(i))
        return (x, y), lattice.centre(i, j), kind

    def through_centre(self, detector: Pair, centre: Pair) -> Pair:
        """Return where rays from the detector through the centres of lenses meet the pupil's plane."""
        z, b = self._camera.detector_distance, self._camera.mla_distance
        x, y = (rays.pupil_point(c, (c - p) / z, b) for c, p in zip(centre, detector, strict=True))
        return x, y

    def draw(self, cells: Cells, sample: Any, seed: Any) -> Drawn:
        """Return the rays of these numbers; those of even and of odd numbers are independent."""
        middle, centre, kind = self.centres(cells)
        half, index = sample & 1, mi.Float(sample >> 1)
        random = []
        for axis, step in enumerate(_STEPS):
            value = index * step + mi.sample_tea_float32(cells.index, seed ^ (half * 8 + axis + 1))
            random.append(value - dr.floor(value))
        x, y = (p + _tent(r) * self._step for p, r in zip(middle, random[2:], strict=True))
        through = self.through_centre((x, y), centre)
        point, weight = self._about(through, random[:2])
        pupil = self._passed(through, point, kind)
        is_open = dr.square(pupil[0]) + dr.square(pupil[1]) <= self._camera.aperture_radius**2
        near = dr.square(point[0]) + dr.square(point[1]) <= self._window**2
        place = centre[0] + point[0], centre[1] + point[1]
        return Drawn(pupil, point, place, weight, is_open, is_open & near, through, kind)

    def _passed(self, through: Pair, point: Pair, kind: Any) -> Pair:
        """Return where rays pass the pupil of which those through the centres of the lenses pass other places."""
        if not any(self.turns):
            return through
        # What the pupil spreads into a lens passes it, and lands, as a ray through its nearest point does.
        lattice = self._camera.lattice
        inside = lattice.from_frame(
            *(
                dr.clip(s, -side / 2, side / 2)
                for s, side in zip(lattice.to_frame(*point), lattice.aperture_widths, strict=True)
            )
        )
        turn = dr.gather(mi.Float, mi.Float(self.turns), kind)
        return through[0] + turn * inside[0], through[1] + turn * inside[1]

    def _about(self, pupil: Pair, random: list[Any]) -> tuple[Pair, Any]:
        """Draw points about a lens, where the pupil spreads rays through it from; return their weights, too.

        Along either of two directions they are even over the lens, and fall off by the square of the distance beyond.
        The directions are those of the lattice, or near the pupil's rim its radius and across it.
        """
        lattice, radius = self._camera.lattice, self._camera.aperture_radius
        Pu, Pv = lattice.to_frame(*pupil)
        widths = lattice.aperture_widths
        distance = dr.sqrt(Pu * Pu + Pv * Pv)
        turned = self._spread > _TURNED * (radius - distance) * max(widths)
        cosine, sine = dr.select(turned, Pu / distance, 1), dr.select(turned, Pv / distance, 0)
        # Half the widths of the overlap of the pupil with itself about P.
        across = dr.sqrt(dr.maximum(radius * radius - distance * distance, 0))
        halves = [
            dr.select(turned, at_rim, dr.sqrt(dr.maximum(radius * radius - other * other, 0)) - dr.abs(own))
            for at_rim, own, other in ((radius - distance, Pu, Pv), (across, Pv, Pu))
        ]
        extents = [0.5 * (widths[0] * dr.abs(c) + widths[1] * dr.abs(s)) for c, s in ((cosine, sine), (sine, cosine))]
        places, weight = [], mi.Float(1 / self._lens_area)
        for r, half, extent in zip(random, halves, extents, strict=True):
            fall = dr.minimum(self._spread / dr.maximum(half, 1e-6 * radius), _WIDEST * max(widths))
            side = 2 * r - 1
            # The root of the greatest density over that of the place; from 1 on it is beyond the lens.
            less = fall / ((extent + fall) * dr.maximum(1 - dr.abs(side), 1e-7))
            far = dr.copysign(extent + fall * (less - 1), side)
            places.append(dr.select(less > 1, far, side * (extent + fall)))
            weight *= 2 * (extent + fall) * dr.square(dr.maximum(less, 1))
        point = lattice.from_frame(places[0] * cosine - places[1] * sine, places[0] * sine + places[1] * cosine)
        return point, weight

    def means(self, coefficients: RayCoefficients) -> Means | None:
        """Return the integrals of the coefficients over lenses; None if they are 1 and 0."""
        return Means(self, coefficients) if any(self.turns) else None

    def mean_nodes(self) -> tuple[Any, Any]:
        """Return the nodes of the table of means: places on the pupil's plane, and types of lenses."""
        node = dr.arange(mi.UInt32, len(self.turns) * _RADIAL * _ANGULAR)
        angle = mi.Float(node % _ANGULAR) * (math.pi / 2 / (_ANGULAR - 1))
        distance = mi.Float(node // _ANGULAR % _RADIAL) * self.mean_step
        return self._camera.lattice.from_frame(distance * dr.cos(angle), distance * dr.sin(angle)), node // (
            _ANGULAR * _RADIAL
        )

    @property
    def mean_step(self) -> float:
        """Distance of the table's nodes along the radius."""
        return (self._camera.aperture_radius + self._aside) / (_RADIAL - 1)

    def mean_at(self, nodes: tuple[Pair, Any], index: Any, coefficients: RayCoefficients) -> list[Any]:
        """Return the coefficients, with their weights, of one point of the lens for each node."""
        through, kind = nodes
        lane = dr.arange(mi.UInt32, dr.width(kind))
        random = []
        for axis, step in enumerate(_STEPS[:2]):
            value = mi.Float(index) * step + mi.sample_tea_float32(lane, axis)
            random.append(value - dr.floor(value))
        point, weight = self._about(through, random)
        pupil = self._passed(through, point, kind)
        active = dr.square(pupil[0]) + dr.square(pupil[1]) <= self._camera.aperture_radius**2
        return [weight * value for value in coefficients(point, pupil, jitter(lane, index + 4), active)]


class Means:
    """Integrals of the coefficients over a lens, where rays through its points pass different places of the pupil."""

    def __init__(self, draws: Draws, coefficients: RayCoefficients) -> None:
        self._draws, self._plan = draws, coefficients.plan
        nodes = draws.mean_nodes()
        count = len(self._plan.exponents)
        dr.eval(nodes)

        def add(index: Any, totals: list[Any]) -> tuple[Any, list[Any]]:
            values = draws.mean_at(nodes, index, coefficients)
            return index + 1, [
                total + dr.select(dr.isfinite(value), value, 0) for total, value in zip(totals, values, strict=True)
            ]

        nothing = [dr.zeros(mi.Float, dr.width(nodes[1])) for _ in range(count)]
        _, totals = dr.while_loop((mi.UInt32(0), nothing), lambda index, _: index < _POINTS, add, label="means")
        table = np.zeros((dr.width(nodes[1]), count + -count % 4), np.float32)
        table[:, :count] = np.stack([np.array(total) for total in totals], -1) / _POINTS
        self._table = mi.Float(table.ravel())
        self._packets = table.shape[1] // 4

    def __call__(self, through: Pair, kind: Any, jitter: tuple[Any, ...], active: Any) -> list[Any]:
        """Return the integrals for rays that pass, through the centre of the lens, these places of the pupil's plane."""
        u, v = self._plan.lattice.to_frame(*through)
        radial = dr.sqrt(u * u + v * v) / self._draws.mean_step
        angle = dr.atan2(dr.abs(v), dr.abs(u)) * ((_ANGULAR - 1) * 2 / math.pi)
        active = active & (radial <= _RADIAL - 1)
        rows = [mi.UInt32(dr.floor(place + chance)) for place, chance in zip((radial, angle), jitter, strict=False)]
        node = (kind * _RADIAL + dr.minimum(rows[0], _RADIAL - 1)) * _ANGULAR + dr.minimum(rows[1], _ANGULAR - 1)
        values = [
            value
            for packet in range(self._packets)
            for value in dr.gather(mi.Vector4f, self._table, node * self._packets + packet, active)
        ]
        return self._plan.mirrored(values, u < 0, v < 0)


def jitter(lane: Any, key: Any) -> tuple[Any, Any, Any, Any]:
    """Return four random numbers, of 16 bits each."""
    words = mi.sample_tea_32(lane, key)
    low = [mi.Float(word & 0xFFFF) * 2.0**-16 for word in words]
    high = [mi.Float(word >> 16) * 2.0**-16 for word in words]
    return low[0], low[1], high[0], high[1]


def _tent(value: Any) -> Any:
    """Turn evenly distributed numbers into those of the density 1 - |t|, a B-spline of order 2."""
    return dr.select(value < 0.5, dr.sqrt(2 * value) - 1, 1 - dr.sqrt(2 * (1 - value)))
