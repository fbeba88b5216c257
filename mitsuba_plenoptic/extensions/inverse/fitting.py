"""Fits to captures by the wave or the ray model, of camera parameters."""

from ...linear import PixelNoise
from .approach import coarse_fit, lattice_from_white
from .capture_fit import fit
from .fit_light import View, known_view, noise_of
from .fit_result import Direction, Fit

__all__ = [
    "Direction",
    "Fit",
    "PixelNoise",
    "View",
    "coarse_fit",
    "fit",
    "known_view",
    "lattice_from_white",
    "noise_of",
]
