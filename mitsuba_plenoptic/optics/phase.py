"""Phase factors of path differences, softened edges of pupils, and the power of fields."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..runtime.backend import backend_of
from ..runtime.fft import Field, array_types

_MM_PER_NM = 1e-6


def in_millimetres(wavelength: float) -> float:
    """Return a wavelength in millimetres, from nanometres."""
    return wavelength * _MM_PER_NM


def phasor(waves: Any) -> Any:
    r"""Return :math:`\exp(2 \pi i w)` for path differences in waves.

    Paths may be 10^6 waves, which single precision cannot represent. Whole waves are therefore removed in double
    precision, and only the remainder is passed to sine and cosine in single precision, with an error of 3e-7 rad at any
    distance.
    """
    if not dr.is_array_v(waves):
        return np.exp(2j * math.pi * waves).astype(np.complex64)
    types = array_types(waves)
    sine, cosine = dr.sincos(types.Float(waves - dr.round(waves)) * (2 * math.pi))
    return types.Complex2f(cosine, sine)


def parabola(square: Any, focal_length: Any, wavelength: float) -> Any:
    r"""Return the path difference of a thin parabolic lens in waves, :math:`-r^2 / 2 \lambda f`.

    Goodman, "Introduction to Fourier Optics", section 5.1.
    """
    return square * (-0.5 / (in_millimetres(wavelength) * focal_length))


def soft_edge(samples: Any) -> Any:
    """Return the transmission of an edge that is softened over one sample, at distances inside it in samples.

    The steep spectrum of a hard edge would be aliased into the band of the grid.
    """
    clip = dr.clip if dr.is_array_v(samples) else np.clip
    return clip(samples + 0.5, 0, 1)


def smooth_edge(samples: Any) -> Any:
    """Return the transmission of an edge as `soft_edge` does, but smoothed by a cubic between the same ends."""
    passed = soft_edge(samples)
    return passed * passed * (3 - 2 * passed)


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
