"""Reconstruction of refocused images from one capture, by the ray model and by the wave model.

A new method is a new module with a function that `methods.method` registers, imported here.
"""

# in the order in which help and messages name them
from . import ray, wave_methods, incoherent, deconvolved  # noqa: F401, I001
from ..extension import register
from .api import reconstruct
from .estimates import estimate_reconstruction
from ..refocus_options import FOOTPRINTS, RESPONSES
from .differentiable import CoherentRefocus, DeconvolvedRefocus, RayRefocus
from .methods import METHODS
from .results import Reconstruction, Volume, read_reconstruction, write_reconstruction, write_volume

register("methods")

__all__ = [
    "FOOTPRINTS",
    "METHODS",
    "RESPONSES",
    "CoherentRefocus",
    "DeconvolvedRefocus",
    "RayRefocus",
    "Reconstruction",
    "Volume",
    "estimate_reconstruction",
    "read_reconstruction",
    "reconstruct",
    "write_reconstruction",
    "write_volume",
]
