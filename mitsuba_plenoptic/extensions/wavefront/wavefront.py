"""Wavefronts from captures: slopes, estimates of Zernike terms, and adaptive optics."""

from .linear import InteractionMatrix
from .slopes import Slopes, modes_from_slopes, spot_slopes, view_slopes
from .wavefront_fit import Zone, fit_wavefronts

__all__ = ["InteractionMatrix", "Slopes", "Zone", "fit_wavefronts", "modes_from_slopes", "spot_slopes", "view_slopes"]
