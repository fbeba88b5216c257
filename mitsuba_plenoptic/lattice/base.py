r"""Microlens lattices: which lens a point belongs to, where its centre is, and what its aperture lets through.

Everything that has to do with the arrangement of microlenses is asked of a `Lattice`, which `PlenopticCamera.lattice`
makes. It covers the whole plane and does not end with the detector. Points are given in the camera frame, in the
plane of the microlens array (MLA), as floats, NumPy arrays or Dr.Jit arrays; so may the lattice's own numbers be.

A lens is named by two whole numbers (i, j), its steps along the two lattice vectors. In the lattice's own frame,
with pitch D:

- ``square``: centres at :math:`((i + 1/2) D, (j + 1/2) D)`. A corner of four lenses lies on the axis, so that a
  detector of an even number of lenses holds whole ones.
- ``hexagonal``: centres at :math:`((i + j/2) D, \tfrac{\sqrt 3}{2} j D)`: rows along x, every second one offset by
  half a pitch. The centre of lens (0, 0) lies on the axis, the point of the lattice with the most symmetry: six-fold
  about the axis and a mirror image of itself in both x and y.

The frame is turned counter-clockwise about the axis (from +x towards +y of the camera frame) by `rotation`, then
moved by `offset`. A cell is the set of points nearer to its centre than to any other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ..runtime.limits import require_memory

KINDS = ("square", "hexagonal")
APERTURES = ("cell", "circle")

# Kinds of lenses on a multi-focus array, such that no two neighbours of a hexagonal lattice are alike.
LENS_TYPES = 3

# Distance of rows of a hexagonal lattice over its pitch.
_ROW = math.sqrt(0.75)

# Points across a sample for the share of it that is aperture.
_POINTS = 8


@dataclass(frozen=True)
class Lattice:
    """An endless plane of microlenses.

    Parameters
    ----------
    kind : {"square", "hexagonal"}
        Arrangement of the centres.
    pitch : float
        Distance of neighbouring centres.
    rotation : float
        Degrees, counter-clockwise in the camera frame. As that frame's y falls on rows, this is clockwise in a capture
        as it is looked at.
    offset : (float, float)
        Where the point of the lattice lies that is on the axis by default.
    aperture : {"cell", "circle"}
        What of a cell is lens: the cell itself, shrunk by `fill`, or a disc.
    fill : float
        Width of the aperture (for a disc its diameter, else the distance of opposite sides) over the pitch, at most 1.
        The rest of the cell is opaque.
    """

    kind: str
    pitch: Any
    rotation: Any = 0.0
    offset: tuple[Any, Any] = (0.0, 0.0)
    aperture: str = "cell"
    fill: Any = 1.0

    # -- sizes ---------------------------------------------------------------------------------------

    @property
    def row_distance(self) -> Any:
        """Distance between rows of lenses."""
        return self.pitch if self.kind == "square" else _ROW * self.pitch

    @property
    def cell_area(self) -> Any:
        """Area of a cell."""
        return self.pitch * self.row_distance

    @property
    def aperture_width(self) -> Any:
        """Diameter of a circular aperture, distance of opposite sides of another."""
        return self.fill * self.pitch

    @property
    def lens_area(self) -> Any:
        """Area of a lens's aperture."""
        if self.aperture == "circle":
            return math.pi / 4 * self.aperture_width**2
        return self.cell_area * self.fill**2

    @property
    def aperture_reach(self) -> Any:
        """Greatest distance of a point of the aperture from its centre."""
        half = self.aperture_width / 2
        if self.aperture == "circle":
            return half
        return half * (math.sqrt(2) if self.kind == "square" else 1 / _ROW)

    @property
    def basis(self) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
        """The two lattice vectors, steps of one in i and of one in j."""
        second = (0.0 * self.pitch, self.pitch) if self.kind == "square" else (self.pitch / 2, _ROW * self.pitch)
        return self._to_camera(self.pitch, 0.0 * self.pitch), self._to_camera(*second)

    # -- cells ---------------------------------------------------------------------------------------

    def cell(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Find the cell that holds a point: its indices, whole numbers as floats."""
        u, v = self._to_lattice(x - self.offset[0], y - self.offset[1])
        if self.kind == "square":
            return _floor(u / self.pitch), _floor(v / self.pitch)
        # The nearest centre is in the row below or the row above.
        u, v = u / self.pitch, v / (_ROW * self.pitch)
        low = _floor(v)
        rows = (low, low + 1)
        columns = [_floor(u - row / 2 + 0.5) for row in rows]
        below, above = (
            (u - column - row / 2) ** 2 + _ROW**2 * (v - row) ** 2 for column, row in zip(columns, rows, strict=True)
        )
        nearer = below <= above
        return _select(nearer, columns[0], columns[1]), _select(nearer, rows[0], rows[1])

    def centre(self, i: Any, j: Any) -> tuple[Any, Any]:
        """Give the centre of a cell."""
        if self.kind == "square":
            x, y = self._to_camera((i + 0.5) * self.pitch, (j + 0.5) * self.pitch)
        else:
            x, y = self._to_camera((i + j / 2) * self.pitch, j * (_ROW * self.pitch))
        return x + self.offset[0], y + self.offset[1]

    @staticmethod
    def lens_type(i: Any, j: Any) -> Any:
        """Which of three interleaved kinds a lens is, 0, 1 or 2: (i - j) mod 3; hexagonal neighbours differ."""
        difference = i - j
        return difference - LENS_TYPES * _floor((difference + 0.5) / LENS_TYPES)

    # -- apertures -----------------------------------------------------------------------------------

    def in_aperture(self, dx: Any, dy: Any) -> Any:
        """Whether a point at this offset from its lens's centre is within the aperture."""
        half = self.aperture_width / 2
        if self.aperture == "circle":
            return dx * dx + dy * dy <= half * half
        u, v = self._to_lattice(dx, dy)
        if self.kind == "square":
            return (abs(u) <= half) & (abs(v) <= half)
        return (abs(u) <= half) & (abs(0.5 * u + _ROW * v) <= half) & (abs(0.5 * u - _ROW * v) <= half)

    def aperture_point(self, s: Any, t: Any) -> tuple[Any, Any]:
        """Map the unit square evenly to the aperture; the result is an offset from the centre."""
        if self.aperture == "circle":
            module = _module(s)
            radius = module.sqrt(s) * (self.aperture_width / 2)
            return radius * module.cos(2 * math.pi * t), radius * module.sin(2 * math.pi * t)
        return self.cell_point(s, t, self.fill)

    def cell_point(self, s: Any, t: Any, scale: Any = 1.0) -> tuple[Any, Any]:
        """Map the unit square evenly to a cell, shrunk by `scale`; the result is an offset from the centre."""
        width = scale * self.pitch
        if self.kind == "square":
            return self._to_camera((s - 0.5) * width, (t - 0.5) * width)
        # A hexagon is three rhombi about its centre; this is the upper left one, spanned by two of the corners.
        third = _floor(s * 3)
        s = s * 3 - third
        u, v = -0.5 * t * width, (s - 0.5 * t) * (width / (2 * _ROW))
        cosine = _select(third == 0, 1.0, -0.5)
        sine = _select(third == 0, 0.0, _select(third == 1, _ROW, -_ROW))
        return self._to_camera(cosine * u - sine * v, sine * u + cosine * v)

    # -- one axis at a time --------------------------------------------------------------------------

    @property
    def separable(self) -> bool:
        """Whether cells are the same along each axis for itself: an upright square lattice of plain numbers."""
        return self.kind == "square" and _is_zero(self.rotation)

    def axis_cell(self, coordinate: Any, axis: int) -> Any:
        """Index along one axis (0: x, 1: y) of a separable lattice."""
        return _floor((coordinate - self.offset[axis]) / self.pitch)

    def axis_centre(self, index: Any, axis: int) -> Any:
        """Coordinate of a centre along one axis (0: x, 1: y) of a separable lattice."""
        return (index + 0.5) * self.pitch + self.offset[axis]

    # -- sets of lenses, for lattices of plain numbers -----------------------------------------------

    def cell_corners(self) -> np.ndarray:
        """Corners of a cell from its centre, in the order of their angles.

        Returns
        -------
        (4 or 6, 2) array
        """
        corners = 4 if self.kind == "square" else 6
        angle = 2 * math.pi * (np.arange(corners) + 0.5) / corners
        radius = self.pitch / (2 * math.cos(math.pi / corners))
        return np.stack(self._to_camera(radius * np.cos(angle), radius * np.sin(angle)), axis=-1)

    def aperture_image(self, step: float, scale: float) -> np.ndarray:
        """Draw an aperture, enlarged by `scale`, into samples of width `step`: their shares of its area.

        Returns
        -------
        (size, size) float64 array
            Of odd size, the lens's centre in the middle; the sum is 1.
        """
        if scale * self.aperture_width < 2 * step / _POINTS:
            # too small to be drawn
            return np.ones((1, 1))
        half = math.ceil(scale * self.aperture_reach / step)
        require_memory(30.0 * (_POINTS * (2 * half + 1.0)) ** 2, f"aperture of {2 * half + 1:.3g} samples across")
        fine = (np.arange(_POINTS * (2 * half + 1)) + 0.5) / _POINTS - half - 0.5
        inside = self.in_aperture(*np.broadcast_arrays(fine * step / scale, fine[:, None] * step / scale))
        counts = inside.reshape(2 * half + 1, _POINTS, 2 * half + 1, _POINTS).sum(axis=(1, 3), dtype=np.float64)
        return counts / counts.sum()

    def neighbours(self, reach: float, scale: float = 1.0) -> np.ndarray:
        """Find the lenses whose centre is within `reach` of some point of a cell, itself enlarged by `scale`.

        Returns
        -------
        (lenses, 2) int array
            Steps in i and j from the cell's own lens, which is the first; then by distance.
        """
        corners = scale * self.cell_corners()
        edges = np.roll(corners, -1, axis=0) - corners
        span = math.ceil((reach + np.hypot(*corners[0])) / (_ROW * self.pitch))
        steps = np.arange(-span, span + 1)
        index = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
        place = index @ np.array(self.basis)
        # Distance from each of the cell's sides.
        to_corner = place[:, None] - corners
        along = np.clip((to_corner * edges).sum(-1) / (edges**2).sum(-1), 0, 1)
        distance = np.hypot(*np.moveaxis(to_corner - along[..., None] * edges, -1, 0)).min(1)
        # Centres inside an enlarged cell are to the left of all its sides.
        turn = edges[:, 0] * to_corner[..., 1] - edges[:, 1] * to_corner[..., 0]
        distance[(turn >= 0).all(1)] = 0
        kept = distance <= reach
        index, place = index[kept], place[kept]
        return index[np.lexsort((index[:, 0], index[:, 1], np.round(np.hypot(*place.T) / self.pitch, 6)))]

    def lenses_within(self, low: tuple[float, float], high: tuple[float, float]) -> np.ndarray:
        """Find the lenses whose centre lies in the rectangle from `low` to `high`.

        Returns
        -------
        (lenses, 2) int array
            Their indices i and j, by j and then by i.
        """
        corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
        origin = np.array(self.centre(0.0, 0.0))
        ends = np.linalg.solve(np.array(self.basis).T, (corners - origin).T)
        first, last = np.floor(ends.min(1)), np.ceil(ends.max(1))
        require_memory(60.0 * float(np.prod(last - first + 1)), f"{np.prod(last - first + 1):.3g} lenses")
        first, last = first.astype(int), last.astype(int)
        j, i = (index.ravel() for index in np.mgrid[first[1] : last[1] + 1, first[0] : last[0] + 1])
        x, y = self.centre(i.astype(np.float64), j.astype(np.float64))
        kept = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
        return np.stack([i[kept], j[kept]], axis=-1)

    # -- frames --------------------------------------------------------------------------------------

    def _to_lattice(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Turn a vector of the camera frame into one of the lattice's frame."""
        return turn(x, y, -self.rotation)

    def _to_camera(self, u: Any, v: Any) -> tuple[Any, Any]:
        """Turn a vector of the lattice's frame into one of the camera frame."""
        return turn(u, v, self.rotation)


def turn(x: Any, y: Any, degrees: Any) -> tuple[Any, Any]:
    """Turn places counter-clockwise about the axis; floats, NumPy arrays or Dr.Jit arrays."""
    if _is_zero(degrees):
        return x, y
    angle = degrees * (math.pi / 180)
    # a number of NumPy would turn Dr.Jit's arrays into its own
    module = dr if dr.is_array_v(angle) else math
    cosine, sine = module.cos(angle), module.sin(angle)
    return cosine * x - sine * y, sine * x + cosine * y


def _is_zero(value: Any) -> bool:
    """Whether a number is plain and zero, so that what it multiplies can be left out."""
    return isinstance(value, (int, float)) and value == 0


def _module(value: Any) -> Any:
    return dr if dr.is_array_v(value) else np


def _floor(value: Any) -> Any:
    return _module(value).floor(value)


def _select(condition: Any, yes: Any, no: Any) -> Any:
    return dr.select(condition, yes, no) if dr.is_array_v(condition) else np.where(condition, yes, no)
