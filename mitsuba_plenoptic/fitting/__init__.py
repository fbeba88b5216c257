"""Fitting to captures with the wave model or the ray model: a camera's parameters, or the planes of a scene."""

from .approach import coarse_fit, lattice_from_white
from .fit import fit
from .layer_fit import fit_layers
from .layers import Layers
from .light import PixelNoise, View, known_view, noise_of
from .result import Direction, Fit

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
