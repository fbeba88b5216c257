"""Surfaces of revolution: spheres, conics and aspheres."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from ..errors import put_checked, refuse_if, require_number, require_numbers
from ..prescription import LINE_D
from ..runtime import Pair, module_of
from .shape import MicrolensShape, excess_index, known_index, per_millimetre


@dataclass(frozen=True, eq=False)
class Conic(MicrolensShape):
    r"""A thin lens with a surface of revolution towards the main lens.

    Its depth below the vertex at the distance r from the centre is

    .. math:: s(r) = \frac{r^2 / R}{1 + \sqrt{1 - (1 + k)\, r^2 / R^2}} + \sum_i a_i\, r^{4 + 2 i},

    and light of the wavelength :math:`\lambda` gains the phase :math:`-(n - 1)\, s / \lambda` in waves: at the thin
    element, material of index n takes the place of air.

    Parameters
    ----------
    curvature_radius : float
        Radius R of curvature at the vertex in millimetres.
    conic : float
        Conic constant k: 0 for a sphere, -1 for a parabola.
    coefficients : sequence of float
        Coefficients :math:`a_0, a_1, ...` of :math:`r^4, r^6, ...`, in :math:`mm^{-3}, mm^{-5}, ...`
    glass : Glass, str, float or dict
        The lens's material, as `Glass.from_plain` takes it, or its index.
    """

    form = "conic"

    curvature_radius: float
    conic: float = 0.0
    coefficients: Sequence[float] = ()
    glass: Any = 1.5

    def __post_init__(self) -> None:
        coefficients = self.coefficients
        refuse_if(
            not hasattr(coefficients, "__len__") or isinstance(coefficients, str),
            f"coefficients = {coefficients}: it must be a list",
        )
        put_checked(
            self,
            curvature_radius=partial(require_number, positive=True),
            conic=require_number,
            coefficients=partial(require_numbers, count=len(coefficients)),
            glass=known_index,
        )

    def waves(self, x: Any, y: Any, wavelength: float) -> Any:
        """Return the phase in waves; see `MicrolensShape.waves`."""
        square = x * x + y * y
        depth = square / (self.curvature_radius * (1 + self._root(square)))
        power = square
        for coefficient in self.coefficients:
            power = power * square
            depth = depth + coefficient * power
        return depth * (-excess_index(self.glass, wavelength) * per_millimetre(wavelength))

    def slopes(self, x: Any, y: Any) -> Pair:
        """Return the gradient of the path; see `MicrolensShape.slopes`."""
        square = x * x + y * y
        rise = 1 / (self.curvature_radius * self._root(square))
        power = 1.0
        for order, coefficient in enumerate(self.coefficients, 2):
            power = power * square
            rise = rise + 2 * order * coefficient * power
        rise = rise * -excess_index(self.glass, LINE_D)
        return rise * x, rise * y

    @property
    def power(self) -> float:
        """Power :math:`(n - 1) / R` at the vertex and the d line (587.6 nm), in 1/mm."""
        return excess_index(self.glass, LINE_D) / self.curvature_radius

    def covers(self, x: Any, y: Any) -> Any:
        """Return a mask of offsets that the surface covers: a sphere or an ellipsoid ends where it is upright."""
        return (x * x + y * y) * (1 + self.conic) < self.curvature_radius**2

    def _root(self, square: Any) -> Any:
        module = module_of(square)
        # Corners of the cell beyond the aperture may lie beyond the surface.
        return module.sqrt(module.maximum(1 - square * ((1 + self.conic) / self.curvature_radius**2), 1e-6))
