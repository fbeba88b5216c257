"""Samples in HDF5 files: a group for each, of the sample's number in six digits, with its arrays and its facts.

Its ``digests``, JSON by the names of the others, are compared whenever an array is read, so that a damaged sample is
never taken for a whole one. The same samples give the same bytes.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..io.checkpoints import digest
from ..io.files import atomic_output, require_file
from ..io.tables import h5py_module, stored_array
from ..runtime.limits import require_memory
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


def read_sample(file: Any, path: Path, index: int, names: Collection[str] | None = None) -> Sample:
    """Read a sample from an open file."""
    h5py = h5py_module("a data set")
    try:
        if not isinstance(file.get(group_name(index), getlink=True), h5py.HardLink):
            raise InputError(f"it has no sample {index}")
        group = file[group_name(index)]

        def read(name: str) -> NDArray[Any]:
            stored = stored_array(group, name)
            if stored is None:
                raise InputError(f"sample {index}: it has no {name}; it has {', '.join(group)}")
            require_memory(float(stored.size) * stored.dtype.itemsize, f"{name} of sample {index}")
            return np.asarray(stored[()])

        digests, arrays = json.loads(read(_DIGESTS).tobytes()), {}
        for name in digests if names is None else [*names, _FACTS]:
            arrays[name] = read(name)
            if digest(arrays[name]) != digests[name]:
                raise ValueError(f"{name} is not what was written")
        facts = json.loads(arrays.pop(_FACTS).tobytes())
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: sample {index} is damaged: {' '.join(str(error).split())}") from None
    return Sample(index, arrays, facts)


def whole_samples(path: Path) -> set[int]:
    """Return the numbers of the undamaged samples in a file, if there is one, and name the damaged ones in the log."""
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
