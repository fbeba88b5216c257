"""Arrays in HDF5 files, whoever wrote these."""

from __future__ import annotations

import importlib
import math
from typing import Any

from ..errors import InputError

# Chunks of arrays that are smaller than this may be larger than they are.
_SMALL = 2**20


def h5py_module(purpose: str) -> Any:
    """Return the module h5py.

    Raises
    ------
    InputError
        If it is not installed: what it is needed for, and how to get it.
    """
    try:
        return importlib.import_module("h5py")
    except ImportError:
        raise InputError(f"{purpose} needs the package h5py: pip install h5py") from None


def stored_array(group: Any, name: str) -> Any:
    """Return the array of numbers of a name that lies in this very file, or None if there is none.

    HDF5 can link to other files, keep data in other files and assemble them from other files; of a file from a
    stranger that would read files of the user's.

    Raises
    ------
    InputError
        If it is something else, or is stored in chunks that are much larger than itself.
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
