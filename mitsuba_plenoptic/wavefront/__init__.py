"""Wavefronts from captures: slopes, linear and iterative estimates of Zernike terms, by zones of the field."""

from .linear import InteractionMatrix
from .search import Zone, fit_wavefronts
from .slopes import Slopes, modes_from_slopes, spot_slopes, view_slopes

__all__ = [
    "InteractionMatrix",
    "Slopes",
    "Zone",
    "fit_wavefronts",
    "modes_from_slopes",
    "spot_slopes",
    "view_slopes",
]
