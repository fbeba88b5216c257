"""Check of this machine's installation: what rendering needs, and whether it suffices."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import drjit
import mitsuba

from ..runtime import llvm

_PACKAGES = ("mitsuba-plenoptic", "mitsuba", "drjit", "numpy", "scipy", "OpenEXR")
_CUPY = ("cupy-cuda12x", "cupy-cuda13x", "cupy")
_MISSING = "not installed"


@dataclass(frozen=True)
class Installation:
    """State of an installation: versions, variants and problems."""

    # Titles, each with the names and findings below it.
    sections: dict[str, list[tuple[str, str]]]
    # Why LLVM variants cannot be used.
    problem: str | None
    # Whether captures can be rendered.
    ready: bool


def inspect_installation() -> Installation:
    """Return versions, LLVM, GPU and Mitsuba's variants of this installation."""
    problem = llvm.problem()
    cuda = bool(drjit.has_backend(drjit.JitBackend.CUDA))
    python = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    sections = {
        "Versions": [("python", python), *((name, _version(name)) for name in _PACKAGES)],
        "LLVM": _llvm(),
        "GPU": _gpu(cuda),
        "Variants": [(name, _state(name, cuda, problem)) for name in mitsuba.variants() if "_ad_" in name],
    }
    return Installation(sections, problem, ready=cuda or not problem)


def _state(variant: str, cuda: bool, problem: str | None) -> str:
    """Return a sentence on whether a variant works here, and which of its functions wave captures use."""
    if not cuda if variant.startswith("cuda") else problem:
        return "not usable here"
    if "polarized" in variant:
        return "works here; wave captures are unpolarized"
    return "works here"


def _llvm() -> list[tuple[str, str]]:
    found = [
        f"{item.path}: {item.version_text}, "
        + ("usable" if item.usable else f"too old, {llvm.MINIMUM} or newer is needed")
        for item in llvm.candidates()
    ]
    named = os.environ.get(llvm.VARIABLE)
    loaded = tuple(drjit.detail.llvm_version())
    return [
        *(("found", text) for text in found),
        ("chosen", f"{llvm.VARIABLE}={named}" if named else "none, left to Dr.Jit"),
        ("loaded", llvm.format_version(loaded) if loaded > (0,) else "none"),
        ("threads", str(drjit.thread_count())),
    ]


def _gpu(cuda: bool) -> list[tuple[str, str]]:
    cupy = next((found for name in _CUPY if (found := _version(name)) != _MISSING), None)
    device = "no NVIDIA driver"
    if shutil.which("nvidia-smi"):
        command = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
        answer = subprocess.run(command, capture_output=True, text=True, check=False)
        lines = answer.stdout.strip().splitlines() if answer.returncode == 0 else []
        device = lines[0].replace(", ", ", driver ") if lines else device
    return [
        ("device", device),
        ("CUDA", "usable" if cuda else "not usable"),
        (
            "CuPy",
            cupy or f"{_MISSING}; for waves on CUDA: pip install cupy-cuda12x, or cupy-cuda13x by the driver's CUDA",
        ),
    ]


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return _MISSING
