"""The names that `mitsuba_plenoptic` serves: public names, public modules, and module names of version 1.0."""

from __future__ import annotations

import importlib
import pkgutil
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

ROOT = __name__.rpartition(".")[0]

# Public names of the core by their modules, which are imported when a name is first asked for.
_NAMES = {
    "camera": ("PlenopticCamera",),
    "camera.aperture": ("Aperture",),
    "camera.lens_transmissions": ("LensTransmissions",),
    "camera.vignetting": ("Vignetting",),
    "light.render_capture": ("estimate_capture", "render_capture"),
    "light.scene": ("load_scene",),
    "scene_files": ("scene_path",),
    "light.detector": ("Detector", "expose"),
    "errors": ("InputError",),
    "io.captures": ("Capture", "read_capture", "read_raw", "write_capture", "write_raw"),
    "io.checkpoints": ("Checkpoint",),
    "io.examples": ("example", "example_truth"),
    "io.truth_files": ("GroundTruth", "read_ground_truth", "write_ground_truth"),
    "prescription.lens_file": ("read_prescription",),
    "lenses.lens_system": ("LensSystem",),
    "views": ("decode", "ground_truth"),
    "prescription.objective": ("Objective",),
    "points.operator": ("CaptureOperator",),
    "points.point_spread": ("point_spread_function",),
    "optics.guards": ("PhysicsError", "PhysicsWarning"),
    "optics.spectrum": ("Spectrum",),
    "camera.phase_screen": ("PhaseScreen", "frozen_flow"),
    "plugins.other_camera": ("with_camera",),
    "prescription": ("Prescription",),
    "refocus": ("Reconstruction", "estimate_reconstruction", "reconstruct"),
    "runtime.batches": ("Cluster", "Job"),
    "runtime.progress": ("progress_bar",),
}
_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names}

MOVED = {
    "system": "light",
    "capture": "light",
    "dataset.torch_data": "extensions.data.torch_data",
    "benchmark.contents": "extensions.data.contents",
    "report.sweep": "extensions.studio.sweep",
    "report.viewer": "extensions.studio.viewer",
    "reconstruction": "refocus",
    "reconstruction.partitions": "extensions.paper.partitions",
    "reconstruction.waves": "refocus.wave_methods",
    "reconstruction.deconvolution": "extensions.deconvolution",
    "operator": "points",
    "operator.stored": "extensions.inverse.stored",
    "operator.volumes": "extensions.inverse.volume_points",
    "microlens.base": "microlens.shape",
    "lightfield": "views",
    "lightfield.exchange": "extensions.raw.exchange",
    "lightfield.geometry": "views.coordinates",
    "lenses.base": "lenses.main_lens",
    "lens_data": "prescription.lens_data",
    "lattice.base": "lattice.arrangement",
    "phase_screen": "camera.phase_screen",
    "detector": "light.detector",
    "sharpness": "extensions.sharpness.sharpness",
    "collimator": "prescription.collimator",
    "focusing": "extensions.lensdesign.focusing",
    "io.zemax_file": "extensions.lensdesign.zemax_file",
    "io.lens_file": "prescription.lens_file",
    "io.codev_file": "extensions.lensdesign.codev_file",
    "io.ground_truth": "io.truth_files",
    "capture.render": "light.render_capture",
    "capture.scene": "light.scene",
}
"""Modules that pages of version 1.0 named, and what they are called now."""

# Public modules of the core that are not directly in the package.
_MODULES = {"objective": "prescription.objective"}


def public_names() -> list[str]:
    """Return the public names of the core and of the installed extensions."""
    from .extension import entries

    added = (name for _, _, names in entries("names") for name in names)
    return sorted({*_MODULE_OF, *(name for name in added if "." not in name)})


def modules() -> set[str]:
    """Return the names of the public modules and subpackages, and of other modules of the core."""
    from .extension import entries

    here = {module.name for module in pkgutil.iter_modules(sys.modules[ROOT].__path__)} - {"__main__"}
    return {*here, *_MODULES, *(name for _, name, _ in entries("modules"))}


def attribute(name: str) -> Any:
    """Return a public name or module of the package."""
    from .extension import entries, missing

    if name in _MODULE_OF:
        return getattr(importlib.import_module(f"{ROOT}.{_MODULE_OF[name]}"), name)
    for package, module, names in entries("names"):
        if name in names:
            return getattr(importlib.import_module(f"{package}.{module}"), name.rpartition(".")[2])
    if name in modules() or name in MOVED:
        return importlib.import_module(f"{ROOT}.{name}")
    from .errors import did_you_mean

    absent = missing("names", name) or missing("modules", name)
    module, _, own = f"{ROOT}.{name}".rpartition(".")
    raise AttributeError(absent or f"module {module!r} has no attribute {own!r}{did_you_mean(own, public_names())}")


def _moved(name: str) -> str:
    """Return the present name of a module of version 1.0; empty for other modules."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        if now := MOVED.get(".".join(parts[:count])):
            return ".".join([now, *parts[count:]])
    return ""


class _Alias(Loader):
    """Loader of a module under another name."""

    def __init__(self, name: str) -> None:
        self._module = importlib.import_module(name)
        self._spec = self._module.__spec__

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Return the module under its new name."""
        return self._module

    def exec_module(self, module: ModuleType) -> None:
        """Restore attributes overwritten by the import system; some modules were packages in version 1.0."""
        module.__spec__ = self._spec
        if not hasattr(module, "__path__"):
            module.__path__ = []


class _MovedFinder(MetaPathFinder):
    """Finder of modules by their names in version 1.0."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of a module that now has another name, otherwise None."""
        root, _, name = fullname.partition(".")
        moved = _moved(name) if root == ROOT else ""
        if not moved:
            return None
        warnings.warn(f"{fullname} is called {ROOT}.{moved} since version 2.0", DeprecationWarning, stacklevel=2)
        return ModuleSpec(fullname, _Alias(f"{ROOT}.{moved}"), is_package=True)


class _ServedFinder(MetaPathFinder):
    """Finder of public modules, including those of extensions, that lie deeper in the package."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of a module that is served by its name, otherwise None."""
        root, _, name = fullname.partition(".")
        if root != ROOT or name in ("", "extensions") or "." in name:
            return None
        if name in _MODULES:
            return ModuleSpec(fullname, _Alias(f"{ROOT}.{_MODULES[name]}"))
        from .extension import entries, missing

        for package, served, module in entries("modules"):
            if served == name:
                return ModuleSpec(fullname, _Alias(f"{package}.{module}"))
        if absent := missing("modules", name):
            raise ModuleNotFoundError(absent, name=fullname)
        return None


def install() -> None:
    """Let the import system find modules under the names by which they are served."""
    if not any(isinstance(finder, _MovedFinder) for finder in sys.meta_path):
        # Before the finder of files, which would load files of a moved package again, under the former name.
        sys.meta_path.insert(0, _MovedFinder())
        sys.meta_path.append(_ServedFinder())
