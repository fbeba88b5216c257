"""Resuming after a stop: checkpoints of unfinished computations.

A checkpoint is a NumPy archive (``.npz``) of arrays and a ``header``, a JSON text with everything on which the run's
bits depend; a run with a different header is refused. Checkpoints are never unpickled.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import math
import os
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, TypeVar, get_args

import numpy as np

from ..errors import InputError, refuse_if, require_choice, warn
from ..runtime import (
    Array,
    Named,
    PartialSum,
    Sizes,
    Snapshot,
    atomic_output,
    backend_of,
    hold,
    prepared,
    remove_leftovers,
    require_memory,
    software,
    write_text,
)
from .versions import FORMAT, KEY, VERSION, stamped

CHECKPOINT_SUFFIX = ".checkpoint"

Existing = Literal["refuse", "resume", "resume_if_same"]

INTERVAL = 10.0
"""Seconds between checkpoints, at least. The first waits for a quarter of it, and for the end of a batch."""

_PREPARED = "prepared."
"""Start of the names of arrays that a run needs before its first batch."""

FRACTION = 0.05
"""Fraction of the time that writing them may take."""

_State = TypeVar("_State")

_log = logging.getLogger(__name__)


class Checkpoint:
    """File in which a capture or a deconvolution saves its state at intervals, to resume from it.

    Used as a context in which the result is computed and written: an end without exception removes the file.

    Parameters
    ----------
    existing : {"refuse", "resume", "resume_if_same"}
        What to do with an existing file: refuse to replace it; resume from it, or refuse a file of another run; or
        resume from it, or replace a file of another run.

    Raises
    ------
    InputError
        If `existing` is another word; on entering, if there is a file that may not be replaced, or another process uses
        it.
    """

    def __init__(self, path: str | Path, existing: Existing = "refuse"):
        require_choice("existing", existing, get_args(Existing))
        self.path = Path(path)
        self.run: Named = {}
        self.existing = existing
        self._facts: Named = {}
        self._due = math.inf
        self._complained = False
        self._stopping = False
        self._lock = contextlib.ExitStack()
        self._prepared: dict[str, Array] = {}
        self._has_run = True

    def __enter__(self) -> Checkpoint:
        with hold(self.path) as lock:
            refuse_if(
                self.existing == "refuse" and self.path.exists(),
                f"{self.path}: the checkpoint of a run that was stopped; resume from it with existing='resume', or "
                "remove the file",
            )
            self._lock = lock.pop_all()
        self._lock.callback(prepared.reset, prepared.set(self._prepare))
        self._due = time.monotonic() + INTERVAL / 4
        self._has_run = self.path.exists()
        # `_begin` tells of what cannot be read.
        with contextlib.suppress(Exception):
            header, arrays = _archive(self.path)
            self._has_run = header["run"] is not None
            self._prepared = {name: array for name, array in arrays.items() if name.startswith(_PREPARED)}
        return self

    def __exit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # A run that never began has no claim to a file that is there.
        if error_type is None and self._facts:
            self.path.unlink(missing_ok=True)
        self._lock.close()

    def begin(self, shape: Sizes, **facts: Any) -> Snapshot | None:
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
            If the file is damaged, or is the checkpoint of another run (the message states the differences).
        """
        return self._begin(facts, partial(_snapshot, shape))

    def begin_arrays(self, **facts: Any) -> dict[str, Array] | None:
        """Register a run whose state is arrays instead of a sum; return the saved arrays, None if there are none."""
        return self._begin(facts, lambda arrays, _: arrays)

    def _begin(self, facts: Named, take: Callable[[Any, Named], _State]) -> _State | None:
        if self._due == math.inf:
            self._lock = hold(self.path)
        self._due = min(self._due, time.monotonic() + INTERVAL / 4)
        self._facts = {**self.run, **facts, "software": software()}
        remove_leftovers(self.path)
        if not self.path.exists():
            return None
        # Not within `try`: what is wrong with the run itself is no reason to begin anew.
        known = self._known_facts()
        try:
            state = _read(self.path, known, take)
        except InputError as error:
            if self.existing == "resume":
                raise
            _log.info("%s; beginning anew", error)
            return None
        if state is not None:
            _log.info("%s: resuming from there", self.path)
        return state

    def _prepare(self, key: Any, make: Callable[[], Array]) -> Array:
        """Return an array that a run needs before its first batch, stored by an earlier process or made.

        The key, plain JSON values, states all that the array depends on, but the software.
        """
        name = _PREPARED + hash_of([key, software()])
        if name not in self._prepared:
            self._prepared[name] = make()
            # The state of a run, perhaps another one, is not replaced before the run is known.
            if not self._facts and not self._has_run:
                arrays = self._prepared
                self._save(lambda path: _write_archive(path, None, {}, arrays))
        return self._prepared[name]

    def stop(self) -> bool:
        """Make the run save its next state and end with a KeyboardInterrupt.

        Returns
        -------
        bool
            Whether a run has begun; if none has, nothing happens.
        """
        self._stopping = bool(self._facts)
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
        self._save(lambda path: _write(path, self._known_facts(), snapshot, self._prepared))

    def save_arrays(self, arrays: Callable[[], Mapping[str, Array]]) -> None:
        """Write the float32 and float64 arrays for `begin_arrays` if the time since the last save is long enough."""
        self._save(lambda path: _write_archive(path, self._known_facts(), {}, {**arrays(), **self._prepared}))

    def _known_facts(self) -> Named:
        """Return the facts of the run as plain JSON values; functions are called once."""
        facts = {name: value() if callable(value) else value for name, value in self._facts.items()}
        self._facts = json.loads(json.dumps(facts))
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


def digest(*arrays: Array | None) -> str:
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


def write_json(path: Path, content: Any) -> None:
    """Write indented JSON with sorted names, completely or not at all."""
    write_text(path, json.dumps(content, indent=1, sort_keys=True) + "\n")


def _write(path: Path, run: Named, snapshot: Snapshot, prepared: dict[str, Array]) -> None:
    header: Named = {"sums": snapshot.sums}
    arrays = {"image": snapshot.image, **prepared}
    if snapshot.partial:
        unfinished = snapshot.partial
        header |= {"batches": unfinished.batches, "arrived": unfinished.arrived}
        arrays["partial"] = backend_of(unfinished.sums).to_host(unfinished.sums)
    _write_archive(path, run, header, arrays)


def _write_archive(path: Path, run: Named | None, header: Named, arrays: Named) -> None:
    with path.open("wb") as file:
        np.savez(file, header=json.dumps(stamped({"run": run, **header})), **arrays)
        file.flush()
        # On the disk before it replaces the one of before.
        os.fsync(file.fileno())


def _archive(path: Path) -> tuple[Named, dict[str, Array]]:
    """Return the header and the arrays of a checkpoint."""
    require_memory(path.stat().st_size, f"{path.stat().st_size} bytes")
    with np.load(path, allow_pickle=False) as archive:
        arrays = dict(archive)
    return json.loads(str(arrays.pop("header"))), arrays


def _read(path: Path, run: Named, take: Callable[[Any, Named], _State]) -> _State | None:
    """Return the state in a run's checkpoint, None if only preparation is there; refuse damage and other runs."""
    try:
        header, arrays = _archive(path)
        if header["run"] is None:
            return None
        there = {"format": header["format"], KEY: header[KEY], **header["run"]}
        changed = differences(there, {"format": FORMAT, KEY: VERSION, **run})
        if not changed:
            return take({name: array for name, array in arrays.items() if not name.startswith(_PREPARED)}, header)
    except Exception as error:
        # ZIP, JSON and NumPy report damage by many types of exception; all mean the same to the user.
        raise InputError(f"{path}: it is not a checkpoint of this version, or is damaged: {error}") from None
    shown_changes = "; ".join(changed[:3])
    more = len(changed) - 3
    raise InputError(
        f"{path}: the checkpoint of another run: {shown_changes}" + (f", and {more} more" if more > 0 else "")
    )


def _snapshot(shape: Sizes, archive: Mapping[str, Array], header: Named) -> Snapshot:
    image = archive["image"]
    if image.shape != shape:
        raise ValueError(f"image has the shape {image.shape} instead of {shape}")
    unfinished = None
    if "partial" in archive:
        unfinished = PartialSum(int(header["batches"]), archive["partial"], float(header["arrived"]))
    return Snapshot(int(header["sums"]), image, unfinished)


def differences(there: Any, here: Any) -> list[str]:
    """Return sentences on the nested values that differ between a record on disk and that of this run."""
    before = _flattened(there)
    now = _flattened(here)
    return [
        f"{name} = {before.get(name, 'nothing')} there, {now.get(name, 'nothing')} here"
        for name in {**now, **before}
        if name not in before or name not in now or before[name] != now[name]
    ]


def _flattened(values: Any, name: str = "") -> Named:
    """Return nested values by dotted names."""
    if not isinstance(values, (Mapping, list)) or not values:
        return {name: values}
    pairs = values.items() if isinstance(values, Mapping) else enumerate(values)
    levels = (_flattened(value, f"{name}.{key}" if name else str(key)) for key, value in pairs)
    return {key: value for level in levels for key, value in level.items()}
