"""Points where rays enter the main lens on their way to exit pupil points: the targets of shadow rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..array import Lattice
from ..fields import OpticalSystem
from ..lenses import Entrance
from ..runtime import Array, Doubles, Pair, drjit_array

_MARGIN = 3
"""Width in lenses of the margin around the recorded lenses whose points are included.

Diffraction at the microlenses' edges falls with the inverse square of the distance: 1 % of a white scene's light
comes from lenses beyond the nearest neighbour.
"""

_ROUNDING = 1e-9
"""Relative tolerance for rounding when positions are compared."""


@dataclass(frozen=True)
class LensWindow:
    """Lenses whose cells are sampled: those of recorded pixels, with a margin of a few lenses on each side.

    Here a cell is the parallelogram spanned by the two lattice vectors around a lens's centre.
    """

    lattice: Lattice
    # Lattice indices (i, j) of the lenses, an array (n, 2).
    index: Array
    # Lower and upper corner (x, y) of a rectangle of the MLA plane that lies wholly in the cells.
    low: Array
    high: Array

    @classmethod
    def of(cls, system: OpticalSystem) -> LensWindow:
        """Return the window of a camera's recorded pixels."""
        # Only where points lie depends on it.
        camera = system.camera
        lattice = system.lattice.regular
        edges = np.array([[0, 0], camera.crop_size]) + camera.crop_offset - np.array(camera.resolution) / 2
        recorded = system.lens.pupil.chief(edges * camera.pixel_size, camera.reduced_distance)
        pitch = max(camera.mla_pitches)
        margin = (_MARGIN + 0.5) * pitch
        # Lenses are included even if only the lower edge of their cell is recorded.
        low = recorded[0] - margin * (1 - _ROUNDING)
        high = recorded[1] + margin * (1 + _ROUNDING)
        index = lattice.lenses_within(tuple(low), tuple(high))
        # No point that lies nearer to the recorded part than this is in the cell of a lens beyond the window.
        inner = (_MARGIN - 1) * pitch
        return cls(lattice, index, recorded[0] - inner, recorded[1] + inner)

    def position(self, i: Any, j: Any) -> Pair:
        """Return the MLA point at i and j steps along the lattice vectors from the first corner of cell (0, 0)."""
        (ax, ay), (bx, by) = self.lattice.basis
        cx, cy = self.lattice.centre(0.0, 0.0)
        return i * ax + j * bx + (cx - (ax + bx) / 2), i * ay + j * by + (cy - (ay + by) / 2)

    def contains(self, x: Array, y: Array) -> Array:
        """Return a mask of points that lie in the cells of the window."""
        first = self.index.min(0)
        last = self.index.max(0)
        sampled = np.zeros(last - first + 3, dtype=bool)
        sampled[tuple((self.index - first + 1).T)] = True
        (ax, ay), (bx, by) = self.lattice.basis
        ox, oy = self.position(0.0, 0.0)
        x = x - ox
        y = y - oy
        area = ax * by - ay * bx
        i, j = (
            np.clip(np.floor(steps).astype(int) - low, -1, high - low + 1) + 1
            for steps, low, high in zip(((x * by - y * bx) / area, (y * ax - x * ay) / area), first, last, strict=True)
        )
        return np.asarray(sampled[i, j])


@dataclass(frozen=True)
class Entrances:
    """Points where the light of scene points enters the main lens on its way to points of the exit pupil.

    The ray that found a scene point is known. Other rays from the point follow from the magnification of the pupils,
    without the pupils' aberrations: their effect is small compared with the pupil cells that shadow rays sample.
    """

    # The entrance pupil and front plane of the lens.
    front: Entrance
    # Points (x, y) of the exit pupil through which the rays that found the points pass, an array (n, 2).
    pupil: Doubles
    # The scene points (x, y, z) in the camera frame, an array (n, 3).
    line: Doubles
    # Slopes of these rays towards the scene along x and y, an array (n, 2).
    slope: Doubles

    def at(self, x: Any, y: Any, lanes: Any) -> Any:
        """Return points in the camera frame through which light goes to points (x, y) of the exit pupil."""
        front = self.front
        if front == Entrance():
            return mi.Point3f(x, y, 0)
        depth = self.line[:, 2] - front.pupil
        # Offset of the finding ray at the entrance pupil, and the front plane's fraction of the way to the point.
        offset = self.line[:, :2] - self.slope * depth[:, None] - self.pupil / front.magnification
        fraction = (front.front - front.pupil) / depth

        def value(column: Doubles) -> Any:
            return dr.gather(mi.Float, drjit_array(mi.Float, column), lanes)

        t = value(fraction)
        ends = [
            (1 - t) * (value(offset[:, axis]) + P / front.magnification) + value(fraction * self.line[:, axis])
            for axis, P in ((0, x), (1, y))
        ]
        return mi.Point3f(*ends, front.front)
