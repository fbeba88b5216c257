"""Derivatives of captures with respect to the numbers of the camera."""

from .differentials import Differentials
from .numbers import ABERRATIONS, NUMBERS, brightness_slopes, check_changes, check_names, light_slopes, values_of
from .plan import DerivativePlan

__all__ = [
    "ABERRATIONS",
    "NUMBERS",
    "DerivativePlan",
    "Differentials",
    "brightness_slopes",
    "check_changes",
    "check_names",
    "light_slopes",
    "values_of",
]
