"""Derivatives of captures with respect to the numbers of the camera."""

from .differentials import Differentials
from .numbers import ABERRATIONS, NUMBERS, check_changes, check_names

__all__ = ["ABERRATIONS", "NUMBERS", "Differentials", "check_changes", "check_names"]
