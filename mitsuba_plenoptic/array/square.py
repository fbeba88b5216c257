"""Square lattices; with two different pitches, lattices of rectangles."""

from typing import Any

from ..runtime import Pair, floor, maximum
from .arrangement import Lattice, register, regular_corners


@register
class SquareLattice(Lattice):
    """Rows and columns: centres at :math:`((i + 1/2) D, (j + 1/2) D)`.

    A corner of four lenses lies on the axis, so that a detector of an even number of lenses holds whole lenses.
    """

    name = "square"
    row_ratio = 1.0
    stagger = 1
    lens_types = 1
    rectangular = True
    unit_corners = regular_corners(4)

    @staticmethod
    def unit_cell(u: Any, v: Any) -> Pair:
        """Return the indices of a point's cell, the integer parts of the point's coordinates."""
        return floor(u), floor(v)

    @staticmethod
    def unit_centre(i: Any, j: Any) -> Pair:
        """Return the centre of a cell, half a pitch from its corners at integer coordinates."""
        return i + 0.5, j + 0.5

    @staticmethod
    def cell_width(u: Any, v: Any) -> Any:
        """Return the width of the square on whose border a point lies."""
        return 2 * maximum(abs(u), abs(v))

    @staticmethod
    def point_in_cell(s: Any, t: Any, width: Any) -> Pair:
        """Return a point of the square, scaled from the unit square."""
        return (s - 0.5) * width, (t - 0.5) * width
