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
from ..optics.phase_space import PhaseSpace
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


class Drawn(NamedTuple):
    """Rays that are drawn for cells of the detector.

    Attributes
    ----------
    pupil, point, place : (Float, Float)
        Where they pass the pupil; the array, from the centre of the lens; and the array in the camera frame.
    weight : Float
        One over the density of the points over the aperture.
    open : Bool
        Whether the pupil lets them through.
    """

    pupil: Pair
    point: Pair
    place: Pair
    weight: Any
    open: Any


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
        self._window = max(max(node.sides) / 2 for plan in plans for node in plan.nodes)

    @property
    def widest(self) -> float:
        """Distance from the axis, on the pupil's plane, within which the ray from a lit cell's middle comes."""
        camera = self._camera
        # Other points of the cell look aside.
        cell = self._step * camera.mla_distance / camera.detector_distance * ORDER / math.sqrt(2)
        return float(camera.aperture_radius + cell)

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
        kind = mi.UInt32(lattice.lens_type(i, j)) if len(camera.mla_focal_lengths) > 1 else mi.UInt32(0)
        return (x, y), lattice.centre(i, j), kind

    def through_centre(self, detector: Pair, centre: Pair) -> Pair:
        """Return where rays from the detector through the centres of lenses meet the pupil's plane."""
        z, b = self._camera.detector_distance, self._camera.mla_distance
        x, y = (rays.pupil_point(c, (c - p) / z, b) for c, p in zip(centre, detector, strict=True))
        return x, y

    def draw(self, cells: Cells, sample: Any, seed: Any) -> Drawn:
        """Return the rays of these numbers; those of even and of odd numbers are independent."""
        middle, centre, _ = self.centres(cells)
        half, index = sample & 1, mi.Float(sample >> 1)
        random = []
        for axis, step in enumerate(_STEPS):
            value = index * step + mi.sample_tea_float32(cells.index, seed ^ (half * 8 + axis + 1))
            random.append(value - dr.floor(value))
        x, y = (p + _tent(r) * self._step for p, r in zip(middle, random[2:], strict=True))
        pupil = self.through_centre((x, y), centre)
        point, weight = self._about(pupil, random[:2])
        is_open = dr.square(pupil[0]) + dr.square(pupil[1]) <= self._camera.aperture_radius**2
        place = centre[0] + point[0], centre[1] + point[1]
        return Drawn(pupil, point, place, weight, is_open)

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
            # None are drawn beyond the window.
            most = 1 - fall * fall / ((extent + fall) * (self._window - extent + fall))
            side = (2 * r - 1) * most
            # The root of the greatest density over that of the place; from 1 on it is beyond the lens.
            less = fall / ((extent + fall) * dr.maximum(1 - dr.abs(side), 1e-7))
            far = dr.copysign(extent + fall * (less - 1), side)
            places.append(dr.select(less > 1, far, side * (extent + fall)))
            weight *= 2 * most * (extent + fall) * dr.square(dr.maximum(less, 1))
        point = lattice.from_frame(places[0] * cosine - places[1] * sine, places[0] * sine + places[1] * cosine)
        return point, weight


def jitter(lane: Any, key: Any) -> tuple[Any, Any, Any, Any]:
    """Return four random numbers, of 16 bits each."""
    words = mi.sample_tea_32(lane, key)
    low = [mi.Float(word & 0xFFFF) * 2.0**-16 for word in words]
    high = [mi.Float(word >> 16) * 2.0**-16 for word in words]
    return low[0], low[1], high[0], high[1]


def _tent(value: Any) -> Any:
    """Turn evenly distributed numbers into those of the density 1 - |t|, a B-spline of order 2."""
    return dr.select(value < 0.5, dr.sqrt(2 * value) - 1, 1 - dr.sqrt(2 * (1 - value)))
