"""Derivatives of captures with respect to the numbers of the camera."""

from .numbers import ABERRATIONS, NUMBERS, check_changes, check_names
from .plan import DerivativePlan

__all__ = ["ABERRATIONS", "NUMBERS", "DerivativePlan", "check_changes", "check_names"]
