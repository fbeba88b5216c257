"""Checkpoints of wave captures: what has been summed so far, on disk, so that a run that was killed goes on there.

A checkpoint is an uncompressed ZIP archive of ``header.json`` and plain float32 arrays. The header holds all that the
run's bits depend on; a run with anything else there is refused. Nothing of a checkpoint is ever executed, and no
more memory is taken for it than the file itself has bytes.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import time
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, require_count, require_number
from ..runtime.backend import backend_of
from ..runtime.batches import PartialSum
from ..runtime.jobs import Snapshot
from ..runtime.software import software
from .files import atomic_output, remove_leftovers

FORMAT = 1
SUFFIX = ".checkpoint"

Existing = Literal["refuse", "resume", "resume_if_same"]

_SECONDS = 10.0
"""Time between checkpoints, at least."""

_SHARE = 0.05
"""Share of the time that writing them may take."""

_LARGEST_HEADER = 2**20
_TOLD = 3
_DTYPE = np.dtype("<f4")

_log = logging.getLogger(__name__)


class _AnotherRunError(InputError):
    """A checkpoint is whole, but of another run."""


class Checkpoint:
    """A file that a capture writes its state into now and then, and goes on from.

    A context in which the capture is rendered and written: left without an exception, the file is removed.

    Parameters
    ----------
    path : path
        The file.
    existing : {"refuse", "resume", "resume_if_same"}
        What to do with a file that is there: refuse to replace it; go on from it, and refuse it if it is of another
        run; or go on from it if it is of the same run and replace it if it is of another.

    Raises
    ------
    InputError
        On entering, if there is a file that may not be replaced.
    """

    def __init__(self, path: str | Path, existing: Existing = "refuse") -> None:
        self.path = Path(path)
        self.run: dict[str, Any] = {}
        self._existing = existing
        self._due = math.inf
        self._complained = False

    def __enter__(self) -> Checkpoint:
        if self._existing == "refuse" and self.path.exists():
            raise InputError(
                f"{self.path}: the checkpoint of a run that was stopped; resume that run, or remove the file"
            )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # A run that never began has no claim to a file that is there.
        if kind is None and self._due < math.inf:
            self.path.unlink(missing_ok=True)

    def begin(self, shape: tuple[int, ...], **facts: Any) -> Snapshot | None:
        """Say what the run is, and get how far an earlier process has come with it.

        Parameters
        ----------
        shape : (rows, columns, channels)
            The capture's.
        **facts
            Plain JSON values that the bits of the result depend on, beside those in `run` and the software.

        Raises
        ------
        InputError
            If there is the checkpoint of another run, with the differences, or a damaged one.
        """
        self._due = time.monotonic() + _SECONDS
        self.run = json.loads(json.dumps({**self.run, **facts, "software": software()}))
        remove_leftovers(self.path)
        if not self.path.exists():
            return None
        try:
            found = _read(self.path, self.run, shape)
        except InputError as error:
            if self._existing == "resume":
                raise
            _log.info("%s; beginning anew", error)
            return None
        _log.info("%s: going on from there", self.path)
        return found

    def save(self, snapshot: Snapshot) -> None:
        """Write the state, if it is time to.

        A disk that is full costs a warning, not the run: the checkpoint of before stays.
        """
        start = time.monotonic()
        if start < self._due:
            return
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_output(self.path) as temporary:
                _write(temporary, self.run, snapshot)
        except (OSError, InputError) as error:
            if not self._complained:
                cause = getattr(error, "strerror", None) or str(error)
                warnings.warn(f"{self.path}: no checkpoint can be written: {cause}", stacklevel=2)
                self._complained = True
        now = time.monotonic()
        self._due = now + max(_SECONDS, (now - start) / _SHARE)


def digest(*arrays: NDArray[Any] | None) -> str:
    """Hash arrays by type, shape and content."""
    text = hashlib.sha256()
    for array in arrays:
        if array is None:
            text.update(b"none")
            continue
        text.update(f"{array.dtype.str}{array.shape}".encode())
        text.update(np.ascontiguousarray(array).data)
    return text.hexdigest()[:32]


def _write(path: Path, run: dict[str, Any], snapshot: Snapshot) -> None:
    arrays = {"image": snapshot.image}
    if snapshot.partial:
        sums = snapshot.partial.sums
        arrays["partial"] = backend_of(sums).to_host(sums)
    header = {
        "kind": "checkpoint",
        "format": FORMAT,
        "run": run,
        "sums": snapshot.sums,
        "batches": snapshot.partial.batches if snapshot.partial else 0,
        "arrived": snapshot.partial.arrived if snapshot.partial else 0.0,
        "shapes": {name: array.shape for name, array in arrays.items()},
    }
    with path.open("wb") as file:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            archive.writestr("header.json", json.dumps(header))
            for name, array in arrays.items():
                with archive.open(name, "w", force_zip64=True) as member:
                    member.write(np.ascontiguousarray(array, _DTYPE).data.cast("B"))
        file.flush()
        # On the disk before it takes the place of the one of before.
        os.fsync(file.fileno())


def _read(path: Path, run: dict[str, Any], shape: tuple[int, ...]) -> Snapshot:
    """Read the checkpoint of a run.

    Raises
    ------
    InputError
        If it is of another run, or damaged.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            header = _read_header(archive)
            if header.get("kind") != "checkpoint":
                raise ValueError("its header is not a checkpoint's")
            _compare(path, {"format": header.get("format")}, {"format": FORMAT})
            _compare(path, header["run"], run)
            arrays = {name: _read_array(archive, name, sizes) for name, sizes in header["shapes"].items()}
            if arrays["image"].shape != shape:
                raise ValueError(f"image has the shape {arrays['image'].shape} instead of {shape}")
            sums, batches = (require_count(name, header[name], minimum=0) for name in ("sums", "batches"))
            arrived = require_number("arrived", header["arrived"])
            partial = PartialSum(batches, arrays["partial"], arrived) if "partial" in arrays else None
            return Snapshot(sums, arrays["image"], partial)
    except _AnotherRunError:
        raise
    except Exception as error:
        # ZIP, JSON and NumPy tell of damage by many exception types; all mean the same to the user.
        raise InputError(f"{path}: it is not a checkpoint, or is damaged: {' '.join(str(error).split())}") from None


def _read_header(archive: zipfile.ZipFile) -> dict[str, Any]:
    _check_member(archive, "header.json", maximum=_LARGEST_HEADER)
    header = json.loads(archive.read("header.json"))
    if not isinstance(header, dict):
        raise ValueError("its header is not a JSON object")
    return header


def _read_array(archive: zipfile.ZipFile, name: str, shape: list[int]) -> NDArray[np.float32]:
    if len(shape) != 3 or not all(isinstance(size, int) and size > 0 for size in shape):
        raise ValueError(f"{name} has the shape {shape}")
    size = math.prod(shape) * _DTYPE.itemsize
    if _check_member(archive, name) != size:
        raise ValueError(f"{name} of shape {shape} does not have {size} bytes")
    array = np.empty(shape, _DTYPE)
    view = array.reshape(-1).view(np.uint8)
    with archive.open(name) as opened:
        member: Any = opened
        while count := member.readinto(view):
            view = view[count:]
    if len(view):
        raise ValueError(f"{name} ends early")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds numbers that are not finite")
    return array.astype(np.float32, copy=False)


def _check_member(archive: zipfile.ZipFile, name: str, maximum: int | None = None) -> int:
    """Return the size of an archive's member, which must be as large as its header says: not compressed."""
    info = archive.getinfo(name)
    if info.compress_type != zipfile.ZIP_STORED or info.compress_size != info.file_size:
        raise ValueError(f"{name} is compressed")
    if info.file_size > (os.fstat(archive.fp.fileno()).st_size if maximum is None else maximum):  # type: ignore[union-attr]
        raise ValueError(f"{name} has {info.file_size} bytes")
    return info.file_size


def _compare(path: Path, there: Mapping[str, Any], here: Mapping[str, Any]) -> None:
    """Refuse the checkpoint of another run, and name what differs."""
    found, wanted = dict(_flat(there)), dict(_flat(here))
    nothing = object()
    differences = [
        f"{name} = {_told(found, name)} there, {_told(wanted, name)} here"
        for name in dict.fromkeys((*wanted, *found))
        if found.get(name, nothing) != wanted.get(name, nothing)
    ]
    if differences:
        more = f", and {len(differences) - _TOLD} more" if len(differences) > _TOLD else ""
        raise _AnotherRunError(f"{path}: the checkpoint of another run: {'; '.join(differences[:_TOLD])}{more}")


def _told(values: dict[str, Any], name: str) -> str:
    return str(values.get(name, "nothing"))


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield names with dots, and values."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value
