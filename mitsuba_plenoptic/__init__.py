"""Plenoptic (light-field) cameras for Mitsuba 3: captures by rays and by waves, and their reconstruction.

Importing the package registers its plugins for the active variant and for every one set later; it never sets a
variant itself.
"""

# ruff: noqa: E402
import importlib.metadata

from . import _llvm

# Dr.Jit takes its LLVM from the environment when it is first imported, which all of the following do.
_llvm.choose()

from . import plugins as plugins
from .camera import PlenopticCamera
from .capture import Capture, read_capture, write_capture
from .checkpoint import Checkpoint
from .detector import Detector, expose
from .distributed import Cluster
from .errors import InputError
from .lightfield import decode
from .propagation.point_spread import point_spread_function
from .reconstruction import Reconstruction, reconstruct
from .rendering import load_scene, render_capture, scene_path

__version__ = importlib.metadata.version("mitsuba-plenoptic")

__all__ = [
    "Capture",
    "Checkpoint",
    "Cluster",
    "Detector",
    "InputError",
    "PlenopticCamera",
    "Reconstruction",
    "decode",
    "expose",
    "load_scene",
    "point_spread_function",
    "read_capture",
    "reconstruct",
    "render_capture",
    "scene_path",
    "write_capture",
]
