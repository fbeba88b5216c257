r"""Rays of points through the pupil to the array, and the coefficients with which they light cells of the detector.

A point sends one ray through each point P of the exit pupil. It meets the array at q(P), and a lens of centre c at
m = q(P) - c. Behind this lens the light of P lands, in the mean over the lens, on one point x of the detector, so that
a cell of the detector's grid and a lens determine P. The light of the lens in the cell has the coefficients

.. math:: \frac{1}{W} \int_\mathrm{cell} w(P)\, A_n(q(P) - c, P) \left| \frac{dP}{dx} \right| d^2x

with the relative power w over the pupil, its integral W over the open pupil, and the :math:`A_n` of
`system.phase_space`. The integral is a sum over a few points of the cell. Out of focus, q changes by a part of a lens
from one of these points to the next. The table of :math:`A_n` is therefore averaged over this distance in m beforehand.

Each point of a cell takes one of the table's nodes around it, by the fractional parts of additive sequences over
neighbouring cells and their points, which start at random for each lens and point. Sums over neighbours thus
interpolate the table, and the errors of different points are independent.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy
from numpy.typing import NDArray

from ..lenses.main_lens import Pair
from ..light.lens_kinds import LensKinds
from ..light.oblique import ObliqueImages
from ..light.optical_system import OpticalSystem, RayPupil
from ..light.phase_space import PhaseSpace, RayCoefficients
from ..light.sampling import footprint
from ..optics import rays
from ..optics.waves import in_millimetres
from ..runtime.backend import drjit_array
from ..runtime.batches import Box
from ..runtime.fft import worker_count

_NODES, _WIDER = 33, 1.1
"""Nodes across the pupil between which rays are interpolated, and their extent over that of the pupil."""

_ACROSS, _TOGETHER = 128, 128
"""Samples across the pupil for its power, and points of which it is computed together."""

_LANES, _LENSES = 2**21, 40
"""Approximate count of pairs of a cell and a lens that are tried at once, and of lenses per cell and point."""

_TILE = 8
"""Width of the tiles in which points are sorted, in lenses."""

_PER_OCTAVE = 2
"""Distances per octave over which tables are averaged."""

_TURNS = [
    [int(math.sqrt(prime) % 1 * 2**32) for prime in row] for row in ((2, 3, 5, 7), (11, 13, 17, 19), (23, 29, 31, 37))
]
"""Steps of additive sequences, along columns, rows and points of cells, in units of 2^-32, for each random number."""


class Lanes(NamedTuple):
    """Cells of the detector's grid, each lit by a point through a lens."""

    point: Any
    # Lattice indices of the lens.
    i: Any
    j: Any
    # The cell, counted from the full detector's corner.
    column: Any
    row: Any


@dataclass(frozen=True)
class Landing:
    """Where light of the pupil lands behind lenses: :math:`P = -s (x - k c)` along each axis."""

    # s and k for each kind of lenses.
    scales: list[float]
    bases: list[float]

    @classmethod
    def of(cls, system: OpticalSystem, plan: PhaseSpace) -> Landing:
        """Return it for a camera; micro-images are larger than those by rays through the centres of lenses."""
        lens, camera, kinds = system.lens, system.camera, LensKinds(system.camera)
        own, turn = (float(lens.pupil_point(*unit)) for unit in ((1.0, 0.0), (0.0, 1.0)))
        reaches = [camera.reduced_distance * kinds.enlargement(kind.focal_length) for kind in plan.kinds]
        return cls([turn / reach for reach in reaches], [1 + own * reach / turn for reach in reaches])


class BankRays:
    """The rays of some points of a camera, and their coefficients in cells of a grid of a given step."""

    def __init__(
        self,
        system: OpticalSystem,
        points: NDArray[np.float64],
        plan: PhaseSpace,
        step: float,
        # Points of a cell along each axis at which coefficients are computed.
        samples: int,
    ) -> None:
        self._camera, self._plan, self._step = system.camera, plan, step
        self._samples, self._pupil, self._kinds = samples, RayPupil(system), LensKinds(system.camera)
        self._lens = system.lens
        self._landing, self._reach = Landing.of(system, plan), float(system.lens.reach)
        self._radius = float(system.camera.pupil_radius)
        self._keys = mi.UInt32([zlib.crc32(point.tobytes()) for point in points])
        self._tabulate(system, points)
        # The distance on the array from one point of a cell to the next, in steps from the finest detail of the table.
        finest = in_millimetres(plan.wavelength) * system.camera.pupil_distance / (2 * self._radius)
        widths = self._steep.mean(1) * step * max(self._landing.scales) / samples / finest
        self._levels = np.maximum(np.rint(_PER_OCTAVE * np.log2(np.maximum(widths, 1e-9))).astype(int), -_PER_OCTAVE)
        self._finest, self._level = finest, -_PER_OCTAVE
        self._coefficients, self._oblique = RayCoefficients(plan, plan.table), ObliqueImages(plan.oblique)
        self._areas = self._passed(len(points))

    def _tabulate(self, system: OpticalSystem, points: NDArray[np.float64]) -> None:
        """Find where rays meet the array, and their power, at nodes over the pupil."""
        if not len(points):
            self._table, self._steep, self._bounds = mi.Float(0), np.zeros((0, 1)), np.zeros((2, 0, 2))
            return
        lens, self._half = system.waves_of(points), _WIDER * self._reach
        found = footprint(lens, points)
        self._bounds = np.stack([found.centre - found.half_width, found.centre + found.half_width])
        axis = np.linspace(-self._half, self._half, _NODES)
        pupil = np.stack([part.reshape(1, -1) for part in np.meshgrid(axis, axis)])
        # Nodes in the corners of the square are not used; rays there may not exist.
        distance = np.hypot(*pupil)
        pupil *= np.minimum(1, self._half / np.maximum(distance, 1e-300))
        point, light = (points[:, :1], points[:, 1:2], points[:, 2:]), lens.bind(points)
        shape = len(points), _NODES**2
        cosine = np.stack([np.broadcast_to(c, shape) for c in light.cosines((pupil[0], pupil[1]), point)])
        whole = np.broadcast_to(pupil, (2, *shape))
        place = lens.meet_array(whole, cosine, point)
        power = np.square(np.broadcast_to(light.amplitude((pupil[0], pupil[1]), point), shape))
        table = np.stack([*place, power / power.mean(1, keepdims=True), np.zeros(shape)], -1)
        self._table = drjit_array(mi.Float, table)
        # Changes of q along either axis between nodes of the pupil.
        grid = np.moveaxis(place, 0, -1).reshape(len(points), _NODES, _NODES, 2)
        inside = (distance <= self._reach).reshape(_NODES, _NODES)
        pairs = (
            (grid[:, 1:] - grid[:, :-1])[:, inside[1:] & inside[:-1]],
            (grid[:, :, 1:] - grid[:, :, :-1])[:, inside[:, 1:] & inside[:, :-1]],
        )
        self._steep = np.concatenate([np.hypot(pair[..., 0], pair[..., 1]) for pair in pairs], 1) / (axis[1] - axis[0])

    def _passed(self, count: int) -> Any:
        """Return the integral of each point's power over the open pupil, or infinity where none is open."""
        made, step = [np.zeros(0)], 2 * _WIDER * self._reach / _ACROSS
        for first in range(0, count, _TOGETHER):
            index = dr.arange(mi.UInt32, min(_TOGETHER, count - first) * _ACROSS**2)
            point = dr.opaque(mi.UInt32, first) + index // _ACROSS**2
            row, column = index // _ACROSS % _ACROSS, index % _ACROSS
            pupil = tuple((mi.Float(n) + 0.5) * step - self._half for n in (column, row))
            made.append(dr.block_sum(self._bright(pupil, *self._at(point, pupil), step)[1], _ACROSS**2).numpy())
        areas = np.concatenate(made) * step**2
        return drjit_array(mi.Float, np.where(areas > 0, areas, np.inf))

    def _at(self, point: Any, pupil: Pair) -> tuple[Pair, Any]:
        """Return where rays through points of the pupil meet the array, and their relative power."""
        # Opaque values are kernel inputs, so that other values do not compile the kernels again.
        half, scale = (dr.opaque(mi.Float, value) for value in (self._half, (_NODES - 1) / (2 * self._half)))
        u, v = ((P + half) * scale for P in pupil)
        column, row = (dr.clip(dr.floor(t), 0, _NODES - 2) for t in (u, v))
        across, up = u - column, v - row
        first = point * _NODES**2 + mi.UInt32(row) * _NODES + mi.UInt32(column)
        a, b, c, d = (dr.gather(mi.Vector4f, self._table, first + step) for step in (0, 1, _NODES, _NODES + 1))
        x, y, power, _ = dr.lerp(dr.lerp(a, b, across), dr.lerp(c, d, across), up)
        return (x, y), power

    def _bright(self, pupil: Pair, place: Pair, power: Any, sample: Any) -> tuple[Pair, Any]:
        """Return the points of the round pupil and the power of samples of the pupil, of which edges open a part."""
        inner, radius = self._pupil.inner(pupil, place), dr.opaque(mi.Float, self._radius)
        distance = dr.sqrt(dr.square(inner[0]) + dr.square(inner[1]))
        power = power * dr.clip((radius - distance) / sample + 0.5, 0, 1)
        inwards = dr.minimum(1, (1 - 1e-6) * radius / dr.maximum(distance, 1e-9))
        return (inner[0] * inwards, inner[1] * inwards), power

    def reaching(self, box: Box) -> NDArray[np.int64]:
        """Return the points whose light may reach cells of a box."""
        window, span = max(max(node.sides) for node in self._plan.nodes), self._reach / min(self._landing.scales)
        base = max(self._landing.bases)
        low, high = (self._bounds[end] + side * window for end, side in ((0, -1), (1, 1)))
        start = np.array([box.left, box.top]) * self._step - self._middle
        size = np.array([box.columns, box.rows]) * self._step
        return np.flatnonzero(((high * base + span > start) & (low * base - span < start + size)).all(1))

    @property
    def _middle(self) -> NDArray[np.float64]:
        """Distances of the full detector's corner from the axis."""
        return np.array(self._camera.resolution) * (self._camera.pixel_size / 2)

    def lots(self, which: NDArray[np.int64], box: Box) -> Iterator[tuple[Lanes, list[NDArray[np.float32]]]]:
        """Yield cells of a box that points light, and their coefficients, in an order of the points' own."""
        cells = math.pi * (self._reach / (self._step * min(self._landing.scales)) + 1) ** 2
        size = max(1, int(_LANES / (_LENSES * cells)))
        for level in np.unique(self._levels[which]).tolist():
            same = which[self._levels[which] == level]
            # Points that light the same cells are added together.
            tile = self._bounds.mean(0)[same] // (_TILE * self._camera.mla_pitch)
            same = same[np.lexsort(tile.T)]
            for first in range(0, len(same), size):
                lanes = self._lit(same[first : first + size], box)
                if dr.width(lanes.point):
                    yield lanes, self._values(lanes, level)

    def _lit(self, points: NDArray[np.int64], box: Box) -> Lanes:
        """Find the cells of a box that points light, and the lenses."""
        plan, lattice, step = self._plan, self._camera.lattice, self._step
        cell = step * max(self._landing.scales)
        most = math.ceil(self._reach / (step * min(self._landing.scales)) + 1.5)
        offsets = np.stack(np.meshgrid(*[np.arange(-most, most + 1)] * 2), -1).reshape(-1, 2)
        offsets = offsets[np.hypot(*offsets.T) <= most].astype(np.int32)
        columns, rows = (drjit_array(mi.Int, part) for part in offsets.T)
        # A cell's distance from the one in which a lens images the pupil's centre gives about the point of the pupil.
        count = dr.opaque(mi.UInt32, len(offsets))
        lane = dr.arange(mi.UInt32, len(offsets) * len(points))
        point = dr.gather(mi.UInt32, drjit_array(mi.UInt32, points), lane // count)
        aside = tuple(dr.gather(mi.Int, part, lane % count) for part in (columns, rows))
        pupil = tuple(mi.Float(part) * -(step * self._landing.scales[0]) for part in aside)
        place, _ = self._at(point, pupil)
        inner = self._pupil.inner(pupil, place)
        distance = dr.sqrt(dr.square(inner[0]) + dr.square(inner[1]))
        farthest = dr.minimum((distance + 1.5 * cell) / self._radius, 1)
        node = mi.UInt32(dr.ceil((1 - dr.sqrt(1 - farthest)) * plan.radial))
        sides = sorted({node.sides for node in plan.nodes})
        window = dr.gather(mi.UInt32, mi.UInt32([sides.index(node.sides) for node in plan.nodes]), node)
        lit = distance <= self._radius + 1.5 * cell
        dr.eval(window, lit, point, place)
        change = float(self._steep[points].max()) * cell
        parts = [[np.zeros(0, kind) for kind in (np.uint32, np.float32, np.float32, np.int32, np.int32)]]
        for number, side in enumerate(sides):
            own = dr.compress(lit & (window == number))
            if not dr.width(own):
                continue
            steps = self._steps(side, 1.5 * change)
            pair = dr.arange(mi.UInt32, dr.width(own) * len(steps))
            source, which = dr.gather(mi.UInt32, own, pair // len(steps)), pair % len(steps)
            i, j = lattice.cell(*(dr.gather(mi.Float, value, source) for value in place))
            i, j = (
                index + dr.gather(mi.Float, drjit_array(mi.Float, part), which)
                for index, part in zip((i, j), steps.T, strict=True)
            )
            first = self._first(i, j)
            column, row = (n + dr.gather(mi.Int, part, source) for n, part in zip(first, aside, strict=True))
            lanes = Lanes(dr.gather(mi.UInt32, point, source), i, j, column, row)
            middle = self._ray(lanes, (0.0, 0.0))[1]
            u, v = lattice.to_frame(*(m - c for m, c in zip(middle, lattice.centre(i, j), strict=True)))
            lit_here = (dr.abs(u) <= side[0] / 2 + 0.75 * change) & (dr.abs(v) <= side[1] / 2 + 0.75 * change)
            lit_here &= (column >= box.left) & (column < box.left + box.columns)
            lit_here &= (row >= box.top) & (row < box.top + box.rows)
            found = dr.compress(lit_here)
            parts.append([dr.gather(type(each), each, found).numpy() for each in lanes])
        kinds = mi.UInt32, mi.Float, mi.Float, mi.Int, mi.Int
        return Lanes(*map(drjit_array, kinds, map(np.concatenate, zip(*parts, strict=True))))

    def _steps(self, side: tuple[float, float], margin: float) -> NDArray[np.int64]:
        """Return the lenses, relative to a ray's own, whose windows the ray may meet."""
        lattice = self._camera.lattice
        span = 1 + math.ceil(2 * (max(side) + margin) / lattice.nearest_distance)
        steps = np.stack(np.meshgrid(*[np.arange(-span, span + 1)] * 2, indexing="ij"), -1).reshape(-1, 2)
        away = np.abs(lattice.to_frame(*(steps @ np.array(lattice.basis)).T))
        cell = np.abs(lattice.to_frame(*lattice.cell_corners().T)).max(1)
        return np.asarray(steps[(np.array(side) / 2 + margin + cell >= away.T).all(1)])

    def kind(self, lanes: Lanes) -> Any:
        """Return the kinds of the lenses."""
        return self._kinds.number(lanes.i, lanes.j, 0.0)

    def _of_kind(self, values: list[float], i: Any, j: Any) -> Any:
        """Return the values for the kinds of lenses."""
        if len(values) == 1:
            return dr.opaque(mi.Float, values[0])
        return dr.gather(mi.Float, mi.Float(values), self._kinds.number(i, j, 0.0))

    @property
    def _numbers(self) -> list[Any]:
        """The step of the grid, and the distances of the detector's corner from the axis, on the device."""
        return [dr.opaque(mi.Float, value) for value in (self._step, *self._middle.tolist())]

    def _first(self, i: Any, j: Any) -> list[Any]:
        """Return the column and the row of the cells in which lenses image the pupil's centre."""
        base = self._of_kind(self._landing.bases, i, j)
        centre, (step, *corners) = self._camera.lattice.centre(i, j), self._numbers
        return [mi.Int(dr.floor((c * base + corner) / step)) for c, corner in zip(centre, corners, strict=True)]

    def _ray(self, lanes: Lanes, within: Pair) -> tuple[Pair, Pair, Any]:
        """Return the points of the pupil and of the array, and the power, of rays to positions within cells."""
        scale, base = (self._of_kind(each, lanes.i, lanes.j) for each in (self._landing.scales, self._landing.bases))
        centre, (step, *corners) = self._camera.lattice.centre(lanes.i, lanes.j), self._numbers
        cells = lanes.column, lanes.row
        pupil = tuple(
            scale * (base * c + corner - (mi.Float(n) + (0.5 + t)) * step)
            for n, t, c, corner in zip(cells, within, centre, corners, strict=True)
        )
        return (pupil, *self._at(lanes.point, pupil))

    def _values(self, lanes: Lanes, level: int) -> list[NDArray[np.float32]]:
        """Return the coefficients of cells, for points for which the table is averaged over one distance."""
        if level != self._level:
            table = averaged(self._plan, self._finest * 2 ** (level / _PER_OCTAVE)) if level > -_PER_OCTAVE else None
            self._level, self._coefficients = level, RayCoefficients(self._plan, table or self._plan.table)
        across, every = (dr.opaque(mi.UInt32, count) for count in (self._samples, self._samples**2))
        centre, area = self._camera.lattice.centre(lanes.i, lanes.j), dr.gather(mi.Float, self._areas, lanes.point)
        sample = self._of_kind(self._landing.scales, lanes.i, lanes.j) * (self._step / self._samples)
        start = self._chances(lanes)
        turns = [dr.opaque(mi.UInt32, turn) for turn in _TURNS[2]]
        dr.eval(*lanes, centre, area, sample, start)

        def add(k: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            within = tuple((mi.Float(n) + 0.5) / mi.Float(across) - 0.5 for n in (k % across, k // across))
            pupil, place, power = self._ray(lanes, within)
            inner, power = self._bright(pupil, place, power, sample)
            weight = power * dr.square(sample) / area
            chance = tuple(mi.Float((each + k * turn) >> 8) * 2.0**-24 for each, turn in zip(start, turns, strict=True))
            point = place[0] - centre[0], place[1] - centre[1]
            values = self._coefficients(point, inner, (chance[0], chance[1], chance[2], chance[3]), weight > 0)
            return k + 1, [
                old + dr.select(weight > 0, value * weight, 0) for old, value in zip(sums, values, strict=True)
            ]

        nothing = [dr.zeros(mi.Float, dr.width(lanes.point)) for _ in range(self._plan.functions.count)]
        _, sums = dr.while_loop((mi.UInt32(0), nothing), lambda k, _: k < every, add, label="bank")
        sums = self._oblique.extended(sums, self._cosines(lanes))
        dr.eval(sums)
        return [each.numpy() for each in sums]

    def _cosines(self, lanes: Lanes) -> Pair:
        """Return the direction cosines, in the lattice's frame, with which the light of cells meets their lenses."""
        centre, (pupil, _, _) = self._camera.lattice.centre(lanes.i, lanes.j), self._ray(lanes, (0.0, 0.0))
        slopes = (-self._lens.slope_to(P, c) for P, c in zip(pupil, centre, strict=True))
        return rays.slopes_to_cosines(*self._camera.lattice.to_frame(*slopes))

    def _chances(self, lanes: Lanes) -> list[Any]:
        """Return the first terms of the sequences by which the points of cells take nodes of the table."""
        key = dr.gather(mi.UInt32, self._keys, lanes.point)
        first = mi.sample_tea_32(mi.UInt32(mi.Int(lanes.i)) ^ key, mi.UInt32(mi.Int(lanes.j)))
        return [
            chance + mi.UInt32(lanes.column) * dr.opaque(mi.UInt32, x) + mi.UInt32(lanes.row) * dr.opaque(mi.UInt32, y)
            for chance, x, y in zip((*first, *mi.sample_tea_32(*first)), *_TURNS[:2], strict=True)
        ]


def averaged(plan: PhaseSpace, width: float) -> list[NDArray[np.float32]]:
    """Return the table of a plan, averaged over squares of points of the array; its windows are periodic."""
    made = []
    for node, part in zip(plan.nodes, plan.table, strict=True):
        for axis, side in ((2, node.sides[0]), (1, node.sides[1])):
            count, shape = part.shape[axis], [-1 if each == axis else 1 for each in range(4)]
            factor = np.sinc(np.arange(count // 2 + 1) * (width / side)).astype(np.float32).reshape(shape)
            spectrum = scipy.fft.rfft(part, axis=axis, workers=worker_count()) * factor
            part = scipy.fft.irfft(spectrum, count, axis=axis, workers=worker_count())
        made.append(part)
    return made
