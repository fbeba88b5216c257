"""Waves at the price of rays: kernels of single lenses, which any number of rays share."""

from .blend import near_weight
from .convolution import Convolution, cost_of, margin_of
from .lens_bank import LensBank, finest_pitch
from .local_lens import (
    TOLERANCE,
    at_pupil,
    less_than_told,
    local_camera,
    local_point,
    local_vergences,
    require_served,
)

__all__ = [
    "TOLERANCE",
    "Convolution",
    "LensBank",
    "at_pupil",
    "cost_of",
    "finest_pitch",
    "less_than_told",
    "local_camera",
    "local_point",
    "local_vergences",
    "margin_of",
    "near_weight",
    "require_served",
]
