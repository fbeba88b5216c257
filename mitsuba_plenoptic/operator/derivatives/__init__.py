"""Derivatives of captures with respect to the numbers of the camera."""

from .differentials import Differentials
from .numbers import NUMBERS, WAVELENGTH, brightness_slopes, check_changes, check_names, light_slopes, values_of

__all__ = [
    "NUMBERS",
    "WAVELENGTH",
    "Differentials",
    "brightness_slopes",
    "check_changes",
    "check_names",
    "light_slopes",
    "values_of",
]
