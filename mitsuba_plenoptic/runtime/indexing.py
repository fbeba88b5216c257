"""Flat indices of Dr.Jit kernels, taken apart."""

from __future__ import annotations

from typing import Any

import drjit as dr


def rows_and_columns(types: Any, rows: int, columns: int) -> tuple[Any, Any]:
    """Return the row and the column of each sample of an image, line by line."""
    index = dr.arange(types.UInt32, rows * columns)
    row = quotient(types, index, columns)
    return row, index - row * dr.opaque(types.UInt32, columns)


def split(types: Any, index: Any, rows: int, columns: int) -> tuple[Any, Any, Any]:
    """Take a flat index apart into that of an image, its row and its column."""
    line = quotient(types, index, columns)
    image = quotient(types, line, rows)
    return (
        image,
        line - image * dr.opaque(types.UInt32, rows),
        index - line * dr.opaque(types.UInt32, columns),
    )


def quotient(types: Any, index: Any, divisor: int) -> Any:
    """Whole quotient, by a multiplication: Dr.Jit's division of integers is several times slower."""
    return types.UInt32((types.Float64(index) + 0.5) * dr.opaque(types.Float64, 1 / divisor))
