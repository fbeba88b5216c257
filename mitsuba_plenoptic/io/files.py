"""Files: read without noise, and written so that nothing half-written is left and nothing finished is lost."""

from __future__ import annotations

import contextlib
import errno
import glob
import io
import os
import shutil
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

from ..errors import InputError, shown

_NO_ROOM = 2**16
"""Bytes that are free on a disk that is taken for full."""

_one_at_a_time = threading.Lock()


def require_writable(path: str | Path, *suffixes: str) -> Path:
    """Check, before a long computation, that a file can be written, without touching it."""
    path = _path(path)
    try:
        if path.is_dir():
            raise InputError(f"{path}: it is a folder; give a file name")
        if not path.parent.is_dir():
            raise InputError(f"{path}: the folder {path.parent} does not exist")
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: it is a device or a pipe; give a file name")
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    if suffixes and not path.name.lower().endswith(suffixes):
        raise InputError(f"{path}: give a name that ends in {' or '.join(suffixes)}")
    if not os.access(path.parent, os.W_OK) or (path.exists() and not os.access(path, os.W_OK)):
        raise InputError(f"{path}: no permission to write it")
    return path


def require_apart(path: Path, *sources: Path | None) -> None:
    """Check that a file that is to be written is none of those that are read, which it would take the place of."""
    for source in sources:
        if source is not None and path.exists() and source.exists() and path.samefile(source):
            raise InputError(f"{path}: it is read, and would be lost; write to another file")


def require_different(*paths: Path | None) -> None:
    """Check that no two of the files that are to be written are the same."""
    found: set[Path] = set()
    for path in filter(None, paths):
        if path.resolve() in found:
            raise InputError(f"{path}: two results would be written to it; give each a name of its own")
        found.add(path.resolve())


def require_file(path: str | Path) -> Path:
    """Check that a file can be read."""
    path = _path(path)
    try:
        there, regular = path.exists(), path.is_file()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    if not regular:
        raise InputError(f"{path}: {'it is not a regular file' if there else 'there is no such file'}")
    if not os.access(path, os.R_OK):
        raise InputError(f"{path}: no permission to read it")
    return path


def require_size(path: str | Path, largest: int) -> Path:
    """Check that a file can be read and has at most `largest` bytes, before any of them is read."""
    path = require_file(path)
    size = path.stat().st_size
    if size > largest:
        raise InputError(f"{path}: {size} bytes: it may have at most {largest}")
    return path


def read_text(path: str | Path, largest: int) -> str:
    """Read a text file in UTF-8, with a byte-order mark or without one, of at most `largest` bytes."""
    path = require_size(path, largest)
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: it is not text in UTF-8: {error}") from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None


def _path(path: str | Path) -> Path:
    if not isinstance(path, (str, Path)) or "\0" in str(path):
        raise InputError(f"path = {shown(path)}: it must be the name of a file")
    return Path(path)


@contextlib.contextmanager
def atomic_output(path: str | Path, *suffixes: str) -> Iterator[Path]:
    """Yield a temporary name beside a writable `path` that replaces it once it is written whole, or goes."""
    path = require_writable(path, *suffixes)
    folder = ""
    try:
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
            # The suffix stays, because writers choose the format by it.
            temporary = Path(folder) / path.name
            try:
                yield temporary
            except (OSError, RuntimeError) as error:
                # Not all libraries say why they could not write; while their part of the file is there, the disk does.
                if shutil.disk_usage(folder).free < _NO_ROOM:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from error
                raise
            temporary.replace(path)
    except (OSError, RuntimeError) as error:
        named = str(getattr(error, "filename", None) or "")
        ours = f".{path.name}." in f"{named}{error}" or (isinstance(error, OSError) and not named)
        if not ours:
            raise
        cause = getattr(error, "strerror", None) or str(error).replace(folder, str(path.parent))
        raise InputError(f"{path}: it cannot be written: {cause}") from error


def remove_leftovers(path: str | Path) -> None:
    """Remove what `atomic_output` of the same file left behind in a process that was killed."""
    path = Path(path)
    for folder in path.parent.glob(f".{glob.escape(path.name)}.*"):
        shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def native_output_dropped() -> Iterator[None]:
    """Drop what libraries in C++ print about damaged files, to Python's output and to the process's own.

    Their exceptions say it again.
    """
    with _one_at_a_time, Path(os.devnull).open("wb") as nowhere, contextlib.redirect_stdout(io.StringIO()):
        kept = [(number, os.dup(number)) for number in (1, 2)]
        try:
            for number, _ in kept:
                os.dup2(nowhere.fileno(), number)
            yield
        finally:
            for number, copy in kept:
                os.dup2(copy, number)
                os.close(copy)
