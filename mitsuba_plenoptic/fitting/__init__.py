"""Fitting a camera's numbers to captures of known light, by waves or by rays."""

from .fit import Direction, Fit, fit
from .light import View, known_view
from .start import lattice_from_white

__all__ = ["Direction", "Fit", "View", "fit", "known_view", "lattice_from_white"]
