"""Reconstruction of refocused images from one capture, by the ray model and by the wave model.

A new method is a module with a function that `methods.method` registers, imported here or named by an extension.
"""

from typing import Any

from ..extension import register
from ..refocus_options import FOOTPRINTS, RESPONSES

# in the order in which help and messages name them
from . import ray, wave_methods  # noqa: F401
from .api import reconstruct
from .estimates import estimate_reconstruction
from .methods import METHODS
from .results import Reconstruction, Volume, read_reconstruction, write_reconstruction, write_volume

register("methods")


def __getattr__(name: str) -> Any:
    """Return an object that an extension adds to this package, such as `CoherentRefocus`."""
    from ..served import attribute

    return attribute(f"refocus.{name}")


__all__ = [
    "FOOTPRINTS",
    "METHODS",
    "RESPONSES",
    "Reconstruction",
    "Volume",
    "estimate_reconstruction",
    "read_reconstruction",
    "reconstruct",
    "write_reconstruction",
    "write_volume",
]
