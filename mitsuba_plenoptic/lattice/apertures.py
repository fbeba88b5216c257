"""The part of its cell that a microlens fills; the rest of the cell is opaque. A new aperture is a new class here."""

from __future__ import annotations

import abc
import math
from typing import TYPE_CHECKING, Any, ClassVar

from ..runtime.backend import minimum, module_of

if TYPE_CHECKING:
    from .arrangement import Lattice

# First zero of the diffraction pattern of a disc, in wavelengths over its diameter: that of J1 over pi.
AIRY_ZERO = 1.21967


class Aperture(abc.ABC):
    """Shape of apertures, equal for all lenses of a lattice."""

    product: ClassVar[bool]
    """Whether an aperture of upright rectangular cells is a product of one along x and one along y."""

    @abc.abstractmethod
    def widths(self, lattice: Lattice) -> tuple[Any, Any]:
        """Return the width of the aperture along the rows and across them; a circle's is its diameter."""

    @abc.abstractmethod
    def area(self, lattice: Lattice) -> Any:
        """Return the area of the aperture."""

    @abc.abstractmethod
    def reach(self, lattice: Lattice) -> Any:
        """Return the largest distance of the aperture's points from its centre."""

    @abc.abstractmethod
    def holds(self, lattice: Lattice, dx: Any, dy: Any) -> Any:
        """Return whether a point at an offset from the centre, in the camera frame, is within the aperture."""

    @abc.abstractmethod
    def point(self, lattice: Lattice, s: Any, t: Any) -> tuple[Any, Any]:
        """Return the point of the aperture for (s, t) in the unit square, evenly, as an offset from the centre."""

    @abc.abstractmethod
    def added(self, lattice: Lattice, smear: float) -> tuple[float, float]:
        """Return the region of points within `smear` of an aperture in a cell: a margin, and the scale of the cell."""

    def diffraction_width(self, lattice: Lattice) -> float:
        r"""Return the width w for which the aperture's diffraction has its first zero at :math:`\lambda / w`.

        By default the width for a disc of the same area.
        """
        return math.sqrt(4 / math.pi * self.area(lattice)) / AIRY_ZERO


class Cell(Aperture):
    """The lattice's cell itself, shrunk by `fill`."""

    product = True

    def widths(self, lattice: Lattice) -> tuple[Any, Any]:
        """Return the cell's widths times `fill`."""
        along, across = lattice.pitches
        return lattice.fill * along, lattice.fill * across

    def area(self, lattice: Lattice) -> Any:
        """Return the cell's area times the square of `fill`."""
        return lattice.cell_area * lattice.fill**2

    def reach(self, lattice: Lattice) -> Any:
        """Return the distance of the cell's farthest corner from its centre."""
        return lattice.fill * lattice.cell_reach

    def holds(self, lattice: Lattice, dx: Any, dy: Any) -> Any:
        """Decide in the frame in which cells are regular."""
        u, v = lattice.to_frame(dx, dy)
        return lattice.in_cell(u, v / lattice.aspect, lattice.fill * lattice.pitches[0])

    def point(self, lattice: Lattice, s: Any, t: Any) -> tuple[Any, Any]:
        """Return a point of the cell, shrunk by `fill`, for (s, t) in the unit square, evenly."""
        return lattice.cell_point(s, t, lattice.fill)

    def added(self, lattice: Lattice, smear: float) -> tuple[float, float]:
        """Return no margin, and the scale of the enlarged cell: cells are convex and symmetric about their centre."""
        return 0.0, 1 + smear * lattice.fill

    def diffraction_width(self, lattice: Lattice) -> float:
        """Return the smaller width of a rectangle, or the width for a disc of the same area for other cells."""
        return min(self.widths(lattice)) if lattice.rectangular else super().diffraction_width(lattice)


class Circle(Aperture):
    """A disc whose diameter is `fill` times the pitch, the shorter one if there are two."""

    product = False

    def widths(self, lattice: Lattice) -> tuple[Any, Any]:
        """Return the diameter twice."""
        along, across = lattice.pitches
        diameter = lattice.fill * (along if along is across else minimum(along, across))
        return diameter, diameter

    def area(self, lattice: Lattice) -> Any:
        """Return the area of the disc."""
        return math.pi / 4 * self.widths(lattice)[0] ** 2

    def reach(self, lattice: Lattice) -> Any:
        """Return the radius of the disc."""
        return self.widths(lattice)[0] / 2

    def holds(self, lattice: Lattice, dx: Any, dy: Any) -> Any:
        """Return whether a point is within the radius."""
        radius = self.reach(lattice)
        return dx * dx + dy * dy <= radius * radius

    def point(self, lattice: Lattice, s: Any, t: Any) -> tuple[Any, Any]:
        """Return a point of the disc by polar coordinates."""
        module = module_of(s)
        radius = module.sqrt(s) * self.reach(lattice)
        return radius * module.cos(2 * math.pi * t), radius * module.sin(2 * math.pi * t)

    def added(self, lattice: Lattice, smear: float) -> tuple[float, float]:
        """Return the enlarged radius as margin, and the scale 1 of the cell."""
        return smear * self.reach(lattice), 1.0


APERTURES: dict[str, Aperture] = {"cell": Cell(), "circle": Circle()}
"""Shapes of apertures by the names that `mla_aperture` takes."""
