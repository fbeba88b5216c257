"""Derivatives of captures with respect to the parameters of the camera."""

from .by_parameter import DIFFERENTIABLE, WAVELENGTH, check_changes, check_names, light_slopes
from .plan import DerivativePlan, Differentials

__all__ = [
    "DIFFERENTIABLE",
    "WAVELENGTH",
    "DerivativePlan",
    "Differentials",
    "check_changes",
    "check_names",
    "light_slopes",
]
