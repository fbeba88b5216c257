"""Tables of numbers as text, from anyone."""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .files import read_text

_LARGEST_FILE = 2**22


def read_table(path: str | Path) -> NDArray[np.float64]:
    """Read the numbers of a CSV file, all columns of all rows, at most 4 MiB; its first line may be one of names."""
    lines = [line for line in read_text(path, _LARGEST_FILE).splitlines() if line.strip()]
    if lines and not any(_is_number(cell) for cell in lines[0].split(",")):
        lines = lines[1:]
    try:
        rows = np.loadtxt(lines, delimiter=",", ndmin=2) if lines else np.empty((0, 0))
    except ValueError as error:
        raise InputError(f"{path}: it is no table of numbers: {error}") from None
    if not len(rows):
        raise InputError(f"{path}: it has no rows of numbers")
    if not np.isfinite(rows).all():
        row = int(np.flatnonzero(~np.isfinite(rows).all(axis=1))[0])
        raise InputError(f"{path}, row {row + 1}: all numbers must be finite")
    return np.asarray(rows)


def _is_number(text: str) -> bool:
    """Whether a cell is a number, or is meant to be one."""
    try:
        float(text)
    except ValueError:
        return False
    return True


# Chunks of arrays that are smaller than this may be larger than they are.
_SMALL = 2**20


def h5py_module(purpose: str) -> Any:
    """Return the module h5py."""
    try:
        return importlib.import_module("h5py")
    except ImportError:
        raise InputError(f"{purpose} needs the package h5py: pip install h5py") from None


def stored_array(group: Any, name: str) -> Any:
    """Return the array of numbers of a name that lies in this very file, or None if there is none.

    HDF5 can link to other files, keep data in other files and assemble them from other files; of a file from a
    stranger that would read files of the user's.
    """
    h5py = h5py_module("HDF5")
    if not isinstance(group, h5py.Group):
        raise InputError(f"{name} is in no structure")
    link = group.get(name, getlink=True)
    if link is None:
        return None
    stored = group[name] if isinstance(link, h5py.HardLink) else None
    if not isinstance(stored, h5py.Dataset) or stored.is_virtual or stored.external:
        raise InputError(f"{name} is not an array in the file itself: links to other files are not followed")
    if stored.dtype.kind not in "fiu" or stored.dtype.itemsize > 8:
        raise InputError(f"{name} is not an array of numbers")
    # A chunk is decompressed whole, however little of it the array uses.
    if stored.chunks and math.prod(stored.chunks) > max(stored.size, 1) + _SMALL:
        raise InputError(f"{name} is stored in chunks of {stored.chunks}, larger than itself")
    return stored
