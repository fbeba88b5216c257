"""Fitting of a camera's parameters to captures of known light, with the wave model or the ray model."""

from .approach import coarse_fit, lattice_from_white
from .fit import fit
from .light import PixelNoise, View, kept_noise, known_view
from .result import Direction, Fit

__all__ = [
    "Direction",
    "Fit",
    "PixelNoise",
    "View",
    "coarse_fit",
    "fit",
    "kept_noise",
    "known_view",
    "lattice_from_white",
]
