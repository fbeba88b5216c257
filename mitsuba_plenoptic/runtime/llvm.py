"""Choice and check of the LLVM library with which Dr.Jit compiles.

Dr.Jit loads LLVM when it is first imported, from ``DRJIT_LIBLLVM_PATH`` or else from a few folders that it searches,
and accepts what it finds: 14 is refused, and with 15 and 16 the process aborts at the first kernel that needs a minimum
or maximum. So `choose` searches more folders and names a usable library before Dr.Jit loads, and `require` explains,
before a kernel is compiled, what to do if there is no library.

Only the standard library is imported here, so that ``tools/ensure_llvm.py`` can load this file on its own.
"""

import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

VARIABLE = "DRJIT_LIBLLVM_PATH"
MINIMUM = 17

# Debian and Fedora: libLLVM-14.so.1, libLLVM.so.19.1; Conda: libLLVM-19.so, libLLVM.19.1.dylib.
_NAME = re.compile(
    r"libLLVM(?:[-.](?P<stem>\d[\d.]*?)(?:\.so(?:\.\d+)*|\.dylib)|\.so\.(?P<suffix>\d[\d.]*)|\.so|\.dylib)"
)


@dataclass(frozen=True)
class Library:
    """An LLVM library on this machine, and its version as far as its name states it."""

    path: Path
    version: tuple[int, ...]

    @property
    def usable(self) -> bool:
        """Whether Dr.Jit can compile all kernels with this library."""
        return self.version >= (MINIMUM,)

    @property
    def version_text(self) -> str:
        """Version of the library, as in ``LLVM 19.1``."""
        return format_version(self.version)


def format_version(version: tuple[int, ...]) -> str:
    """Write a version as in ``LLVM 19.1``."""
    return "LLVM " + ".".join(map(str, version)) if version else "LLVM of unknown version"


def library(path: str | Path) -> Library:
    """Return the library at a path, with the version stated by its name or by its folder."""
    real = Path(path).resolve()
    name = _NAME.fullmatch(real.name)
    digits = (name["stem"] or name["suffix"]) if name else None
    # Homebrew's Cellar/llvm/19.1.7/lib/libLLVM.dylib and Fedora's llvm19/lib64/libLLVM.so: the folder has the version.
    if digits is None and (folder := re.search(r"llvm(?:@\d+/|[-/])?(\d[\d.]*)", str(real.parent))):
        digits = folder[1]
    return Library(Path(path), tuple(int(digit_group) for digit_group in (digits or "").split(".") if digit_group))


def candidates() -> list[Library]:
    """Return the LLVM libraries on this machine, the newest first and each once."""
    libraries: dict[Path, Library] = {}
    for folder in _folders():
        for path in sorted(folder.glob("libLLVM*")):
            if _NAME.fullmatch(path.name) and path.is_file():
                libraries.setdefault(path.resolve(), library(path))
    return sorted(libraries.values(), key=lambda item: item.version, reverse=True)


def choose() -> None:
    """Set the newest usable LLVM for Dr.Jit to load; call it before Dr.Jit is imported.

    A choice of the user's stays, and after Dr.Jit has loaded the choice has no effect.
    """
    if "drjit" not in sys.modules and not os.environ.get(VARIABLE) and (best := _newest_usable(candidates())):
        os.environ[VARIABLE] = str(best.path)


def problem() -> str | None:
    """Return why Dr.Jit's LLVM is unusable and how to mend it, in one sentence; None if it is usable.

    Nothing is compiled, since compiling would abort the process.
    """
    import drjit

    version = tuple(drjit.detail.llvm_version())
    if version >= (MINIMUM,):
        return None
    loaded = format_version(version) if version > (0,) else None
    return explain(loaded, os.environ.get(VARIABLE), candidates())


def explain(loaded: str | None, named: str | None, libraries: list[Library]) -> str:
    """Return the sentence on an unusable LLVM and its remedy."""
    need = f"but the llvm variants need LLVM {MINIMUM} or newer"
    if named and not Path(named).is_file():
        fault = f"{VARIABLE} = {named!r}: there is no such file"
    elif named:
        # The name helps where Dr.Jit refused to load the file at all.
        version = library(named).version
        actual = loaded or (format_version(version) if version else "not an LLVM library that loads")
        fault = f"{VARIABLE} = {named!r}: it is {actual}, {need}"
    elif loaded:
        fault = f"Dr.Jit loaded {loaded}, {need}"
    else:
        fault = f"no LLVM {MINIMUM} or newer was found, which the llvm variants need"
    if best := _newest_usable(libraries):
        return f"{fault}; " + (
            f"unset the variable, and {best.path} is used"
            if named
            else f"import mitsuba_plenoptic before drjit and mitsuba, or set {VARIABLE}={best.path}"
        )
    command = install_command()
    remedy = f"run: {command}" if command else "install one with your package manager"
    return f"{fault}; {'unset the variable and ' if named else ''}{remedy}"


def install_command() -> str | None:
    """Return the command that installs a usable LLVM here, None without a known package manager."""
    if shutil.which("apt-get"):
        sudo = "" if os.geteuid() == 0 else "sudo "
        if package := newest_apt_package():
            return f"{sudo}apt-get install -y {package}"
        # Fresh systems have no list of packages yet; this one is in Debian 12 and Ubuntu 24.04.
        return f"{sudo}apt-get update && {sudo}apt-get install -y libllvm19"
    others = {"brew": "brew install llvm", "dnf": "sudo dnf install llvm-libs", "pacman": "sudo pacman -S llvm-libs"}
    return next((command for program, command in others.items() if shutil.which(program)), None)


def newest_apt_package() -> str | None:
    """Return the newest usable ``libllvmNN`` that apt knows of."""
    listing = subprocess.run(
        ["apt-cache", "search", "--names-only", "^libllvm[0-9]+(t64)?$"], capture_output=True, text=True, check=False
    ).stdout
    packages = re.findall(r"^(libllvm(\d+)(?:t64)?) ", listing, flags=re.MULTILINE)
    usable = [(int(major), name) for name, major in packages if int(major) >= MINIMUM]
    return max(usable)[1] if usable else None


def _newest_usable(libraries: list[Library]) -> Library | None:
    return next((item for item in libraries if item.usable), None)


def _folders() -> Iterator[Path]:
    """Yield the folders in which package managers install LLVM."""
    root = Path("/")
    # Only this machine's own architecture: Debian's multiarch puts foreign ones next to it.
    yield root / "usr/lib" / f"{platform.machine()}-linux-gnu"
    yield from sorted(root.glob("usr/lib/llvm-*/lib"))
    yield root / "usr/lib64"
    if prefix := os.environ.get("CONDA_PREFIX"):
        yield Path(prefix) / "lib"
    for brew in ("opt/homebrew", "usr/local", "home/linuxbrew/.linuxbrew"):
        yield root / brew / "opt/llvm/lib"
        yield from sorted(root.glob(f"{brew}/opt/llvm@*/lib"))
