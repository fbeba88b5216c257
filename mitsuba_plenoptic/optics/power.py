"""Power of fields: the total, and the fractions in the rim of a window and next to a band limit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..runtime.backend import backend_of
from ..runtime.fft import Field

_EDGE = 1 / 8
"""Outer fraction of a window or spectrum that should be dark; a uniform field has 23 % of its power there."""


def power(field: Field) -> float:
    """Sum of the squared moduli of a field whose rows are contiguous."""
    return float(_power_by_row(field).sum())


def rim(size: int) -> int:
    """Return the width in samples of a window's rim, on one side."""
    return max(1, round(size * _EDGE / 2))


def band_edge_fraction(
    spectrum: Field, frequencies: np.ndarray | None = None, weight: np.ndarray | float = 1.0
) -> float:
    """Fraction of the power in the outer eighth of the frequencies; zero frequency is first.

    `spectrum` has the shape (rows, columns); `frequencies` and `weight` have one value for each row.
    """
    rows = frequencies_of(len(spectrum)) if frequencies is None else frequencies
    outer, high = np.abs(rows) > 1 - _EDGE, np.flatnonzero(np.abs(frequencies_of(spectrum.shape[1])) > 1 - _EDGE)
    # The high frequencies are in the middle of the columns.
    columns = spectrum[:, int(high[0]) : int(high[-1]) + 1] if high.size else spectrum[:, :0]
    edge = weighted(weight * outer, spectrum) + weighted(weight * ~outer, columns)
    return fraction(edge, weighted(weight * np.ones(len(rows)), spectrum))


def frequencies_of(size: int) -> np.ndarray:
    """Frequencies of a transform over the grid's band limit, zero first, as float64 (size,)."""
    return np.fft.fftfreq(size) * 2


def fraction(part: float, whole: float) -> float:
    """Return part / whole, or 0 if the whole is 0."""
    return float(part / whole) if whole > 0 else 0.0


def weighted(weight: np.ndarray, field: Field) -> float:
    """Sum of the power of rows, each multiplied by its weight."""
    return float((backend_of(field).arrays.asarray(weight.astype(np.float64)) * _power_by_row(field)).sum())


def _power_by_row(field: Field) -> NDArray[np.float64]:
    """Sum of the squared moduli of each row, computed on the field's own device."""
    parts = field.view(np.float32)
    return backend_of(field).arrays.einsum("ij,ij->i", parts, parts).astype(np.float64)
