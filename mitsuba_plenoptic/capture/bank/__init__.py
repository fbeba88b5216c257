"""Waves at the price of rays: kernels of single lenses, which any number of rays share."""

from .blend import near_weight
from .convolution import Convolution, margin_of
from .lens_bank import LensBank, finest_pitch

__all__ = ["Convolution", "LensBank", "finest_pitch", "margin_of", "near_weight"]
