"""Stray light over the field: the fraction of the mean light that each place of the detector gets besides its own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..array import read_table
from ..errors import put, refuse_if, require_number, suggest_keywords
from ..runtime import Doubles, Floats, PlainData, known_record


@suggest_keywords
@dataclass(frozen=True, eq=False)
class StrayLight(PlainData):
    """Stray light that differs over the field, in fractions of the mean light.

    The table spans the full detector, whatever its pixels: its first and last rows and columns are at the detector's
    edges, and values between are bilinear. A crop has the values of its place; its mean light is that of the pixels
    that it records.

    Parameters
    ----------
    values : array (rows, columns), nested lists, or path
        Fractions from 0 to 1, kept to five decimals, of rows from the top of the picture and columns from its left; at
        most 256 x 256. Or an NPY, FITS, EXR or grey PNG file of them, whose first row is the top one.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> less_in_corners = mp.StrayLight([[0.05, 0.1, 0.05], [0.1, 0.1, 0.1], [0.05, 0.1, 0.05]])
    >>> mp.PlenopticCamera(stray_light=less_in_corners).stray_light == less_in_corners
    True
    """

    values: Any

    def __post_init__(self) -> None:
        # Most rows and columns of a table, and the largest fraction.
        table = read_table("values", self.values, largest=256, most=1.0)
        # NumPy takes truth values for numbers.
        for value in np.array(self.values, object).flat:
            refuse_if(isinstance(value, bool), f"values = {value}: it must be a number")
        put(self, values=table)

    def at(self, across: Doubles, down: Doubles) -> Floats:
        """Return the fractions (rows, columns) at positions over the detector's width and height, from 0 to 1."""
        to_rows, to_columns = (
            np.maximum(0, 1 - abs(position[:, None] * (count - 1) - np.arange(count)))
            for position, count in zip((down, across), self.values.shape, strict=True)
        )
        return (to_rows @ self.values @ to_columns.T).astype(np.float32)

    def __repr__(self) -> str:
        rows, columns = self.values.shape
        return f"StrayLight({rows} x {columns} values)"


def known_stray_light(value: Any, resolve: Any = str) -> Any:
    """Return stray light as a number, or as a table from any of its forms."""
    if isinstance(value, (str, Path, dict, list, tuple, StrayLight)) or getattr(value, "ndim", 0) > 1:
        return known_record(StrayLight, "stray_light", value, resolve)
    return require_number("stray_light", value, minimum=0, maximum=1.0)
