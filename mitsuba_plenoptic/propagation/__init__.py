"""Wave optics: Fourier transforms, the angular spectrum, point spreads and their incoherent sum."""

from .angular_spectrum import propagate
from .incoherent import estimate_cost, incoherent_sum
from .point_spread import point_fields, point_spread_function

__all__ = ["estimate_cost", "incoherent_sum", "point_fields", "point_spread_function", "propagate"]
