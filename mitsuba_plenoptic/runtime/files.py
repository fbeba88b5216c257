"""Files: read within bounds on the sizes that they claim, and written completely or not at all."""

import contextlib
import errno
import functools
import glob
import io
import json
import logging
import os
import re
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import yaml

from ..errors import NO_RECORD, InputError, naming, refuse_if, refusing, require_module, require_suffix, short_repr
from .backend import Doubles

_one_at_a_time = threading.Lock()

_Reader = TypeVar("_Reader", bound=Callable)

_log = logging.getLogger(__name__)


def require_writable(path: str | Path, *suffixes: str) -> Path:
    """Return a path after a check, before a long computation, that a file can be written there; see `claiming`."""
    # Captures load nothing that only writers need.
    from .locks import claim

    path = _writable(path, *suffixes)
    claim(path)
    return path


def _writable(path: str | Path, *suffixes: str) -> Path:
    path = _path(path)
    # Mitsuba and most libraries write no others.
    with refusing(f"path = {str(path)!r}: its name must be text in UTF-8", UnicodeEncodeError):
        str(path).encode()
    try:
        refuse_if(path.is_dir(), f"{path}: it is a folder; give a file name")
        refuse_if(not path.parent.is_dir(), f"{path}: the folder {path.parent} does not exist")
        refuse_if(path.exists() and not path.is_file(), f"{path}: it is a device or a pipe; give a file name")
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    if suffixes:
        require_suffix(path, suffixes)
    refuse_if(
        not os.access(path.parent, os.W_OK) or (path.exists() and not os.access(path, os.W_OK)),
        f"{path}: no permission to write it",
    )
    return path


def require_output(path: Path, *sources: Path | None, is_folder: bool = False) -> None:
    """Refuse an output, a file or a folder, that cannot be written, or is also an input and would be replaced."""
    if not is_folder:
        require_writable(path)
    for source in sources:
        refuse_if(
            source is not None and path.exists() and source.exists() and path.samefile(source),
            f"{path}: it is read, and would be lost; write to another file",
        )


def require_different(*paths: Path | None) -> None:
    """Refuse output files of which two are the same."""
    resolved = set()
    for path in filter(None, paths):
        refuse_if(
            path.resolve() in resolved, f"{path}: two results would be written to it; give each a name of its own"
        )
        resolved.add(path.resolve())


def require_file(path: str | Path) -> Path:
    """Return a path after a check that its file can be read."""
    path = _path(path)
    try:
        there = path.exists()
        regular = path.is_file()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    fault = "it is a folder; give a file" if path.is_dir() else "it is not a regular file"
    refuse_if(not regular, f"{path}: {fault if there else 'there is no such file'}")
    refuse_if(not os.access(path, os.R_OK), f"{path}: no permission to read it")
    _log.debug("%s: read", path)
    return path


def of_one_file(read: _Reader) -> _Reader:
    """Return a reader of a path that reads again where another process has replaced the file meanwhile."""

    @functools.wraps(read)
    def reader(path: str | Path, *arguments: Any, **options: Any) -> Any:
        for _ in range(100):
            before = _identity(path)
            try:
                content = read(path, *arguments, **options)
            except InputError:
                if _identity(path) == before:
                    raise
            else:
                if _identity(path) == before:
                    return content
        raise InputError(f"{path}: other processes replace it again and again")

    return cast(_Reader, reader)


def _identity(path: str | Path) -> tuple[int, ...]:
    try:
        status = Path(path).stat()
    except (OSError, ValueError, TypeError):
        return ()
    return status.st_ino, status.st_mtime_ns, status.st_size


def require_size(path: str | Path, largest: int) -> Path:
    """Return a path after a check that it can be read and has at most `largest` bytes."""
    path = require_file(path)
    size = path.stat().st_size
    refuse_if(size > largest, f"{path}: {size} bytes: it may have at most {largest}")
    return path


def read_text(path: str | Path, largest: int) -> str:
    """Read a text file in UTF-8, with a byte-order mark or without one, of at most `largest` bytes."""
    path = require_size(path, largest)
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: it is not text in UTF-8: {error.reason} at byte {error.start}") from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None


def _path(path: str | Path) -> Path:
    if not isinstance(path, (str, Path)) or "\0" in str(path):
        raise InputError(f"path = {short_repr(path)}: it must be the name of a file")
    return Path(path)


@contextlib.contextmanager
def atomic_output(path: str | Path, *suffixes: str) -> Iterator[Path]:
    """Yield a temporary file next to a writable `path`; it replaces `path` once it is complete, or is removed."""
    from .locks import hidden

    path = _writable(path, *suffixes)
    folder = ""
    try:
        with tempfile.TemporaryDirectory(prefix=f"{hidden(path)}.", dir=path.parent) as folder:
            # The suffix stays, because writers choose the format by it.
            temporary = Path(folder) / path.name
            try:
                yield temporary
            except (OSError, RuntimeError) as error:
                # Not all libraries say why they could not write; while their part of the file is there, the disk does.
                # A disk with less than 64 KiB free is taken for full.
                if shutil.disk_usage(folder).free < 2**16:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from error
                raise
            temporary.replace(path)
            _log.debug("%s: written", path)
    except (OSError, RuntimeError) as error:
        named = str(getattr(error, "filename", None) or "")
        ours = f"{hidden(path)}." in f"{named}{error}" or (isinstance(error, OSError) and not named)
        if not ours:
            raise
        cause = getattr(error, "strerror", None) or str(error).replace(folder, str(path.parent))
        raise InputError(f"{path}: it cannot be written: {cause}") from error


class Sink(io.FileIO):
    """A file that keeps its write errors until `check`, as HDF5 would crash at the end of the process after one."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        """Write all bytes; after an error, discard them."""
        view = memoryview(data).cast("B")
        size = len(view)
        try:
            while len(view) and not self.error:
                view = view[super().write(view) :]
        except OSError as error:
            self.error = error
        return size

    def truncate(self, size: int | None = None) -> int:
        """Set the size; after an error, do nothing."""
        try:
            return self.tell() if self.error else super().truncate(size)
        except OSError as error:
            self.error = error
            return self.tell()

    def check(self, path: Path) -> None:
        """Raise the error of a failed write, if any."""
        if self.error:
            raise InputError(f"{path}: it cannot be written: {self.error.strerror}")


def write_text(path: str | Path, text: str, *suffixes: str) -> None:
    """Write a text file in UTF-8, completely or not at all."""
    with atomic_output(path, *suffixes) as temporary:
        temporary.write_text(text, encoding="utf-8")


def remove_leftovers(path: str | Path) -> None:
    """Remove temporary files of `atomic_output` that a killed process left."""
    from .locks import hidden

    path = Path(path)
    for folder in path.parent.glob(f"{glob.escape(hidden(path))}.*"):
        shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def native_output_dropped() -> Iterator[None]:
    """Suppress, within the context, messages of C++ libraries about damaged files on standard output and error.

    The libraries' exceptions repeat them.
    """
    with _one_at_a_time, Path(os.devnull).open("wb") as nowhere, contextlib.redirect_stdout(io.StringIO()):
        saved = [(descriptor, os.dup(descriptor)) for descriptor in (1, 2)]
        try:
            for descriptor, _ in saved:
                os.dup2(nowhere.fileno(), descriptor)
            yield
        finally:
            for descriptor, copy in saved:
                os.dup2(copy, descriptor)
                os.close(copy)


class _Loader(yaml.SafeLoader):
    """Loader of YAML 1.2 and JSON that avoids common traps of YAML.

    PyYAML reads version 1.1, in which 1e-05 is text, 010 is 8, 1:30 is 90 and `no` is false. Repeated names are
    refused.
    """

    def construct_mapping(self, node: Any, deep: bool = False) -> dict:
        keys = [key.value for key, _ in node.value]
        for key in keys:
            refuse_if(keys.count(key) > 1, f"{key} is given twice")
        return super().construct_mapping(node, deep)


# The scalars of the core schema of YAML 1.2 (section 10.3.2), without octal and hexadecimal numbers.
_Loader.yaml_implicit_resolvers = {}
for _kind, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+", list("-+0123456789")),
    ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", list("-+.0123456789")),
    ("float", r"[-+]?\.?(inf|Inf|INF)|\.(nan|NaN|NAN)", list("-+.iI")),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_kind}", re.compile(rf"^(?:{_pattern})$"), _first)
_Loader.add_constructor("tag:yaml.org,2002:int", lambda loader, node: int(loader.construct_scalar(node)))


def read_yaml(path: str | Path) -> Any:
    """Read a YAML or JSON file of at most 64 KiB."""
    text = read_text(path, 2**16)
    with naming(path):
        return parse_yaml(text)


def parse_yaml(text: str) -> Any:
    """Return the data in a YAML or JSON text."""
    with refusing("it is not YAML:", yaml.YAMLError, ValueError, RecursionError):
        return yaml.load(text, Loader=_Loader)


def read_table(path: str | Path) -> Doubles:
    """Return all numbers of a CSV file of at most 4 MiB, (rows, columns); the first line may hold names."""
    lines = [line for line in read_text(path, 2**22).splitlines() if line.strip()]
    for cell in lines[0].split(",") if lines else ():
        with contextlib.suppress(ValueError):
            float(cell)
            break
    else:
        lines = lines[1:]
    with refusing(f"{path}: it is no table of numbers:", ValueError):
        rows = np.loadtxt(lines, delimiter=",", ndmin=2) if lines else np.empty((0, 0))
    refuse_if(not len(rows), f"{path}: it has no rows of numbers")
    if not np.isfinite(rows).all():
        row = int(np.flatnonzero(~np.isfinite(rows).all(axis=1))[0])
        raise InputError(f"{path}, row {row + 1}: all numbers must be finite")
    return rows


def h5py_module(purpose: str) -> Any:
    """Return the module h5py; without it, say what it is needed for."""
    return require_module("h5py", f"{purpose} needs the package h5py: pip install h5py")


def stored_array(group: Any, name: str) -> Any:
    """Return a numeric dataset in HDF5 by name, None if it is missing."""
    stored = group.get(name)
    kind = getattr(getattr(stored, "dtype", None), "kind", "")
    refuse_if(stored is not None and kind not in ("f", "i", "u"), f"{name} is not an array of numbers")
    return stored


def read_json_value(value: Any, resolve: Callable[[str], str]) -> Any:
    """Return plain data from a JSON file, named as `resolve` finds it, or from JSON text; other values unchanged."""
    if not isinstance(value, (str, Path)):
        return value
    text = str(value)
    if not text.lstrip().startswith("{"):
        text = read_text(resolve(text), 2**26)
    with refusing("it must be a JSON object:", *NO_RECORD):
        return json.loads(text)


def require_zarr(path: Path) -> Any:
    """Return the package zarr, or refuse a file of Zarr without it."""
    return require_module("zarr", f"{path}: Zarr needs a package: pip install zarr")
