"""The grid of a sweep: names, each with the numbers that it takes, from YAML or from the command line.

What is no such grid is refused with an `InputError`.
"""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ...errors import InputError, require_number
from ...io.yaml_file import read_yaml

# Names that are not parameters of the scene.
WAVELENGTH, DISTANCE = "wavelength", "distance"

Grid = Mapping[str, Sequence[float]]

_MOST_POINTS = 100_000


def read_grid(path: Path) -> dict[str, list[Any]]:
    """Read a grid from YAML: names, each with a list of numbers, or with one."""
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: it must hold names, each with a list of numbers, such as 'wavelength: [532, 633]'")
    return {name: value if isinstance(value, list) else [value] for name, value in content.items()}


def parse_grid(texts: Iterable[str]) -> dict[str, list[Any]]:
    """Turn texts ``name=1,2,3`` into a grid."""
    grids = []
    for text in texts:
        name, equals, values = text.partition("=")
        if not name or not equals:
            raise InputError(f"--vary {text}: write it as --vary NAME=VALUE,VALUE,...")
        grids.append({name: [part.strip() for part in values.split(",")] if values.strip() else []})
    return merge_grids(*grids)


def merge_grids(*grids: Mapping[str, list[Any]]) -> dict[str, list[Any]]:
    """Join grids that have no name in common."""
    merged: dict[str, list[Any]] = {}
    for grid in grids:
        for name in grid:
            if name in merged:
                raise InputError(f"grid: {name} is given twice")
        merged |= grid
    return merged


def check_grid(grid: Mapping[Any, Any]) -> dict[str, tuple[float, ...]]:
    """Return a grid, neither empty nor too large, with its values as finite numbers of which none comes twice."""
    checked: dict[str, tuple[float, ...]] = {}
    for name, values in grid.items():
        if not isinstance(name, str) or not name.isidentifier():
            raise InputError(f"grid: {name!r} is not a name")
        if not len(values):
            raise InputError(f"grid: {name} has no values")
        checked[name] = tuple(_number(name, value) for value in values)
        for value, count in Counter(checked[name]).items():
            if count > 1:
                raise InputError(f"grid: {name} = {value:g} is given twice")
    if not checked:
        raise InputError("grid: it is empty; give at least one name with values")
    count = math.prod(len(values) for values in checked.values())
    if count > _MOST_POINTS:
        raise InputError(f"grid: it has {count} points; at most {_MOST_POINTS} are allowed")
    return checked


def _number(name: str, value: Any) -> float:
    if isinstance(value, (list, tuple, dict)):
        raise InputError(f"grid: {name} holds a {type(value).__name__}: it must be a number")
    if isinstance(value, str):
        with contextlib.suppress(ValueError):
            value = float(value)
    return require_number(f"grid: {name}", value)
