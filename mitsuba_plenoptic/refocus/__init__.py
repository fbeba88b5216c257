"""Reconstruction of refocused images from one capture, by the ray model and by the wave model.

A new method is a module with a function that `methods.method` registers, imported here or named by an extension.
"""

import importlib
from typing import Any

from ..errors import did_you_mean
from ..extension import entries, missing, place
from ..refocus_options import FOOTPRINTS

# in the order in which help and messages name them
from . import ray, wave_methods  # noqa: F401
from .api import reconstruct
from .estimates import estimate_reconstruction
from .methods import METHODS
from .results import Reconstruction, Volume, read_reconstruction, write_reconstruction, write_volume

# Modules that register methods.
for _package, _, _module in entries("methods"):
    importlib.import_module(f"{_package}.{_module}")


def __getattr__(name: str) -> Any:
    """Return an object that an extension adds to this package, such as `CoherentRefocus`."""
    for package, added, text in entries("names"):
        if added == f"refocus.{name}":
            return place(package, text)
    absent = missing("names", f"refocus.{name}")
    raise AttributeError(absent or f"module {__name__!r} has no attribute {name!r}{did_you_mean(name, __all__)}")


__all__ = [
    "FOOTPRINTS",
    "METHODS",
    "Reconstruction",
    "Volume",
    "estimate_reconstruction",
    "read_reconstruction",
    "reconstruct",
    "write_reconstruction",
    "write_volume",
]
