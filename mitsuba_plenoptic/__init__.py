"""Plenoptic (light-field) cameras for Mitsuba 3: captures by rays and by waves, and their reconstruction.

Importing the package registers its plugins for the active variant and for every one set later; it never sets a
variant itself. It may be imported before or after mitsuba, and before or after a variant is set.

Threads and processes
---------------------
The functions below may be called from several Python threads: those that compute take turns, since Mitsuba's loader
and Dr.Jit's tracing are not made for two at a time, and each has all processor cores. The active variant is one for the
whole process, and a scene belongs to the variant that it was loaded in. Once a variant is set, processes must be
spawned, not forked.

The same seed gives the same bits of captures, exposures and reconstructions on any number of threads and in any
process, with two exceptions: reconstructions by single lenses (``interleave="auto"``) follow the number of the BLAS's
threads in their last bits; and scenes that ``mi.load_file`` loads, unless with ``optimize=False`` as `load_scene` does,
have their lamps in another order each time, so that the noise of their light differs.
"""

# ruff: noqa: E402
import importlib
import pkgutil
from typing import TYPE_CHECKING, Any

from .runtime import llvm

# Dr.Jit takes its LLVM from the environment when it is first imported, which plugins do.
llvm.choose()

from . import plugins as plugins

if TYPE_CHECKING:
    from . import design as design
    from . import far_sources as far_sources
    from . import laser as laser
    from .calibration import calibrate
    from .camera import PlenopticCamera
    from .capture.render import estimate_capture, render_capture
    from .capture.scene import load_scene
    from .detector import Detector, expose
    from .errors import InputError
    from .fitting import fit
    from .focusing import focus_by_group
    from .io.captures import Capture, read_capture, read_raw, write_capture, write_raw
    from .io.checkpoints import Checkpoint
    from .io.examples import example, example_truth
    from .io.ground_truth import GroundTruth, read_ground_truth, write_ground_truth
    from .io.lens_file import read_prescription
    from .lenses.lens_system import LensSystem
    from .lightfield import decode, demosaic, ground_truth
    from .objective import Objective
    from .onchip import bank_disparity, dual_pixel, half_disparity, match_halves, psf_bank
    from .operator.operator import CaptureOperator
    from .operator.point_spread import point_spread_function
    from .operator.stored import StoredOperator
    from .operator.volumes import volume_points
    from .optics.guards import PhysicsError, PhysicsWarning
    from .optics.spectrum import Spectrum
    from .phase_screen import PhaseScreen, frozen_flow
    from .plugins.other_camera import with_camera
    from .prescription import Prescription
    from .reconstruction import Reconstruction, estimate_reconstruction, reconstruct
    from .report.viewer import Viewer, view
    from .runtime.batches import Cluster
    from .runtime.jobs import Job
    from .runtime.progress import progress_bar
    from .scene_files import scene_path
    from .sharpness import EdgeSharpness, edge_sharpness

    __version__: str

# The modules of public names, which are imported when a name is first asked for: no program needs all of them.
_MODULES = {
    "calibration": ("calibrate",),
    "camera": ("PlenopticCamera",),
    "capture.render": ("estimate_capture", "render_capture"),
    "capture.scene": ("load_scene",),
    "detector": ("Detector", "expose"),
    "errors": ("InputError",),
    "fitting": ("fit",),
    "focusing": ("focus_by_group",),
    "io.captures": ("Capture", "read_capture", "read_raw", "write_capture", "write_raw"),
    "io.checkpoints": ("Checkpoint",),
    "io.examples": ("example", "example_truth"),
    "io.ground_truth": ("GroundTruth", "read_ground_truth", "write_ground_truth"),
    "io.lens_file": ("read_prescription",),
    "lenses.lens_system": ("LensSystem",),
    "lightfield": ("decode", "demosaic", "ground_truth"),
    "objective": ("Objective",),
    "onchip": ("bank_disparity", "dual_pixel", "half_disparity", "match_halves", "psf_bank"),
    "operator.operator": ("CaptureOperator",),
    "operator.point_spread": ("point_spread_function",),
    "operator.stored": ("StoredOperator",),
    "operator.volumes": ("volume_points",),
    "optics.guards": ("PhysicsError", "PhysicsWarning"),
    "optics.spectrum": ("Spectrum",),
    "phase_screen": ("PhaseScreen", "frozen_flow"),
    "plugins.other_camera": ("with_camera",),
    "prescription": ("Prescription",),
    "reconstruction": ("Reconstruction", "estimate_reconstruction", "reconstruct"),
    "report.viewer": ("Viewer", "view"),
    "runtime.batches": ("Cluster",),
    "runtime.jobs": ("Job",),
    "runtime.progress": ("progress_bar",),
    "scene_files": ("scene_path",),
    "sharpness": ("EdgeSharpness", "edge_sharpness"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "Capture",
    "CaptureOperator",
    "Checkpoint",
    "Cluster",
    "Detector",
    "EdgeSharpness",
    "GroundTruth",
    "InputError",
    "Job",
    "LensSystem",
    "Objective",
    "PhaseScreen",
    "PhysicsError",
    "PhysicsWarning",
    "PlenopticCamera",
    "Prescription",
    "Reconstruction",
    "Spectrum",
    "StoredOperator",
    "Viewer",
    "bank_disparity",
    "calibrate",
    "decode",
    "demosaic",
    "dual_pixel",
    "edge_sharpness",
    "estimate_capture",
    "estimate_reconstruction",
    "example",
    "example_truth",
    "expose",
    "fit",
    "focus_by_group",
    "frozen_flow",
    "ground_truth",
    "half_disparity",
    "load_scene",
    "match_halves",
    "point_spread_function",
    "progress_bar",
    "psf_bank",
    "read_capture",
    "read_ground_truth",
    "read_prescription",
    "read_raw",
    "reconstruct",
    "render_capture",
    "scene_path",
    "view",
    "volume_points",
    "with_camera",
    "write_capture",
    "write_ground_truth",
    "write_raw",
]


def _modules() -> set[str]:
    """Return the names of the modules and subpackages."""
    return {module.name for module in pkgutil.iter_modules(__path__)} - {"__main__"}


def __dir__() -> list[str]:
    dunders = {name for name in globals() if name.startswith("__")}
    return sorted({*__all__, *_modules(), *dunders, "__version__"})


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        found = getattr(importlib.import_module(f".{_MODULE_OF[name]}", __name__), name)
    elif name == "__version__":
        found = importlib.import_module("importlib.metadata").version("mitsuba-plenoptic")
    elif name in _modules():
        return importlib.import_module(f".{name}", __name__)
    else:
        suggest = importlib.import_module(".errors", __name__).did_you_mean
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{suggest(name, __all__)}")
    # From the second time on Python finds it in the module itself.
    return globals().setdefault(name, found)
