"""Reconstruction of refocused images from one capture, by the ray model and by the wave model.

A new method is a module with a function that `methods.method` registers, imported here or named by an extension.
"""

import importlib
from typing import Any

import lazy_loader

from ..errors import did_you_mean
from ..extension import entries, missing, place

# `__init__.pyi` names, besides what is public, what other folders and extensions may use.
_of_stub, __dir__, _in_stub = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """Return a name of the stub, or an object that an extension adds to this package, such as `CoherentRefocus`."""
    if name in _in_stub:
        return _of_stub(name)
    for package, added, text in entries("names"):
        if added == f"refocus.{name}":
            return place(package, text)
    absent = missing("names", f"refocus.{name}")
    raise AttributeError(absent or f"module {__name__!r} has no attribute {name!r}{did_you_mean(name, __all__)}")


__all__ = [
    "METHODS",
    "Reconstruction",
    "Volume",
    "estimate_reconstruction",
    "read_reconstruction",
    "reconstruct",
    "write_reconstruction",
    "write_volume",
]

# Modules that register methods, in the order in which help and messages name them.
for _module in (f"{__name__}.ray", f"{__name__}.wave_methods", *(f"{at}.{name}" for at, _, name in entries("methods"))):
    importlib.import_module(_module)
