"""Hexagonal lattices; with two different pitches, affine images of hexagonal lattices."""

import math
from typing import Any

from ..runtime import Pair, floor, maximum, select
from .arrangement import Lattice, register, regular_corners

# Distance of rows over the pitch.
_ROW = math.sqrt(0.75)


@register
class HexagonalLattice(Lattice):
    r"""Rows of which every second one is offset by half a pitch: :math:`((i + j/2) D, \tfrac{\sqrt 3}{2} j D)`.

    The centre of lens (0, 0) lies on the axis, the point of the highest symmetry: six-fold about the axis and
    mirror-symmetric in x and y. With three interleaved types of lenses, no two neighbours are alike.
    """

    name = "hexagonal"
    row_ratio = _ROW
    stagger = 2
    lens_types = 3
    rectangular = False
    unit_corners = regular_corners(6)

    @staticmethod
    def unit_cell(u: Any, v: Any) -> Pair:
        """Return the indices of the nearest centre, which lies in the row below or above the point."""
        low = floor(v)
        rows = (low, low + 1)
        columns = [floor(u - row / 2 + 0.5) for row in rows]
        below, above = (
            (u - column - row / 2) ** 2 + _ROW**2 * (v - row) ** 2 for column, row in zip(columns, rows, strict=True)
        )
        nearer = below <= above
        return select(nearer, columns[0], columns[1]), select(nearer, rows[0], rows[1])

    @staticmethod
    def unit_centre(i: Any, j: Any) -> Pair:
        """Return the centre of a cell; each row is offset by half a pitch more than the row before."""
        return i + j / 2, j

    @staticmethod
    def cell_width(u: Any, v: Any) -> Any:
        """Return the width of the hexagon on whose border a point lies."""
        return 2 * maximum(abs(u), 0.5 * abs(u) + _ROW * abs(v))

    @staticmethod
    def point_in_cell(s: Any, t: Any, width: Any) -> Pair:
        """Map (s, t) in the unit square to one of three rhombi about the centre, which together are the hexagon."""
        third = floor(s * 3)
        s = s * 3 - third
        u = -0.5 * t * width
        v = (s - 0.5 * t) * (width / (2 * _ROW))
        cosine = select(third == 0, 1.0, -0.5)
        sine = select(third == 0, 0.0, select(third == 1, _ROW, -_ROW))
        return cosine * u - sine * v, sine * u + cosine * v
