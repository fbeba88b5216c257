"""Where rays to points of the exit pupil enter the main lens: what shadow rays go to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..lattice import Lattice
from ..lenses.base import Entrance
from ..system.optical_system import OpticalSystem

_MARGIN = 3
"""Lenses beyond the recorded ones whose points count.

Diffraction at the microlenses' edges, which falls with the inverse square of the distance, brings 1 % of a white
scene's light from lenses farther off than the next one.
"""

_ROUNDING = 1e-9
"""How far, relatively, two ways to compute a place may be apart."""


@dataclass(frozen=True)
class LensWindow:
    """The lenses whose cells are sampled: those of the recorded pixels and a few more on each side.

    A cell is here the parallelogram that the two lattice vectors span around a lens's centre.
    """

    lattice: Lattice
    # Indices of the lenses; (n, 2).
    index: np.ndarray
    # Corners of a rectangle of the MLA plane of which every point lies in the cells; (2,).
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, system: OpticalSystem) -> LensWindow:
        """Find the window of a camera's recorded pixels."""
        camera, lattice = system.camera, system.lattice
        edges = np.array([[0, 0], camera.crop_size]) + camera.crop_offset - np.array(camera.resolution) / 2
        recorded = system.lens.chief_point(edges * camera.pixel_size, camera.detector_distance)
        pitch = max(camera.mla_pitches)
        margin = (_MARGIN + 0.5) * pitch
        # A lens of whose cell no more than the lower edge is recorded counts as well.
        low, high = recorded[0] - margin * (1 - _ROUNDING), recorded[1] + margin * (1 + _ROUNDING)
        index = lattice.lenses_within(tuple(low), tuple(high))
        # No point that lies nearer to the recorded part than this is in the cell of a lens beyond the window.
        whole = (_MARGIN - 1) * pitch
        return cls(lattice, index, recorded[0] - whole, recorded[1] + whole)

    def place(self, i: Any, j: Any) -> tuple[Any, Any]:
        """Point of the MLA plane at i and j steps along the lattice vectors from the first corner of cell (0, 0)."""
        (ax, ay), (bx, by) = self.lattice.basis
        cx, cy = self.lattice.centre(0.0, 0.0)
        return i * ax + j * bx + (cx - (ax + bx) / 2), i * ay + j * by + (cy - (ay + by) / 2)

    def holds(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Whether points lie in the cells of the window."""
        first, last = self.index.min(0), self.index.max(0)
        sampled = np.zeros(last - first + 3, dtype=bool)
        sampled[tuple((self.index - first + 1).T)] = True
        (ax, ay), (bx, by) = self.lattice.basis
        ox, oy = self.place(0.0, 0.0)
        x, y, area = x - ox, y - oy, ax * by - ay * bx
        i, j = (
            np.clip(np.floor(steps).astype(int) - low, -1, high - low + 1) + 1
            for steps, low, high in zip(((x * by - y * bx) / area, (y * ax - x * ay) / area), first, last, strict=True)
        )
        return np.asarray(sampled[i, j])


@dataclass(frozen=True)
class Entrances:
    """Where the light of some points enters on its way to points of the exit pupil.

    From the ray that has found a point the others are found by the magnification of the pupils, which they miss by
    the pupils' own aberrations: what these are worth is small against the cells of the pupil that rays are asked for.
    """

    # The scene's side of the lens.
    front: Entrance
    # Where the rays that have found the points pass the exit pupil; (n, 2).
    pupil: NDArray[np.float64]
    # Points in the camera frame; (n, 3).
    line: NDArray[np.float64]
    # Slopes of these rays towards the scene; (n, 2).
    slope: NDArray[np.float64]

    def at(self, x: Any, y: Any, which: Any) -> Any:
        """Return points in the camera frame through which light goes to points (x, y) of the exit pupil."""
        front = self.front
        if front == Entrance():
            return mi.Point3f(x, y, 0)
        depth = self.line[:, 2] - front.pupil
        # Where the ray that has found the point passes the entrance pupil; how far from there the front plane is.
        own = self.line[:, :2] - self.slope * depth[:, None] - self.pupil / front.magnification
        part = (front.front - front.pupil) / depth

        def value(column: NDArray[np.float64]) -> Any:
            return dr.gather(mi.Float, mi.Float(np.ascontiguousarray(column, np.float32)), which)

        t = value(part)
        ends = [
            (1 - t) * (value(own[:, axis]) + P / front.magnification) + value(part * self.line[:, axis])
            for axis, P in ((0, x), (1, y))
        ]
        return mi.Point3f(*ends, front.front)
