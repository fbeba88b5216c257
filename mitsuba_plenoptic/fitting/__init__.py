"""Fitting a camera's parameters to captures of known light, by waves or by rays."""

from .approach import coarse_fit, lattice_from_white
from .fit import fit
from .light import View, known_view
from .noise import PixelNoise, kept_noise
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
