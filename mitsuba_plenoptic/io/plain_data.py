"""Text, tables, YAML and HDF5 of any origin, read with bounds on what they may claim."""

from __future__ import annotations

import importlib
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from ..errors import InputError, refuse_if
from .files import read_text

LARGEST_FILE = 2**16


class _Loader(yaml.SafeLoader):
    """YAML as version 1.2 and JSON have it, without what is easily mistaken.

    PyYAML reads version 1.1, in which 1e-05 is text, 010 is 8, 1:30 is 90 and `no` is false. Names given twice, and
    aliases, by which a small file grows endless, are refused.
    """

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value]
        for key in keys:
            refuse_if(keys.count(key) > 1, f"{key} is given twice")
        return super().construct_mapping(node, deep)

    def compose_node(self, parent: Any, index: Any) -> Any:
        refuse_if(self.check_event(yaml.AliasEvent), "aliases (*name) are not allowed")
        return super().compose_node(parent, index)


# The scalars of the core schema of YAML 1.2 (section 10.3.2), without octal and hexadecimal numbers.
_Loader.yaml_implicit_resolvers = {}
for _kind, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+", list("-+0123456789")),
    ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", list("-+.0123456789")),
    ("float", r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)", list("-+.")),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_kind}", re.compile(rf"^(?:{_pattern})$"), _first)
_Loader.add_constructor("tag:yaml.org,2002:int", lambda loader, node: int(loader.construct_scalar(node)))


def read_yaml(path: str | Path) -> Any:
    """Read a YAML or JSON file of at most 64 KiB, without aliases."""
    text = read_text(path, LARGEST_FILE)
    try:
        return yaml.load(text, Loader=_Loader)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: it is not YAML: {' '.join(str(error).split())}") from None


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
    refuse_if(not len(rows), f"{path}: it has no rows of numbers")
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
    """Return the array of numbers of a name that lies in this very file, or None if there is no such array.

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
    refuse_if(stored.dtype.kind not in "fiu" or stored.dtype.itemsize > 8, f"{name} is not an array of numbers")
    # A chunk is decompressed whole, however little of it the array uses.
    refuse_if(
        stored.chunks and math.prod(stored.chunks) > max(stored.size, 1) + _SMALL,
        f"{name} is stored in chunks of {stored.chunks}, larger than itself",
    )
    return stored
