"""Make sure that a usable LLVM is on this machine: ``python tools/ensure_llvm.py``.

Installs the newest one that apt or Homebrew offers where that needs no password, and otherwise prints the one
command to run. Needs nothing but the standard library.
"""

from __future__ import annotations

import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

# Loaded by its path: importing the package would load Dr.Jit, and with it LLVM.
llvm = runpy.run_path(str(Path(__file__).resolve().parent.parent / "mitsuba_plenoptic" / "runtime" / "llvm.py"))


def main() -> str | None:
    """Return what stands in the way, or None once a usable LLVM is there."""
    named = os.environ.get(llvm["VARIABLE"])
    if named:
        # The user's choice is not replaced behind their back, and a name that tells no version may be right.
        chosen = llvm["library"](named)
        if not Path(named).is_file() or (chosen.version and not chosen.usable):
            return str(llvm["explain"](None, named, llvm["candidates"]()))
        return None
    if not _usable():
        _install()
    return None if _usable() else str(llvm["explain"](None, None, []))


def _usable() -> bool:
    return any(item.usable for item in llvm["candidates"]())


def _install() -> None:
    """Install LLVM where a package manager is and nobody need type a password."""
    if shutil.which("apt-get"):
        root = [] if os.geteuid() == 0 else ["sudo", "-n"]
        if root and not _succeeds([*root, "true"]):
            return
        # A list of packages that is old names files that are gone; without a network it must do.
        _run([*root, "apt-get", "update", "-q"])
        if package := llvm["newest_apt_package"]():
            _run([*root, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "install", "-y", "-q", package])
    elif shutil.which("brew"):
        _run(["brew", "install", "llvm"])


def _run(command: list[str]) -> None:
    print("+", " ".join(command), flush=True)
    subprocess.run(command, check=False)


def _succeeds(command: list[str]) -> bool:
    try:
        return subprocess.run(command, check=False, capture_output=True).returncode == 0
    except OSError:
        return False


if __name__ == "__main__":
    fault = main()
    if fault is not None:
        sys.exit(f"ensure_llvm: {fault}")
