r"""Microlens lattices: the lens that a point belongs to, the lens's centre, and the outline of its aperture.

All code asks a `Lattice`, made by `PlenopticCamera.lattice`, about the arrangement of microlenses. A lattice covers the
whole plane and does not end with the detector. Points are given in the camera frame, in the plane of the microlens
array (MLA), as floats, NumPy arrays or Dr.Jit arrays, like the lattice's parameters.

A lens is named by two integers (i, j), its steps along the two lattice vectors. It is found in three frames:

- In the *unit frame*, lengths along the rows count in pitches and lengths across them in row distances. Each lattice
  states there which cell holds a point and where the cell's centre is.
- The *lattice frame* has the rows along its first axis. Two different pitches stretch it across the rows: cells are
  then affine images of cells of equal pitches, which are the sets of points nearer to their centre than to any other.
- The *camera frame* is the lattice frame turned counter-clockwise about the axis (from +x towards +y of the camera
  frame) by `rotation`, then moved by `offset`.
"""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from ..runtime import Array, Pair, floor, is_zero, maximum, minimum, module_of, require_memory, sqrt, turn
from .lens_shifts import Displacement

# Points across a sample for the fraction of it that is aperture.
_POINTS = 8

APERTURES = ("cell", "circle")
"""Shapes of apertures, as `mla_aperture` names them."""

NO_LATTICE = "none"
"""The camera's ``mla_lattice`` without a microlens array."""


@dataclass(frozen=True)
class Lattice(abc.ABC):
    """An endless plane of microlenses.

    Parameters
    ----------
    pitches : (float, float)
        Pitch along the rows, the distance of neighbouring centres; and across them, the same except for a stretched
        lattice.
    rotation : float
        Degrees, counter-clockwise in the camera frame. In a displayed capture, whose rows run down, this is clockwise.
    offset : (float, float)
        Position of the lattice point that is on the axis by default.
    aperture : {"cell", "circle"}
        Part of a cell that is lens: the cell itself, shrunk by `fill`, or a disc.
    fill : float
        Width of the aperture (for a disc its diameter, else the distance of opposite sides) over the pitch, at most 1.
        The rest of the cell is opaque.
    displacement : Displacement, optional
        Displacement of the lenses from these regular positions. Cells move with smooth displacements, but keep their
        size in the formulas of sizes; irregular displacements move lenses within their cells.
    """

    pitches: Pair
    rotation: Any = 0.0
    offset: Pair = (0.0, 0.0)
    aperture: str = "cell"
    fill: Any = 1.0
    displacement: Displacement | None = None

    # -- what a lattice defines ----------------------------------------------------------------------

    name: ClassVar[str]
    """Its name in the camera's ``mla_lattice``."""

    row_ratio: ClassVar[float]
    """Distance of rows over the pitch across them."""

    stagger: ClassVar[int]
    """Rows from one to the next that stands straight above it."""

    lens_types: ClassVar[int]
    """Types of lenses that a multi-focus array interleaves so that no two neighbours are alike; 1: not supported."""

    rectangular: ClassVar[bool]
    """Whether cells are rectangles along the rows."""

    unit_corners: ClassVar[tuple[Pair, ...]]
    """Corners of a cell of pitch 1 from its centre, in the order of their angles."""

    @staticmethod
    @abc.abstractmethod
    def unit_cell(u: Any, v: Any) -> Pair:
        """Return the indices, integers as floats, of the cell that holds a point given in the unit frame."""

    @staticmethod
    @abc.abstractmethod
    def unit_centre(i: Any, j: Any) -> Pair:
        """Return the centre of a cell in the unit frame."""

    @staticmethod
    @abc.abstractmethod
    def cell_width(u: Any, v: Any) -> Any:
        """Return the pitch of the cell of equal pitches on whose border a point at an offset from the centre lies.

        Parameters
        ----------
        u : float or array
            Offset along the rows.
        v : float or array
            Offset across the rows.
        """

    @staticmethod
    @abc.abstractmethod
    def point_in_cell(s: Any, t: Any, width: Any) -> Pair:
        """Map (s, t) in the unit square uniformly to a point of a cell of equal pitches `width`.

        Parameters
        ----------
        s : float or array
            From 0 to 1.
        t : float or array
            From 0 to 1.
        width : float
            Pitch of the cell.
        """

    # -- sizes ---------------------------------------------------------------------------------------

    @property
    def aspect(self) -> Any:
        """Ratio of the pitch across the rows to the pitch along the rows."""
        along, across = self.pitches
        return 1.0 if along is across else across / along

    @property
    def row_distance(self) -> Any:
        """Distance between rows of lenses in millimetres."""
        return self.row_ratio * self.pitches[1]

    @property
    def basis(self) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
        """The two lattice vectors in the camera frame, steps of one in i and of one in j."""
        (u0, v0), *steps = (self.unit_centre(i, j) for i, j in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)))
        first, second = (self.from_frame((u - u0) * self.pitches[0], (v - v0) * self.row_distance) for u, v in steps)
        return first, second

    @property
    def nearest_distance(self) -> float:
        """Smallest distance between two lens centres in millimetres."""
        first, second = np.array(self.basis)
        return float(min(np.hypot(*step) for step in (first, second, second - first)))

    @property
    def grid_step(self) -> Pair:
        """Sides in mm, in the lattice frame, of the coarsest rectangular grid that contains all centres."""
        return self.pitches[0] / self.stagger, self.row_distance

    def period(self, lens_types: int = 1) -> Pair:
        """Return the sides in mm, in the lattice frame, of the rectangle with which an array of lens types repeats."""
        return self.pitches[0] * lens_types, self.row_distance * self.stagger

    @property
    def cell_area(self) -> Any:
        """Area of a cell in mm^2."""
        return self.pitches[0] * self.row_distance

    @property
    def cell_reach(self) -> float:
        """Greatest distance in mm of a point of a cell from the cell's centre."""
        return float(np.hypot(*self.cell_corners().T).max())

    @property
    def aperture_widths(self) -> Pair:
        """Widths of the aperture in mm along and across the rows; the diameter twice for a circle."""
        along, across = self.pitches
        if self.aperture == "cell":
            return self.fill * along, self.fill * across
        diameter = self.fill * (along if along is across else minimum(along, across))
        return diameter, diameter

    @property
    def aperture_width(self) -> Any:
        """Diameter of a circular aperture; larger width of other apertures."""
        along, across = self.aperture_widths
        return along if self.pitches[0] is self.pitches[1] else maximum(along, across)

    @property
    def aperture_reach(self) -> Any:
        """Greatest distance in mm of a point of the aperture from the aperture's centre."""
        return self.fill * self.cell_reach if self.aperture == "cell" else self.aperture_widths[0] / 2

    @property
    def diffraction_width(self) -> float:
        r"""Width w for which the first zero of an aperture's diffraction lies at :math:`\lambda / w`."""
        if self.aperture == "cell" and self.rectangular:
            return float(min(self.aperture_widths))
        # Of the disc of the same area.
        # 1.21967: First zero of the diffraction pattern of a disc, in wavelengths over its diameter: that of J1 over
        # pi.
        return math.sqrt(4 / math.pi * self.lens_area) / 1.21967

    @property
    def lens_area(self) -> Any:
        """Area of a lens's aperture."""
        if self.aperture == "cell":
            return self.cell_area * self.fill**2
        return math.pi / 4 * self.aperture_widths[0] ** 2

    # -- what it allows ------------------------------------------------------------------------------

    @property
    def fills(self) -> bool:
        """Whether lenses fill their cells, without opaque gaps."""
        return bool(self.lens_area == self.cell_area)

    @property
    def axis_aligned(self) -> bool:
        """Whether cells are rectangles along x and y, so that an index along x follows from x alone."""
        return self.displacement is None and self._upright

    @property
    def _upright(self) -> bool:
        return self.rectangular and self.stagger == 1 and is_zero(self.rotation)

    @property
    def separable(self) -> bool:
        """Whether cells and apertures are products of an interval along x and one along y."""
        return self.axis_aligned and self.aperture == "cell"

    @property
    def regular(self) -> Lattice:
        """The lattice without displacements."""
        return self if self.displacement is None else replace(self, displacement=None)

    # -- cells ---------------------------------------------------------------------------------------

    def cell(self, x: Any, y: Any) -> Pair:
        """Return the indices, integers as floats, of the cell that holds a point."""
        if self.displacement is not None:
            x, y = self.displacement.regular(x, y)
        u, v = self.to_frame(x - self.offset[0], y - self.offset[1])
        return self.unit_cell(u / self.pitches[0], v / self.row_distance)

    def centre(self, i: Any, j: Any) -> Pair:
        """Return the centre of a lens: of its cell but for irregular displacements."""
        u, v = self.unit_centre(i, j)
        x, y = self.from_frame(u * self.pitches[0], v * self.row_distance)
        x = x + self.offset[0]
        y = y + self.offset[1]
        if self.displacement is not None:
            moved = [self.displacement.smooth(x, y)]
            if self.displacement.deviation:
                moved.append(self.displacement.irregular(i, j))
            x, y = (
                coordinate + sum(shifts) for coordinate, shifts in zip((x, y), zip(*moved, strict=True), strict=True)
            )
        return x, y

    def in_regular_array(self, x: Any, y: Any) -> Pair:
        """Return the points of the regular array that lie by their lenses' centres as given points lie by theirs."""
        if self.displacement is None:
            return x, y
        index = self.cell(x, y)
        return tuple(
            coordinate - now + before
            for coordinate, now, before in zip((x, y), self.centre(*index), self.regular.centre(*index), strict=True)
        )

    def axis_cell(self, coordinate: Any, axis: int) -> Any:
        """Return the index along one axis (0: x, 1: y) of an `axis_aligned` lattice."""
        return self.cell(coordinate, coordinate)[axis]

    def lens_type(self, i: Any, j: Any) -> Any:
        """Return the index, from 0, of a lens's interleaved type: (i - j) modulo the number of types."""
        difference = i - j
        remainder = difference - self.lens_types * floor((difference + 0.5) / self.lens_types)
        # One of the types also where floats cannot hold the indices, as callers read tables with the result.
        return maximum(minimum(remainder, self.lens_types - 1), 0)

    def cell_point(self, s: Any, t: Any, scale: Any) -> Pair:
        """Map (s, t) in the unit square to the cell shrunk by `scale`; return the offset from the cell's centre.

        Parameters
        ----------
        s : float or array
            From 0 to 1.
        t : float or array
            From 0 to 1.
        scale : float
            Width of the result over that of the cell.
        """
        u, v = self.point_in_cell(s, t, scale * self.pitches[0])
        return self.from_frame(u, v * self.aspect)

    # -- apertures -----------------------------------------------------------------------------------

    def in_aperture(self, dx: Any, dy: Any) -> Any:
        """Return whether a point at an offset from its lens's centre is within the aperture."""
        return self.aperture_inset(dx, dy) >= 0

    def aperture_inset(self, dx: Any, dy: Any) -> Any:
        """Return the distance in mm of a point from the border of its lens's aperture, negative outside.

        With two different pitches, distances across the rows are scaled to equal pitches.

        Parameters
        ----------
        dx : float or array
            Offset from the lens's centre along x in mm.
        dy : float or array
            Offset along y.
        """
        if self.aperture == "circle":
            return self.aperture_reach - sqrt(dx * dx + dy * dy)
        # In the frame in which cells are regular.
        u, v = self.to_frame(dx, dy)
        return (self.fill * self.pitches[0] - self.cell_width(u, v / self.aspect)) / 2

    def aperture_point(self, s: Any, t: Any) -> Pair:
        """Map (s, t) in the unit square uniformly to the aperture; return the offset from the aperture's centre."""
        if self.aperture == "cell":
            return self.cell_point(s, t, self.fill)
        # By polar coordinates.
        module = module_of(s)
        radius = module.sqrt(s) * self.aperture_reach
        angle = 2 * math.pi * t
        return radius * module.cos(angle), radius * module.sin(angle)

    def aperture_grid(self, count: int) -> Array:
        """Return points (2, n) evenly over the aperture, about `count` along each side, whose mean is its centre."""
        # As many in each of the three rhombi of a hexagon.
        s, t = ((np.arange(n) + 0.5) / n for n in (count if self.rectangular else 3 * math.ceil(count / 3), count))
        return np.reshape(self.aperture_point(*np.meshgrid(s, t)), (2, -1))

    def aperture_image(self, step: float, scale: float) -> Array:
        """Return the fraction of each sample of width `step` that an aperture, enlarged by `scale`, covers.

        Parameters
        ----------
        step : float
            Width of a sample in millimetres.
        scale : float
            Factor by which the aperture is enlarged.

        Returns
        -------
        (size, size) float64 array
            Samples in odd numbers, with the lens's centre in the middle; the sum is 1.
        """
        if scale * min(self.aperture_widths) < 2 * step / _POINTS:
            # Too small to be drawn.
            return np.ones((1, 1))
        half = math.ceil(scale * self.aperture_reach / step)
        require_memory(30.0 * (_POINTS * (2 * half + 1.0)) ** 2, f"aperture of {2 * half + 1:.3g} samples across")
        fine = (np.arange(_POINTS * (2 * half + 1)) + 0.5) / _POINTS - half - 0.5
        inside = self.in_aperture(*np.broadcast_arrays(fine * step / scale, fine[:, None] * step / scale))
        counts = inside.reshape(2 * half + 1, _POINTS, 2 * half + 1, _POINTS).sum(axis=(1, 3), dtype=np.float64)
        return counts / counts.sum()

    # -- sets of lenses, for lattices of plain floats -----------------------------------------------

    def cell_corners(self) -> Array:
        """Return the offsets of a cell's corners from its centre, in order of angle.

        Returns
        -------
        (corners, 2) array
        """
        u, v = np.array(self.unit_corners).T
        return np.stack(self.from_frame(u * self.pitches[0], v * self.pitches[1]), axis=-1)

    def neighbours(self, reach: float, smear: float = 0.0) -> Array:
        """Return the lenses whose aperture, enlarged by `smear`, comes within `reach` of some point of cell (0, 0).

        Parameters
        ----------
        reach : float
            Distance.
        smear : float
            Scale of the apertures; 0 leaves their centres.

        Returns
        -------
        (lenses, 2) int array
            Steps in i and j from the cell's own lens, which is the first; then by distance.
        """
        # Cells are convex and point-symmetric, so that an enlarged cell is added to a cell as a larger one, a disc as a
        # margin.
        scale = 1 + smear * self.fill if self.aperture == "cell" else 1.0
        reach += 0.0 if self.aperture == "cell" else smear * self.aperture_reach
        corners = scale * self.cell_corners()
        edges = np.roll(corners, -1, axis=0) - corners
        basis = np.array(self.basis)
        # Lines of the lattice are at least an area over a vector apart.
        span = math.ceil((reach + scale * self.cell_reach) * np.hypot(*basis.T).max() / self.cell_area)
        steps = np.arange(-span, span + 1)
        index = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
        position = index @ basis
        # Distance from each of the cell's sides.
        to_corner = position[:, None] - corners
        along = np.clip((to_corner * edges).sum(-1) / (edges**2).sum(-1), 0, 1)
        distance = np.hypot(*np.moveaxis(to_corner - along[..., None] * edges, -1, 0)).min(1)
        # Centres inside an enlarged cell are to the left of all its sides.
        side = edges[:, 0] * to_corner[..., 1] - edges[:, 1] * to_corner[..., 0]
        distance[(side >= 0).all(1)] = 0
        inside = distance <= reach
        index = index[inside]
        position = position[inside]
        return index[np.lexsort((index[:, 0], index[:, 1], np.round(np.hypot(*position.T) / self.pitches[0], 6)))]

    def lenses_within(self, low: Pair, high: Pair) -> Array:
        """Return the lenses whose centre lies in the rectangle from `low` to `high`.

        Parameters
        ----------
        low : (float, float)
            Corner of least x and y, in millimetres.
        high : (float, float)
            Corner of greatest x and y.

        Returns
        -------
        (lenses, 2) int array
            Their indices i and j, by j and then by i.
        """
        moved = self.displacement
        far = 0.0 if moved is None else moved.most_smooth(low, high)[0] + moved.farthest_irregular
        corners = np.array([[x, y] for x in (low[0] - far, high[0] + far) for y in (low[1] - far, high[1] + far)])
        origin = np.array(self.regular.centre(0.0, 0.0))
        ends = np.linalg.solve(np.array(self.basis).T, (corners - origin).T)
        first = np.floor(ends.min(1))
        size = np.ceil(ends.max(1)) - first + 1
        require_memory(60.0 * float(np.prod(size)), f"{np.prod(size):.3g} lenses")
        j, i = np.indices(size[::-1].astype(int)).reshape(2, -1) + first[::-1, None].astype(int)
        x, y = self.centre(i.astype(np.float64), j.astype(np.float64))
        inside = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
        return np.stack([i[inside], j[inside]], axis=-1)

    # -- frames --------------------------------------------------------------------------------------

    def to_frame(self, x: Any, y: Any) -> Pair:
        """Return the lattice-frame components of a vector given in the camera frame."""
        return turn(x, y, -self.rotation)

    def from_frame(self, u: Any, v: Any) -> Pair:
        """Return the camera-frame components of a vector given in the lattice frame."""
        return turn(u, v, self.rotation)


LATTICES: dict[str, type[Lattice]] = {}
"""Lattices by name, as they were registered."""


def register(cls: type[Lattice]) -> type[Lattice]:
    """Register a lattice under its name; a decorator of classes."""
    LATTICES[cls.name] = cls
    return cls


def make_lattice(name: str, pitches: Pair, **numbers: Any) -> Lattice:
    """Return the lattice of a name with given pitches.

    Parameters
    ----------
    name : str
        Name of the lattice in `LATTICES`.
    pitches, numbers
        Parameters of `Lattice`.
    """
    return LATTICES[name](pitches, **numbers)


def regular_corners(sides: int) -> tuple[Pair, ...]:
    """Return the corners of a regular polygon whose opposite sides are 1 apart, the first of them along +x."""
    radius = 1 / (2 * math.cos(math.pi / sides))
    angles = [2 * math.pi * (corner + 0.5) / sides for corner in range(sides)]
    return tuple((radius * math.cos(angle), radius * math.sin(angle)) for angle in angles)
