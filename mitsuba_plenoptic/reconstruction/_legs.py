"""One leg of a back-propagation: a thin element, then free space to the next plane, axis by axis.

Fourier transforms are done on blocks of rows that stay in the processor's cache, rows that hold no light are left
out, and so are the frequencies and destination samples that nobody asks for.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy.fft

from ..propagation.angular_spectrum import advance
from ..propagation.fft import Field, resting_drjit, worker_count
from ._plan import Leg

_BLOCK = 64


def propagate_leg(
    field: np.ndarray, row_factor: np.ndarray, column_factor: np.ndarray, leg: Leg, distance: float, wavelength: float
) -> Field:
    """Multiply a field by a thin element and propagate it.

    Parameters
    ----------
    field : float32 or complex64 array (rows, columns)
        The source samples of the leg.
    row_factor : complex64 array (rows,)
        The element's transmission along y; rows where it is zero cost nothing.
    column_factor : complex64 array (columns,)
        Its transmission along x, which multiplies that along y.
    leg : Leg
        Sampling.
    distance : float
        Way in millimetres.
    wavelength : float
        Wavelength in nanometres.

    Returns
    -------
    complex64 array (leg.y.wanted, leg.x.wanted)
        The field at the destination samples, without the carrier.
    """
    with resting_drjit():
        columns = _to_columns(field, row_factor, column_factor, leg)
        rows = _across_space(columns, leg, distance, wavelength)
        return _rows_back(rows, leg.x.wanted)


def _to_columns(field: np.ndarray, row_factor: np.ndarray, column_factor: np.ndarray, leg: Leg) -> Field:
    """Transform the lit rows and keep the lowest frequencies: (x.kept, y.count), so that columns lie together."""
    x, y = leg.x, leg.y
    columns = np.zeros((x.kept, y.count), np.complex64)
    block = np.empty((_BLOCK, x.padded), np.complex64)
    low, high = _lowest(x.padded, x.kept)
    for rows in _lit_blocks(row_factor):
        part = block[: rows.stop - rows.start]
        np.multiply(field[rows], column_factor, out=part[:, : x.count])
        part[:, : x.count] *= row_factor[rows, None]
        part[:, x.count :] = 0
        part = _fft(part, 1)
        columns[: low.stop, rows] = part[:, low].T
        columns[low.stop :, rows] = part[:, high].T
    return columns


def _across_space(columns: Field, leg: Leg, distance: float, wavelength: float) -> Field:
    """Transform columns, multiply by the transfer function, and transform back: (y.wanted, x.kept)."""
    x, y = leg.x, leg.y
    rows = np.empty((y.wanted, x.kept), np.complex64)
    block = np.empty((_BLOCK, y.padded), np.complex64)
    spectrum = np.empty((_BLOCK, y.kept), np.complex64)
    low, high = _lowest(y.padded, y.kept)
    for place in range(0, x.kept, _BLOCK):
        size = min(_BLOCK, x.kept - place)
        part = block[:size]
        part[:, : y.count] = columns[place : place + size]
        part[:, y.count :] = 0
        part = _fft(part, 1)
        spectrum[:size, : low.stop] = part[:, low]
        spectrum[:size, low.stop :] = part[:, high]
        advanced = advance(
            spectrum[:size],
            (x.new_pitch, y.new_pitch),
            distance,
            wavelength,
            shift=(x.start - x.first, y.start - y.first),
            part=(place, x.kept),
        )
        rows[:, place : place + size] = _fft(advanced, 1, inverse=True)[:, : y.wanted].T
    return rows


def _lit_blocks(row_factor: np.ndarray) -> Iterator[slice]:
    """Give the runs of rows that are not dark, cut to blocks."""
    edges = np.flatnonzero(np.diff(row_factor != 0, prepend=False, append=False))
    for first, end in edges.reshape(-1, 2).tolist():
        for place in range(first, end, _BLOCK):
            yield slice(place, min(place + _BLOCK, end))


def _rows_back(rows: Field, wanted: int) -> Field:
    """Transform rows back and keep their first samples."""
    out = np.empty((rows.shape[0], wanted), np.complex64)
    for place in range(0, rows.shape[0], _BLOCK):
        out[place : place + _BLOCK] = _fft(rows[place : place + _BLOCK], 1, inverse=True)[:, :wanted]
    return out


def _lowest(size: int, kept: int) -> tuple[slice, slice]:
    """Where the lowest frequencies are in a spectrum with zero frequency first: from zero on, and below zero."""
    positive = (kept + 1) // 2
    return slice(0, positive), slice(size - (kept - positive), size)


def _fft(field: Field, axis: int, *, inverse: bool = False) -> Field:
    """Transform along one axis in place; forward transforms are divided by the length, inverse ones are not."""
    transform: Any = scipy.fft.ifft if inverse else scipy.fft.fft
    return transform(field, axis=axis, norm="forward", overwrite_x=True, workers=worker_count())
