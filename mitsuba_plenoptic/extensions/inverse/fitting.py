"""Fits to captures by the wave or the ray model: of camera parameters, or of the planes of a scene."""

from ...linear.noise import PixelNoise
from .approach import coarse_fit, lattice_from_white
from .capture_fit import fit
from .fit_light import View, known_view, noise_of
from .fit_result import Direction, Fit
from .layer_fit import fit_layers
from .layers import Layers

__all__ = [
    "Direction",
    "Fit",
    "Layers",
    "PixelNoise",
    "View",
    "coarse_fit",
    "fit",
    "fit_layers",
    "known_view",
    "lattice_from_white",
    "noise_of",
]
