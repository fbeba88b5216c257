"""Wavefronts from captures: slopes, estimates of Zernike terms, and adaptive optics."""

from .blind import CorrectedObject, deconvolve_zones, digital_adaptive_optics
from .linear import InteractionMatrix
from .slopes import Slopes, modes_from_slopes, spot_slopes, view_slopes
from .zone_search import Zone, fit_wavefronts

__all__ = [
    "CorrectedObject",
    "InteractionMatrix",
    "Slopes",
    "Zone",
    "deconvolve_zones",
    "digital_adaptive_optics",
    "fit_wavefronts",
    "modes_from_slopes",
    "spot_slopes",
    "view_slopes",
]
