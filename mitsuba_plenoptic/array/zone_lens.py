"""Diffractive lenses given by a formula: kinoforms, Fresnel lenses with zones of one wave."""

from dataclasses import dataclass
from typing import Any

from ..errors import put_checked, require_length, require_wavelength
from ..prescription import LINE_D
from ..runtime import Pair, floor
from .shape import MicrolensShape, per_millimetre


@dataclass(frozen=True, eq=False)
class ZoneLens(MicrolensShape):
    r"""A kinoform: a parabolic phase with a jump by one wave of the design wavelength at the border of each zone.

    At the design wavelength :math:`\lambda_0` the phase in waves is the fractional part of :math:`-r^2 / 2 \lambda_0
    F`, from 0 to 1, and all light goes to the first diffraction order. At another wavelength the phase is
    :math:`\lambda_0 / \lambda` times as large, as for a relief of a material without dispersion, and light goes to
    other orders, too. Rays follow the first order, of the focal length :math:`F \lambda_0 / \lambda`.

    Parameters
    ----------
    focal_length : float
        Focal length F in air at the design wavelength, in millimetres. In a medium of index n it is n times as long.
    wavelength : float
        Design wavelength in nanometres.
    """

    form = "zone_lens"

    focal_length: float
    wavelength: float = LINE_D

    def __post_init__(self) -> None:
        put_checked(self, focal_length=require_length, wavelength=lambda _, value: require_wavelength(value))

    def waves(self, x: Any, y: Any, wavelength: float) -> Any:
        """Return the phase in waves; see `MicrolensShape.waves`."""
        smooth = (x * x + y * y) * (-per_millimetre(self.wavelength) / (2 * self.focal_length))
        return (smooth - floor(smooth)) * (self.wavelength / wavelength)

    def slopes(self, x: Any, y: Any) -> Pair:
        """Return the gradient of the path; see `MicrolensShape.slopes`."""
        return -x * self.power, -y * self.power

    def strength(self, wavelength: float) -> float:
        """Return the slopes at a wavelength divided by those at the d line; see `MicrolensShape.strength`."""
        return wavelength / LINE_D

    @property
    def power(self) -> float:
        """Power of the first diffraction order at the d line (587.6 nm), in 1/mm."""
        return LINE_D / (self.wavelength * self.focal_length)
