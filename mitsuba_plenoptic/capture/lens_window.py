"""The lenses whose light reaches the recorded pixels, and whose cells are therefore sampled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from ..lattice import Lattice
from ..optics import rays

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

    Attributes
    ----------
    lattice : Lattice
        The microlens lattice.
    index : (n, 2) int array
        Indices of the lenses.
    low, high : (2,) float64 arrays
        Corners of a rectangle of the MLA plane of which every point lies in the cells.
    """

    lattice: Lattice
    index: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, camera: PlenopticCamera) -> LensWindow:
        """Find the window of a camera's recorded pixels."""
        edges = np.array([[0, 0], camera.crop_size]) + camera.crop_offset - np.array(camera.resolution) / 2
        recorded = edges * camera.pixel_size
        if camera.objective is None:
            recorded = rays.chief_point(recorded, camera.pupil_distance, camera.detector_distance)
        pitch = max(camera.mla_pitches)
        margin = (_MARGIN + 0.5) * pitch
        # A lens of whose cell no more than the lower edge is recorded counts as well.
        low, high = recorded[0] - margin * (1 - _ROUNDING), recorded[1] + margin * (1 + _ROUNDING)
        index = camera.lattice.lenses_within(tuple(low), tuple(high))
        # No point that lies nearer to the recorded part than this is in the cell of a lens beyond the window.
        whole = (_MARGIN - 1) * pitch
        return cls(camera.lattice, index, recorded[0] - whole, recorded[1] + whole)

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
