"""Resuming after a stop: checkpoints of unfinished computations, logs of finished steps, and locks.

A checkpoint is a NumPy archive (``.npz``) of arrays and a ``header``, a JSON text with everything on which the run's
bits depend; a run with a different header is refused. Checkpoints are never unpickled.

A log is a JSON file beside the files of a run or an experiment. A step is finished if the log has the hash of its
settings and of the software, and every file that the step read or wrote still has the logged digest.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import math
import os
import sys
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, refuse_if, require_choice, require_count, require_number, warn
from ..runtime.backend import backend_of
from ..runtime.batches import PartialSum, Snapshot
from ..runtime.files import FilesUsed, atomic_output, read_text, remove_leftovers, write_text
from ..runtime.limits import require_memory, software
from .versions import KEY, VERSION, stamped

if sys.platform != "win32":
    import fcntl

FORMAT = 2
SUFFIX = ".checkpoint"

Existing = Literal["refuse", "resume", "resume_if_same"]

_LARGEST_HEADER = _LARGEST_LOG = 2**26

INTERVAL = 10.0
"""Seconds between checkpoints, at least."""

FRACTION = 0.05
"""Fraction of the time that writing them may take."""

_DIFFERENCES_SHOWN = 3

_State = TypeVar("_State")

_log = logging.getLogger(__name__)


@contextlib.contextmanager
def locked(path: Path, refusal: str | None = None) -> Iterator[None]:
    """Hold the lock file `path`; if another process holds it, refuse with a message, or wait without one.

    The system releases the lock when this process ends, however it ends. Windows and some network drives have no such
    lock; a warning tells of the latter.
    """
    new, mine = not path.parent.exists(), False
    while not mine:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = path.open("w")
        except OSError as error:
            raise InputError(f"{path.parent}: {error.strerror}") from error
        try:
            if sys.platform != "win32":
                fcntl.flock(file, fcntl.LOCK_EX | (fcntl.LOCK_NB if refusal else 0))
            # The process that had it may have removed the file between the two calls.
            mine = os.path.samestat(os.fstat(file.fileno()), path.stat())
        except (BlockingIOError, FileNotFoundError):
            pass
        except OSError as error:
            mine = True
            warn(f"{path.parent}: it cannot be locked: {error.strerror}")
        if not mine:
            file.close()
            refuse_if(refusal is not None, f"{refusal}; wait until it has ended")
    with file:
        try:
            yield
        finally:
            path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                if new:
                    path.parent.rmdir()


def lock_of(path: Path) -> Path:
    """Return the path of the lock file for a file."""
    return path.with_name(f".{path.name}.lock")


class Checkpoint:
    """File in which a capture or a deconvolution saves its state at intervals, to resume from it.

    Used as a context in which the result is computed and written: an end without exception removes the file.

    Parameters
    ----------
    path : path
        The file.
    existing : {"refuse", "resume", "resume_if_same"}
        What to do with an existing file: refuse to replace it; resume from it, or refuse a file of another run; or
        resume from it, or replace a file of another run.

    Raises
    ------
    InputError
        If `existing` is another word; on entering, if there is a file that may not be replaced.
    """

    def __init__(self, path: str | Path, existing: Existing = "refuse") -> None:
        require_choice("existing", existing, get_args(Existing))
        self.path = Path(path)
        self.run: dict[str, Any] = {}
        self.existing = existing
        self._facts: dict[str, Any] = {}
        self._due = math.inf
        self._complained = False
        self._stopping = False
        self._lock = contextlib.ExitStack()

    def __enter__(self) -> Checkpoint:
        if self.existing == "refuse" and self.path.exists():
            raise InputError(
                f"{self.path}: the checkpoint of a run that was stopped; resume from it with existing='resume', or "
                "remove the file"
            )
        return self

    def __exit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # A run that never began has no claim to a file that is there.
        if error_type is None and self._due < math.inf:
            self.path.unlink(missing_ok=True)
        self._lock.close()

    def begin(self, shape: tuple[int, ...], **facts: Any) -> Snapshot | None:
        """Register the run; return the state saved by an earlier process, None if there is none.

        Parameters
        ----------
        shape : (rows, columns, channels)
            Shape of the capture.
        **facts
            Plain JSON values that the bits of the result depend on, besides those in `run` and the software; or
            functions that return them, which are called when the file is read or first written.

        Raises
        ------
        InputError
            If the file is damaged, is the checkpoint of another run (the message states the differences), or is used by
            another process.
        """
        return self._begin(facts, _snapshot, {"image": shape})

    def begin_arrays(self, **facts: Any) -> dict[str, NDArray[Any]] | None:
        """Register a run whose state is arrays instead of a sum; return the saved arrays, None if there are none."""
        return self._begin(facts, _named_arrays, {})

    def _begin(
        self, facts: dict[str, Any], take: Callable[[Any, dict[str, Any]], _State], shapes: dict[str, tuple[int, ...]]
    ) -> _State | None:
        self._lock.close()
        try:
            self._lock.enter_context(locked(lock_of(self.path), f"{self.path}: another process is computing this"))
        except InputError as error:
            # What cannot be locked cannot be written either, of which `save` tells.
            if error.__cause__ is None:
                raise
        self._due = time.monotonic() + INTERVAL
        self._facts = {**self.run, **facts, "software": software()}
        remove_leftovers(self.path)
        if not self.path.exists():
            return None
        try:
            found = _read(self.path, self._known_facts(), take, shapes)
        except InputError as error:
            if self.existing == "resume":
                raise
            _log.info("%s; beginning anew", error)
            return None
        _log.info("%s: resuming from there", self.path)
        return found

    def stop(self) -> bool:
        """Make the run save its next state and end with a KeyboardInterrupt.

        Returns
        -------
        bool
            Whether a run has begun; if none has, nothing happens.
        """
        self._stopping = self._due < math.inf
        return self._stopping

    def save(self, snapshot: Snapshot) -> None:
        """Write the state if the time since the last save is long enough.

        A full disk causes a warning and does not stop the run: the earlier checkpoint stays.

        Parameters
        ----------
        snapshot : Snapshot
            The state to save.

        Raises
        ------
        KeyboardInterrupt
            After `stop`.
        """
        self._save(lambda path: _write(path, self._known_facts(), snapshot))

    def save_arrays(self, arrays: Callable[[], Mapping[str, NDArray[Any]]]) -> None:
        """Write the float32 and float64 arrays for `begin_arrays` if the time since the last save is long enough."""
        self._save(lambda path: _write_archive(path, self._known_facts(), {}, dict(arrays())))

    def _known_facts(self) -> dict[str, Any]:
        """Return the facts of the run as plain JSON values; functions are called once."""
        known = {name: value() if callable(value) else value for name, value in self._facts.items()}
        self._facts = json.loads(json.dumps(known))
        return self._facts

    def _save(self, write: Callable[[Path], None]) -> None:
        start = time.monotonic()
        if start < self._due and not self._stopping:
            return
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_output(self.path) as temporary:
                write(temporary)
        except (OSError, InputError) as error:
            if not self._complained:
                cause = getattr(error.__cause__ or error, "strerror", None) or str(error).removeprefix(f"{self.path}: ")
                warn(f"{self.path}: no checkpoint can be written: {cause}")
                self._complained = True
        now = time.monotonic()
        self._due = now + max(INTERVAL, (now - start) / FRACTION)
        if self._stopping:
            raise KeyboardInterrupt


def digest(*arrays: NDArray[Any] | None) -> str:
    """Return a hash of arrays by type, shape and content."""
    text = hashlib.sha256()
    for array in arrays:
        if array is None:
            text.update(b"none")
            continue
        text.update(f"{array.dtype.str}{array.shape}".encode())
        text.update(np.ascontiguousarray(array).data)
    return text.hexdigest()[:32]


def hash_of(content: Any) -> str:
    """Return a hash of plain JSON values."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:32]


def step_key(settings: Any) -> str:
    """Return a hash of a step's settings and of the software versions, but not of the files that the step reads."""
    return hash_of({"settings": settings, "software": software()})


def finished_step(log: Path, settings: Any) -> dict[str, Any] | None:
    """Return the log's entry on a finished step with these settings that wrote files, otherwise None."""
    entry = _steps(log).get(step_key(settings))
    if not entry or not entry["written"]:
        return None
    files = {**entry["read"], **entry["written"]}
    return entry if all(_digest(log.parent / name) == noted for name, noted in files.items()) else None


def note_step(log: Path, settings: Any, used: FilesUsed, **facts: Any) -> None:
    """Record a step's files in a log, and drop entries of earlier steps that wrote one of these files.

    Files in the folder of the log are named relative to it, so that the folder can be moved.
    """
    folder = log.parent.absolute()

    def digests(paths: set[Path]) -> dict[str, str | None]:
        names = {path: path.relative_to(folder) if path.is_relative_to(folder) else path for path in paths}
        return {names[path].as_posix(): _digest(path) for path in sorted(paths) if path.exists()}

    entry = {"read": digests(used.read - used.written), "written": digests(used.written), **facts}
    steps = {key: one for key, one in _steps(log).items() if not entry["written"].keys() & one["written"].keys()}
    write_json(log, {**steps, step_key(settings): entry})


def _steps(log: Path) -> dict[str, dict[str, Any]]:
    """Return the entries of a log, without damaged ones."""
    try:
        content = json.loads(read_text(log, _LARGEST_LOG))
    except (InputError, ValueError):
        return {}
    return {
        key: entry
        for key, entry in (content if isinstance(content, dict) else {}).items()
        if isinstance(entry, dict) and all(isinstance(entry.get(part), dict) for part in ("read", "written"))
    }


def _digest(path: Path) -> str | None:
    """Return a hash of a file, or of all files of a folder with their names, None if it does not exist."""
    found = hashlib.sha256()
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    try:
        for file in files:
            if file != path:
                found.update(file.relative_to(path).as_posix().encode() + b"\0")
            if not file.is_dir():
                with file.open("rb") as content:
                    found.update(hashlib.file_digest(content, "sha256").digest())
    except OSError:
        return None
    return found.hexdigest()[:32]


def write_json(path: Path, content: Any) -> None:
    """Write indented JSON with sorted names, completely or not at all."""
    write_text(path, json.dumps(content, indent=1, sort_keys=True) + "\n")


def _write(path: Path, run: dict[str, Any], snapshot: Snapshot) -> None:
    header: dict[str, Any] = {"sums": snapshot.sums}
    arrays: dict[str, Any] = {"image": snapshot.image}
    if snapshot.partial:
        partial = snapshot.partial
        header |= {"batches": partial.batches, "arrived": partial.arrived}
        arrays["partial"] = backend_of(partial.sums).to_host(partial.sums)
    _write_archive(path, run, header, arrays)


def _write_archive(path: Path, run: dict[str, Any], header: dict[str, Any], arrays: dict[str, Any]) -> None:
    with path.open("wb") as file:
        np.savez(file, header=json.dumps(stamped({"format": FORMAT, "run": run, **header})), **arrays)
        file.flush()
        # On the disk before it replaces the one of before.
        os.fsync(file.fileno())


def _read(
    path: Path,
    run: dict[str, Any],
    take: Callable[[Any, dict[str, Any]], _State],
    shapes: dict[str, tuple[int, ...]],
) -> _State:
    """Return the state in the checkpoint of a run; refuse damaged checkpoints and checkpoints of other runs."""
    try:
        _check_sizes(path, shapes)
        with np.load(path, allow_pickle=False) as archive:
            header = json.loads(str(archive["header"]))
            # Those of version 1.0 and earlier state none.
            version = {KEY: header[KEY]} if KEY in header else {}
            there = flattened({"format": header["format"], **version, **header["run"]})
            here = flattened({"format": FORMAT, KEY: VERSION, **run})
            differences = [
                f"{name} = {there.get(name, 'nothing')} there, {here.get(name, 'nothing')} here"
                for name in {**here, **there}
                if name not in there or name not in here or there[name] != here[name]
            ]
            if not differences:
                return take(archive, header)
    except Exception as error:
        # ZIP, JSON and NumPy report damage by many types of exception; all mean the same to the user.
        raise InputError(f"{path}: it is not a checkpoint of this version, or is damaged: {error}") from None
    shown = "; ".join(differences[:_DIFFERENCES_SHOWN])
    more = len(differences) - _DIFFERENCES_SHOWN
    raise InputError(f"{path}: the checkpoint of another run: {shown}" + (f", and {more} more" if more > 0 else ""))


def _check_sizes(path: Path, shapes: dict[str, tuple[int, ...]]) -> None:
    """Refuse arrays whose claimed sizes differ from their data or from the required shapes."""
    # The list of the members is read whole, too.
    require_memory(path.stat().st_size, f"{path.stat().st_size} bytes")
    if not zipfile.is_zipfile(path):
        raise ValueError("it is no archive, or cut off")
    total = 0
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            if member.compress_type != zipfile.ZIP_STORED:
                raise ValueError(f"{member.filename} is compressed")
            with archive.open(member) as file:
                if np.lib.format.read_magic(file) != (1, 0):
                    raise ValueError(f"{member.filename} has another version of NumPy's format")
                shape, _, kind = np.lib.format.read_array_header_1_0(file)
                if kind.hasobject:
                    raise ValueError("Object arrays are not read")
                claimed = math.prod(shape) * kind.itemsize
                if file.tell() + claimed != member.file_size:
                    raise ValueError(f"{member.filename} claims {claimed} bytes in {member.file_size}")
            name = member.filename.removesuffix(".npy")
            if shape != shapes.get(name, shape):
                raise ValueError(f"{name} has the shape {shape} instead of {shapes[name]}")
            if name == "header" and claimed > _LARGEST_HEADER:
                raise ValueError(f"its header has {claimed} bytes: it may have at most {_LARGEST_HEADER}")
            total += claimed
    require_memory(total, f"its arrays of {total} bytes")


def _snapshot(archive: Mapping[str, NDArray[Any]], header: dict[str, Any]) -> Snapshot:
    image = _array(archive, "image")
    sums = require_count("sums", header["sums"], minimum=0)
    if "partial" not in archive:
        return Snapshot(sums, image, None)
    batches = require_count("batches", header["batches"], minimum=0)
    arrived = require_number("arrived", header["arrived"])
    return Snapshot(sums, image, PartialSum(batches, _array(archive, "partial"), arrived))


def _named_arrays(archive: Mapping[str, NDArray[Any]], header: dict[str, Any]) -> dict[str, NDArray[Any]]:
    found = {name: archive[name] for name in archive if name != "header"}
    for name, array in found.items():
        if array.dtype not in (np.float32, np.float64):
            raise ValueError(f"{name} is of type {array.dtype}")
        if np.isnan(array).any():
            raise ValueError(f"{name} holds what is no number")
    return found


def _array(archive: Mapping[str, NDArray[Any]], name: str) -> NDArray[np.float32]:
    array = archive[name]
    if array.dtype != np.float32 or array.ndim != 3:
        raise ValueError(f"{name} is of type {array.dtype} and shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds numbers that are not finite")
    return array


def flattened(values: Any, name: str = "") -> dict[str, Any]:
    """Return nested values by dotted names."""
    if not isinstance(values, (Mapping, list)) or not values:
        return {name: values}
    pairs = values.items() if isinstance(values, Mapping) else enumerate(values)
    parts = (flattened(value, f"{name}.{key}" if name else str(key)) for key, value in pairs)
    return {key: value for part in parts for key, value in part.items()}
