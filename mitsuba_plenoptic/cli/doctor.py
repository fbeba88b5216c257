"""``mitsuba-plenoptic doctor``: what this machine has, and whether it suffices."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
from importlib.metadata import PackageNotFoundError, version

import typer

from ..runtime import llvm

PACKAGES = ("mitsuba-plenoptic", "mitsuba", "drjit", "numpy", "scipy", "OpenEXR")
SUPPORTED = ("llvm_ad_", "cuda_ad_")
CUPY = ("cupy-cuda12x", "cupy-cuda13x", "cupy")
MISSING = "not installed"


def doctor() -> None:
    """Check the installation: versions, LLVM, Mitsuba variants, threads and GPU.

    The exit status is 0 if captures can be rendered here and 1 if not.
    """
    import drjit
    import mitsuba

    _section("Versions")
    _line("python", f"{platform.python_version()} on {platform.system()} {platform.machine()}")
    for name in PACKAGES:
        _line(name, _version(name))

    fault = llvm.problem()
    _section("LLVM")
    for item in llvm.candidates():
        verdict = "usable" if item.usable else f"too old, {llvm.MINIMUM} or newer is needed"
        _line("found", f"{item.path}: {item.version_text}, {verdict}")
    named = os.environ.get(llvm.VARIABLE)
    _line("chosen", f"{llvm.VARIABLE}={named}" if named else "none, left to Dr.Jit")
    loaded = tuple(drjit.detail.llvm_version())
    _line("loaded", llvm.format_version(loaded) if loaded > (0,) else "none")
    _line("threads", str(drjit.thread_count()))

    cuda = bool(drjit.has_backend(drjit.JitBackend.CUDA))
    _section("GPU")
    _line("device", _nvidia_device() or "no NVIDIA driver")
    _line("CUDA", "usable" if cuda else "not usable")
    cupy = next((found for name in CUPY if (found := _version(name)) != MISSING), None)
    _line("CuPy", cupy or f'{MISSING}; for waves on CUDA: pip install "mitsuba-plenoptic[cuda]"')

    _section("Variants")
    for variant in mitsuba.variants():
        usable = cuda if variant.startswith("cuda") else not fault
        if variant.startswith(SUPPORTED):
            _line(variant, "works here" if usable else "not usable here")

    typer.echo()
    if fault:
        typer.echo(f"Problem: {fault}.")
    if fault and not cuda:
        raise typer.Exit(1)
    typer.echo("Ready to render.")


def _section(title: str) -> None:
    typer.echo(f"\n{typer.style(title, bold=True)}")


def _line(name: str, value: str) -> None:
    typer.echo(f"  {name:<26} {value}")


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return MISSING


def _nvidia_device() -> str | None:
    """Name and driver version of the first NVIDIA device, if its driver answers."""
    if not shutil.which("nvidia-smi"):
        return None
    answer = subprocess.run(
        ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"],
        capture_output=True,
        text=True,
        check=False,
    )
    lines = answer.stdout.strip().splitlines() if answer.returncode == 0 else []
    return lines[0].replace(", ", ", driver ") if lines else None
