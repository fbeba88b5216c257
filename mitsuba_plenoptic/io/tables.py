"""Tables of numbers as text, from anyone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .files import read_text

_LARGEST_FILE = 2**22


def read_table(path: str | Path) -> NDArray[np.float64]:
    """Read the numbers of a CSV file, all columns of all rows, at most 4 MiB; its first line may be one of names.

    Parameters
    ----------
    path : path
        The file.

    Raises
    ------
    InputError
        If there is no such file, it is larger, or its rows are not finite numbers, the same count in each.
    """
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
