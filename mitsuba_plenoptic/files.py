"""Writing files so that nothing half-written is left and nothing finished is lost."""

from __future__ import annotations

import contextlib
import glob
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from .errors import InputError


def require_writable(path: str | Path) -> Path:
    """Check, before a long computation, that a file can be written, without touching it.

    Raises
    ------
    InputError
        If the folder does not exist or cannot be written, or the path is a folder.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: it is a folder; give a file name")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist")
    if not os.access(path.parent, os.W_OK) or (path.exists() and not os.access(path, os.W_OK)):
        raise InputError(f"{path}: no permission to write it")
    return path


@contextlib.contextmanager
def atomic_output(path: str | Path) -> Iterator[Path]:
    """Yield a temporary name beside `path` that replaces it once it is written whole, or goes.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    path = require_writable(path)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        # The suffix stays, because writers choose the format by it.
        temporary = Path(folder) / path.name
        yield temporary
        temporary.replace(path)


def remove_leftovers(path: str | Path) -> None:
    """Remove what `atomic_output` of the same file left behind in a process that was killed."""
    path = Path(path)
    for folder in path.parent.glob(f".{glob.escape(path.name)}.*"):
        shutil.rmtree(folder, ignore_errors=True)
