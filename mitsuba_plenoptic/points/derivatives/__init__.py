"""Derivatives of captures with respect to the parameters of the camera."""

from .by_parameter import (
    DIFFERENTIABLE,
    WAVELENGTH,
    brightness_slopes,
    check_changes,
    check_names,
    light_slopes,
    values_of,
)
from .plan import DerivativePlan, Differentials

__all__ = [
    "DIFFERENTIABLE",
    "WAVELENGTH",
    "DerivativePlan",
    "Differentials",
    "brightness_slopes",
    "check_changes",
    "check_names",
    "light_slopes",
    "values_of",
]
