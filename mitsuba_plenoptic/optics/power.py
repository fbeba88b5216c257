"""Power of fields: in all, in the rim of a window, next to a band limit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..runtime.backend import backend_of
from ..runtime.fft import Field

_EDGE = 1 / 8
"""Outer part of a window or a spectrum, which should be dark. A field that fills all evenly has 23 % there."""


def power(field: Field) -> float:
    """Sum of the squared moduli of a field whose rows are contiguous."""
    return float(_power_by_row(field).sum())


def rim(size: int) -> int:
    """Return the samples of a window's rim on one side."""
    return max(1, round(size * _EDGE / 2))


def band_edge_fraction(
    spectrum: Field, frequencies: np.ndarray | None = None, weight: np.ndarray | float = 1.0
) -> float:
    """Fraction of the power in the outer eighth of the frequencies, zero frequency first.

    Shapes: `spectrum` (rows, columns), `frequencies` (rows,), `weight` (rows,).
    """
    rows = frequencies_of(len(spectrum)) if frequencies is None else frequencies
    outer, high = np.abs(rows) > 1 - _EDGE, np.flatnonzero(np.abs(frequencies_of(spectrum.shape[1])) > 1 - _EDGE)
    # They are in the middle.
    columns = spectrum[:, int(high[0]) : int(high[-1]) + 1] if high.size else spectrum[:, :0]
    edge = weighted(weight * outer, spectrum) + weighted(weight * ~outer, columns)
    return fraction(edge, weighted(weight * np.ones(len(rows)), spectrum))


def frequencies_of(size: int) -> np.ndarray:
    """Frequencies of a transform over the grid's band limit, zero first; float64 (size,)."""
    return np.fft.fftfreq(size) * 2


def fraction(part: float, whole: float) -> float:
    """Quotient, 0 of nothing."""
    return float(part / whole) if whole > 0 else 0.0


def weighted(weight: np.ndarray, field: Field) -> float:
    """Power of some rows, each as often as its weight says."""
    return float((backend_of(field).arrays.asarray(weight.astype(np.float64)) * _power_by_row(field)).sum())


def _power_by_row(field: Field) -> NDArray[np.float64]:
    """Sum of the squared moduli of each row, where the field lies."""
    parts = field.view(np.float32)
    return backend_of(field).arrays.einsum("ij,ij->i", parts, parts).astype(np.float64)
