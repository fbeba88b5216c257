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
process, with three exceptions: with CUDA variants, last bits change from run to run; reconstructions by single lenses
(``interleave="auto"``) follow the number of the BLAS's threads in their last bits; and scenes that ``mi.load_file``
loads, unless with ``optimize=False`` as `load_scene` does, have their lamps in another order each time, so that the
noise of their light differs.
"""

# ruff: noqa: E402
import importlib
from typing import TYPE_CHECKING, Any

from .runtime import llvm

# Dr.Jit takes its LLVM from the environment when it is first imported, which plugins do.
llvm.choose()

from . import plugins as plugins
from . import served

served.install()

if TYPE_CHECKING:
    from . import design as design
    from . import shipped
    from .camera import PlenopticCamera
    from .camera.aperture import Aperture
    from .camera.lens_transmissions import LensTransmissions
    from .camera.phase_screen import PhaseScreen, frozen_flow
    from .camera.vignetting import Vignetting
    from .errors import InputError
    from .io.captures import Capture, read_capture, read_raw, write_capture, write_raw
    from .io.checkpoints import Checkpoint
    from .io.examples import example, example_truth
    from .io.truth_files import GroundTruth, read_ground_truth, write_ground_truth
    from .lenses.lens_system import LensSystem
    from .light.detector import Detector, expose
    from .light.render_capture import estimate_capture, render_capture
    from .light.scene import load_scene
    from .optics.guards import PhysicsError, PhysicsWarning
    from .optics.spectrum import Spectrum
    from .plugins.other_camera import with_camera
    from .points.operator import CaptureOperator
    from .points.point_spread import point_spread_function
    from .prescription import Prescription
    from .prescription.lens_file import read_prescription
    from .prescription.objective import Objective
    from .refocus import Reconstruction, estimate_reconstruction, reconstruct
    from .runtime.batches import Cluster, Job
    from .runtime.progress import progress_bar
    from .scene_files import scene_path
    from .shipped import *  # noqa: F403
    from .views import decode, ground_truth

    __all__ = [
        "Aperture",
        "Capture",
        "CaptureOperator",
        "Checkpoint",
        "Cluster",
        "Detector",
        "GroundTruth",
        "InputError",
        "Job",
        "LensSystem",
        "LensTransmissions",
        "Objective",
        "PhaseScreen",
        "PhysicsError",
        "PhysicsWarning",
        "PlenopticCamera",
        "Prescription",
        "Reconstruction",
        "Spectrum",
        "Vignetting",
        "decode",
        "estimate_capture",
        "estimate_reconstruction",
        "example",
        "example_truth",
        "expose",
        "frozen_flow",
        "ground_truth",
        "load_scene",
        "point_spread_function",
        "progress_bar",
        "read_capture",
        "read_ground_truth",
        "read_prescription",
        "read_raw",
        "reconstruct",
        "render_capture",
        "scene_path",
        "with_camera",
        "write_capture",
        "write_ground_truth",
        "write_raw",
    ]
    __all__ += shipped.__all__

    __version__: str


def __dir__() -> list[str]:
    dunders = {name for name in globals() if name.startswith("__")}
    return sorted({*served.public_names(), *served.modules(), *dunders, "__all__", "__version__"})


def __getattr__(name: str) -> Any:
    if name == "__version__":
        found = importlib.import_module("importlib.metadata").version("mitsuba-plenoptic")
    elif name == "__all__":
        return served.public_names()
    else:
        found = served.attribute(name)
    # From the second time on Python finds it in the module itself.
    return globals().setdefault(name, found)
