"""Samples in HDF5 files: a group for each, of the sample's index in six digits, with its arrays and its facts.

Its ``digests``, JSON by the names of the others, are compared whenever an array is read, so that a damaged sample is
never taken for a whole one. The same samples give the same bytes.
"""

from __future__ import annotations

import json
import logging
import os
import warnings
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, refuse_if, require_count
from ..io.checkpoints import digest
from ..io.files import atomic_output, read_text, require_file
from ..io.plain_data import h5py_module, stored_array
from ..runtime.limits import require_memory
from .layout import CHECKSUMS, LARGEST_LIST, Layout, checksum, read_manifest
from .sample import Sample

_FACTS, _DIGESTS = "facts", "digests"

_log = logging.getLogger(__name__)


def group_name(index: int) -> str:
    """Return the name of a sample's group."""
    return f"{index:06d}"


def write_samples(path: Path, samples: Iterable[Sample]) -> None:
    """Write samples to a file, which appears whole or not at all."""
    h5py = h5py_module("a data set")
    with atomic_output(path) as temporary, h5py.File(temporary, "w") as file:
        for sample in samples:
            group = file.create_group(group_name(sample.index))
            arrays: dict[str, NDArray[Any]] = {
                name: np.asarray(array, np.float32) for name, array in sample.arrays.items()
            }
            arrays[_FACTS] = _as_bytes(sample.facts)
            arrays[_DIGESTS] = _as_bytes({name: digest(array) for name, array in arrays.items()})
            for name, array in arrays.items():
                group.create_dataset(name, data=array)


def _as_bytes(values: dict[str, Any]) -> NDArray[np.uint8]:
    """Return JSON of any length: attributes of HDF5 end at 64 KiB."""
    return np.frombuffer(json.dumps(values, sort_keys=True).encode(), np.uint8)


def open_shard(path: Path) -> Any:
    """Open a file of samples for reading."""
    h5py = h5py_module("a data set")
    try:
        return h5py.File(require_file(path), "r")
    except OSError as error:
        raise InputError(f"{path}: it is damaged: {' '.join(str(error).split())}") from None


def read_sample(
    file: Any, path: Path, index: int, names: Collection[str] | None = None, *, with_digests: bool = True
) -> Sample:
    """Read a sample from an open file; unless `with_digests`, one that has none, and cannot be compared, is read, too.

    Data sets of version 0.2.0 have no digests.
    """
    h5py = h5py_module("a data set")
    try:
        refuse_if(not isinstance(file.get(group_name(index), getlink=True), h5py.HardLink), f"it has no sample {index}")
        group = file[group_name(index)]

        def read(name: str) -> NDArray[Any]:
            stored = stored_array(group, name)
            refuse_if(stored is None, f"sample {index}: it has no {name}; it has {', '.join(group)}")
            require_memory(float(stored.size) * stored.dtype.itemsize, f"{name} of sample {index}")
            return np.asarray(stored[()])

        compared = with_digests or _DIGESTS in group
        digests, arrays = json.loads(read(_DIGESTS).tobytes()) if compared else {}, {}
        if not compared:
            warnings.warn(
                f"{path.parent.parent}: its samples have no digests, as those of version 0.2.0: what is damaged in "
                f"them is not noticed, other than by DataSet.damaged()",
                stacklevel=3,
            )
        for name in (digests or set(group) - {_DIGESTS}) if names is None else [*names, _FACTS]:
            arrays[name] = read(name)
            if compared and digest(arrays[name]) != digests[name]:
                raise ValueError(f"{name} is not what was written")
        facts = json.loads(arrays.pop(_FACTS).tobytes())
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: sample {index} is damaged: {' '.join(str(error).split())}") from None
    return Sample(index, arrays, facts)


def whole_samples(path: Path) -> set[int]:
    """Return the indices of the undamaged samples in a file, if there is one, and name the damaged ones in the log."""
    if not path.exists():
        return set()
    found = set()
    try:
        with open_shard(path) as file:
            for name in file:
                try:
                    found.add(read_sample(file, path, int(name)).index)
                except (InputError, ValueError) as error:
                    _log.warning("%s; it is rendered again", error)
    except (InputError, RuntimeError) as error:
        _log.warning("%s; its samples are rendered again", error)
    return found


class DataSet:
    """A data set in its folder: ``dataset[17]`` is a `Sample`.

    Samples are read when they are asked for. It may be pickled and used in forked processes; each opens the files anew.

    Parameters
    ----------
    folder : path
        What `make_dataset` or ``mitsuba-plenoptic dataset`` wrote.
    fields : collection of str, optional
        Names of the arrays to read. Default: all.

    Raises
    ------
    InputError
        If the folder holds no data set, or one whose shards are not all there.
    """

    def __init__(self, folder: str | Path, fields: Collection[str] | None = None) -> None:
        self.folder = Path(folder)
        self.manifest = read_manifest(self.folder)
        self.fields = None if fields is None else tuple(fields)
        self._layout = Layout(self.folder, self.manifest["count"], self.manifest["samples_per_shard"])
        self._files: dict[int, Any] = {}
        self._process = os.getpid()
        for number in range(self._layout.shards):
            if not self._layout.shard(number).is_file():
                raise InputError(
                    f"{self._layout.shard(number)}: it is missing: run the command that makes the data set again"
                )

    def __len__(self) -> int:
        return self._layout.count

    def __getitem__(self, index: int) -> Sample:
        """Read a sample by its index."""
        if index >= len(self):
            raise IndexError(f"sample {index}: there are {len(self)}")
        index = require_count("sample", index, minimum=0)
        number = index // self._layout.samples_per_shard
        return read_sample(self._open(number), self._layout.shard(number), index, self.fields, with_digests=False)

    def __iter__(self) -> Iterator[Sample]:
        for index in range(len(self)):
            yield self[index]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_files": {}}

    def damaged(self) -> list[str]:
        """Compare all files with their checksums, and return the names of those that differ or are missing.

        Raises
        ------
        InputError
            If there are no checksums.
        """
        lines = read_text(self.folder / CHECKSUMS, LARGEST_LIST).splitlines()
        found = []
        for expected, _, name in (line.partition("  ") for line in lines):
            # No name in the file leads out of the folder.
            path = self.folder / name
            inside = path.resolve().is_relative_to(self.folder.resolve())
            if not inside or not path.is_file() or checksum(path) != expected:
                found.append(name)
        return found

    def _open(self, number: int) -> Any:
        if self._process != os.getpid():
            # HDF5's handles are those of the process that opened them.
            self._files, self._process = {}, os.getpid()
        if number not in self._files:
            self._files[number] = open_shard(self._layout.shard(number))
        return self._files[number]
