"""Samples in HDF5 files: a group for each, of the sample's number in six digits, with its arrays and its facts.

The same samples give the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..io.files import atomic_output, require_file
from ..io.hdf5 import h5py_module, stored_array
from ..runtime.limits import require_memory
from .sample import Sample

_FACTS = "facts"

_LARGEST_FACTS = 2**26


def group_name(index: int) -> str:
    """Return the name of a sample's group."""
    return f"{index:06d}"


def write_samples(path: Path, samples: Iterable[Sample]) -> None:
    """Write samples to a file, which appears whole or not at all."""
    h5py = h5py_module("a data set")
    with atomic_output(path) as temporary, h5py.File(temporary, "w") as file:
        for sample in samples:
            group = file.create_group(group_name(sample.index))
            for name, array in sample.arrays.items():
                group.create_dataset(name, data=np.asarray(array, np.float32))
            # Text of any length: attributes end at 64 KiB.
            facts = json.dumps(sample.facts, sort_keys=True).encode()
            group.create_dataset(_FACTS, data=np.frombuffer(facts, np.uint8))


def open_shard(path: Path) -> Any:
    """Open a file of samples for reading.

    Raises
    ------
    InputError
        If it does not exist or is no HDF5.
    """
    h5py = h5py_module("a data set")
    try:
        return h5py.File(require_file(path), "r")
    except OSError as error:
        raise InputError(f"{path}: it is damaged: {' '.join(str(error).split())}") from None


def read_sample(file: Any, path: Path, index: int, names: Collection[str] | None = None) -> Sample:
    """Read a sample from an open file.

    Parameters
    ----------
    file : h5py.File
        What `open_shard` returned.
    path : path
        The file's name, for messages.
    index : int
        Number of the sample.
    names : collection of str, optional
        The arrays to read. Default: all.

    Raises
    ------
    InputError
        If it has no such sample or array, or they are no arrays of numbers in the file itself.
    """
    h5py = h5py_module("a data set")
    try:
        if not isinstance(file.get(group_name(index), getlink=True), h5py.HardLink):
            raise InputError(f"it has no sample {index}")
        group = file[group_name(index)]
        arrays = {}
        for name in (key for key in group if key != _FACTS) if names is None else names:
            stored = stored_array(group, name)
            if stored is None:
                raise InputError(f"sample {index}: it has no {name}; it has {', '.join(group)}")
            require_memory(float(stored.size) * stored.dtype.itemsize, f"{name} of sample {index}")
            arrays[name] = np.asarray(stored[()], np.float32)
        text = stored_array(group, _FACTS)
        if text is None or text.dtype != np.uint8 or text.size > _LARGEST_FACTS:
            raise InputError(f"sample {index}: it has no facts")
        facts = json.loads(text[()].tobytes())
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        raise InputError(f"{path}: sample {index} is damaged: {' '.join(str(error).split())}") from None
    return Sample(index, arrays, facts)


def indices_in(path: Path) -> list[int]:
    """Return the numbers of the samples in a file; none if there is no such file."""
    if not path.exists():
        return []
    with open_shard(path) as file:
        return [int(name) for name in file]
