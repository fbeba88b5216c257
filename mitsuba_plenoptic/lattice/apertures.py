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
    """A shape of apertures, the same for all lenses of a lattice."""

    product: ClassVar[bool]
    """Whether an aperture of upright rectangular cells is a product of one along x and one along y."""

    @abc.abstractmethod
    def widths(self, lattice: Lattice) -> tuple[Any, Any]:
        """Return the width along the rows and across them: from side to side, or the diameter."""

    @abc.abstractmethod
    def area(self, lattice: Lattice) -> Any:
        """Return its area."""

    @abc.abstractmethod
    def reach(self, lattice: Lattice) -> Any:
        """Return the greatest distance of one of its points from its centre."""

    @abc.abstractmethod
    def holds(self, lattice: Lattice, dx: Any, dy: Any) -> Any:
        """Whether a point at this offset from the centre, in the camera frame, is within it."""

    @abc.abstractmethod
    def point(self, lattice: Lattice, s: Any, t: Any) -> tuple[Any, Any]:
        """Map the unit square evenly to it; the result is an offset from the centre, in the camera frame."""

    @abc.abstractmethod
    def added(self, lattice: Lattice, smear: float) -> tuple[float, float]:
        """Describe a cell with an aperture, enlarged by `smear`, about each of its points."""

    def diffraction_width(self, lattice: Lattice) -> float:
        r"""Return the width w for which the first zero of its diffraction lies at :math:`\lambda / w`.

        That of the disc of its area.
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
        """Return the distance of its farthest corner."""
        return lattice.fill * lattice.cell_reach

    def holds(self, lattice: Lattice, dx: Any, dy: Any) -> Any:
        """Decide in the frame in which cells are regular."""
        u, v = lattice.to_frame(dx, dy)
        return lattice.in_cell(u, v / lattice.aspect, lattice.fill * lattice.pitches[0])

    def point(self, lattice: Lattice, s: Any, t: Any) -> tuple[Any, Any]:
        """Map to a cell shrunk by `fill`."""
        return lattice.cell_point(s, t, lattice.fill)

    def added(self, lattice: Lattice, smear: float) -> tuple[float, float]:
        """Enlarge the cell: cells are convex and the same on both sides of their centre."""
        return 0.0, 1 + smear * lattice.fill

    def diffraction_width(self, lattice: Lattice) -> float:
        """Return the narrower width of a rectangle, and of any other cell that of the disc of its area."""
        return min(self.widths(lattice)) if lattice.rectangular else super().diffraction_width(lattice)


class Circle(Aperture):
    """A disc whose diameter is `fill` times the pitch, the shorter one if there are two."""

    product = False

    def widths(self, lattice: Lattice) -> tuple[Any, Any]:
        """Return the diameter, twice."""
        along, across = lattice.pitches
        diameter = lattice.fill * (along if along is across else minimum(along, across))
        return diameter, diameter

    def area(self, lattice: Lattice) -> Any:
        """Return the disc's area."""
        return math.pi / 4 * self.widths(lattice)[0] ** 2

    def reach(self, lattice: Lattice) -> Any:
        """Return the radius."""
        return self.widths(lattice)[0] / 2

    def holds(self, lattice: Lattice, dx: Any, dy: Any) -> Any:
        """Compare with the radius."""
        radius = self.reach(lattice)
        return dx * dx + dy * dy <= radius * radius

    def point(self, lattice: Lattice, s: Any, t: Any) -> tuple[Any, Any]:
        """Map to polar coordinates."""
        module = module_of(s)
        radius = module.sqrt(s) * self.reach(lattice)
        return radius * module.cos(2 * math.pi * t), radius * module.sin(2 * math.pi * t)

    def added(self, lattice: Lattice, smear: float) -> tuple[float, float]:
        """Reach out from the cell by the enlarged radius."""
        return smear * self.reach(lattice), 1.0


APERTURES: dict[str, Aperture] = {"cell": Cell(), "circle": Circle()}
"""Shapes of apertures by the names that `mla_aperture` takes."""
