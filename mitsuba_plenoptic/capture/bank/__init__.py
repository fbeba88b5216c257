"""Waves at the price of rays: kernels of single lenses, which any number of rays share."""

from .blend import near_weight
from .convolution import Convolution, margin_of
from .lens_bank import LensBank, finest_pitch
from .local_lens import at_pupil, local_camera, local_point, local_vergences

__all__ = [
    "Convolution",
    "LensBank",
    "at_pupil",
    "finest_pitch",
    "local_camera",
    "local_point",
    "local_vergences",
    "margin_of",
    "near_weight",
]
