"""Fitting a camera's numbers to captures of known light, by waves or by rays."""

from .approach import come_near
from .fit import Direction, Fit, fit
from .light import View, known_view
from .start import lattice_from_white

__all__ = ["Direction", "Fit", "View", "come_near", "fit", "known_view", "lattice_from_white"]
