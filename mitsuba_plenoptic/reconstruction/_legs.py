"""One leg of a back-propagation: a thin element, then free space to the next plane, axis by axis.

Fourier transforms are done on blocks of rows that stay in the processor's cache, rows that hold no light are left
out, and so are the frequencies and destination samples that nobody asks for.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..optics.free_space import advance
from ..runtime.backend import backend
from ..runtime.fft import Field, fft, resting_drjit
from ._elements import FieldThrough
from ._plan import Leg

# Rows that are transformed together: in the processor's cache, or so many that a CUDA device is busy.
_BLOCK, _CUDA_BLOCK = 64, 4096

# Columns a whole number of pages apart would fall on the same few lines of the cache when they are turned.
_PAGE, _STAGGER = 512, 24


class Workspace:
    """Memory that is used again: fresh pages would cost nearly as much as the transforms on them."""

    def __init__(self) -> None:
        self.libraries = backend()
        self.block = _CUDA_BLOCK if self.libraries.is_cuda else _BLOCK
        self._buffers: dict[str, Field] = {}

    def array(self, name: str, shape: tuple[int, int]) -> Field:
        """Give an array with any content; it holds until the same name is asked for again."""
        size = shape[0] * shape[1]
        if name not in self._buffers or self._buffers[name].size < size:
            self._buffers[name] = self.libraries.arrays.empty(size, np.complex64)
        return self._buffers[name][:size].reshape(shape)


def propagate_leg(
    field: np.ndarray | FieldThrough,
    row_factor: np.ndarray,
    column_factor: np.ndarray,
    leg: Leg,
    distance: float,
    wavelength: float,
    workspace: Workspace,
    name: str,
) -> Field:
    """Multiply a field by a thin element and propagate it.

    Parameters
    ----------
    field : float32 or complex64 array (rows, columns), or FieldThrough
        The source samples of the leg, perhaps behind another element.
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
    workspace : Workspace
        Where the work is done.
    name : str
        Which of its arrays the result is; another one than that of `field`.

    Returns
    -------
    complex64 array (leg.y.wanted, leg.x.wanted)
        The field at the destination samples, without the carrier.
    """
    # Both the spectra of rows and the fields that come back lie in here, column by column.
    width = max(leg.y.count, leg.y.wanted)
    columns = workspace.array("columns", (leg.x.kept, width + -width % _PAGE + _STAGGER))
    with resting_drjit():
        _to_columns(field, row_factor, column_factor, leg, columns, workspace)
        _across_space(columns, leg, distance, wavelength, workspace)
        return _from_columns(columns, leg, workspace.array(name, leg.shape), workspace)


def _to_columns(
    field: np.ndarray | FieldThrough,
    row_factor: np.ndarray,
    column_factor: np.ndarray,
    leg: Leg,
    columns: Field,
    workspace: Workspace,
) -> None:
    """Transform the lit rows and keep the lowest frequencies, turned into columns."""
    x, arrays = leg.x, workspace.libraries.arrays
    along_x, along_y = arrays.asarray(column_factor), arrays.asarray(row_factor)
    columns[:, arrays.asarray(np.flatnonzero(row_factor == 0))] = 0
    block = workspace.array("block", (workspace.block, x.padded))
    low, high = _lowest(x.padded, x.kept)
    for rows in _lit_blocks(row_factor, workspace.block):
        part = block[: rows.stop - rows.start]
        arrays.multiply(field[rows], along_x, out=part[:, : x.count])
        part[:, : x.count] *= along_y[rows, None]
        part[:, x.count :] = 0
        part = _fft(part, 1)
        columns[: low.stop, rows] = part[:, low].T
        columns[low.stop :, rows] = part[:, high].T


def _across_space(columns: Field, leg: Leg, distance: float, wavelength: float, workspace: Workspace) -> None:
    """Transform columns, multiply by the transfer function, transform back, in place."""
    x, y, together = leg.x, leg.y, workspace.block
    block = workspace.array("block", (together, y.padded))
    spectrum = workspace.array("spectrum", (together, y.kept))
    low, high = _lowest(y.padded, y.kept)
    for place in range(0, x.kept, together):
        size = min(together, x.kept - place)
        part = block[:size]
        part[:, : y.count] = columns[place : place + size, : y.count]
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
        columns[place : place + size, : y.wanted] = _fft(advanced, 1, inverse=True)[:, : y.wanted]


def _from_columns(columns: Field, leg: Leg, out: Field, workspace: Workspace) -> Field:
    """Turn columns into rows, transform these back and keep their first samples."""
    block = workspace.array("block", (workspace.block, leg.x.kept))
    for place in range(0, leg.y.wanted, workspace.block):
        part = block[: min(workspace.block, leg.y.wanted - place)]
        part[:] = columns[:, place : place + part.shape[0]].T
        out[place : place + part.shape[0]] = _fft(part, 1, inverse=True)[:, : leg.x.wanted]
    return out


def _lit_blocks(row_factor: np.ndarray, together: int) -> Iterator[slice]:
    """Give the runs of rows that are not dark, cut to blocks."""
    edges = np.flatnonzero(np.diff(row_factor != 0, prepend=False, append=False))
    for first, end in edges.reshape(-1, 2).tolist():
        for place in range(first, end, together):
            yield slice(place, min(place + together, end))


def _lowest(size: int, kept: int) -> tuple[slice, slice]:
    """Where the lowest frequencies are in a spectrum with zero frequency first: from zero on, and below zero."""
    positive = (kept + 1) // 2
    return slice(0, positive), slice(size - (kept - positive), size)


def _fft(field: Field, axis: int, *, inverse: bool = False) -> Field:
    """Transform along one axis in place; forward transforms are divided by the length, inverse ones are not."""
    return fft(field, axis=axis, inverse=inverse, norm="forward")
