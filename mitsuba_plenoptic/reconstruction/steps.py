"""One propagation step of a reconstruction: free space from the samples of one plane to those of the next.

A field is handed from step to step in blocks of rows, in order from the first row to the last. A step transforms the
rows that come in, turns them into columns, does everything that is done along columns, turns these back and hands on
the rows of the next plane. Only the columns are ever held whole; the next step writes its own where it has read the
last one's. Fourier transforms are done on blocks that stay in the processor's cache; rows that hold no light are left
out, and so are frequencies and destination samples that nobody asks for.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Protocol

import numpy as np

from ..optics.free_space import advance
from ..runtime.backend import backend
from ..runtime.fft import Field, fft
from .grids import Directions, Plan, Step

Rows = Iterable[tuple[slice, Field]]
"""Blocks of rows of a field, from the first on, with their places. What is left out is dark.

A block holds until the next one is asked for.
"""

# Rows that are transformed together: in the processor's cache, or so many that a CUDA device is busy.
_BLOCK, _CUDA_BLOCK = 64, 4096

# Columns that are turned into rows together: more of them would not stay in the first cache.
_TILE = 512

# Columns a whole number of pages apart would fall on the same few lines of the cache when they are turned.
_PAGE, _STAGGER = 512, 24


class Element(Protocol):
    """A thin element in the source plane of a step.

    Attributes
    ----------
    along_columns : complex64 array (step.y.count,), or None
        A factor that depends on y alone; it is multiplied where columns are read.
    """

    along_columns: Field | None

    def lit(self, rows: slice) -> list[slice]:
        """Return those of the rows that the element does not darken, in runs."""

    def through(self, rows: slice, samples: Field, out: Field) -> None:
        """Write rows of a field, multiplied by what is left of the element, to `out`."""


class Workspace:
    """Memory that serves all steps of a plan: fresh pages would cost nearly as much as the transforms on them."""

    def __init__(self, plan: Plan) -> None:
        self.libraries = backend()
        self.block = _CUDA_BLOCK if self.libraries.is_cuda else _BLOCK
        columns, rows = (max(sizes) for sizes in zip(*(step.columns for step in plan.steps), strict=True))
        self._columns = self.libraries.arrays.empty((columns, rows + -rows % _PAGE + _STAGGER), np.complex64)
        self._buffers: dict[str, Field] = {}

    def columns(self, step: Step | Directions) -> Field:
        """Return the memory of a step's columns, which is that of the last step's, too."""
        return self._columns[: step.x.kept]

    def array(self, name: str, shape: tuple[int, int]) -> Field:
        """Return an array with any content; it holds until the same name is asked for again."""
        size = shape[0] * shape[1]
        if name not in self._buffers or self._buffers[name].size < size:
            self._buffers[name] = self.libraries.arrays.empty(size, np.complex64)
        return self._buffers[name][:size].reshape(shape)

    def blocks(self, field: Field) -> Rows:
        """Yield all rows of a field; the blocks are its own memory."""
        for place in range(0, len(field), self.block):
            rows = slice(place, min(place + self.block, len(field)))
            yield rows, field[rows]


def propagate(
    source: Rows, element: Element, step: Step, distance: float, wavelength: float, workspace: Workspace
) -> Rows:
    """Propagate a field through a thin element and to the next plane.

    Parameters
    ----------
    source : iterable of (slice, array (n, step.x.count))
        The field, at the source samples; it may be what another step returned with the same workspace.
    element : Element
        What the field passes first.
    step : Step
        Sampling.
    distance : float
        To the next plane, in millimetres.
    wavelength : float
        Wavelength in nanometres.
    workspace : Workspace
        Where the work is done.

    Yields
    ------
    (slice, complex64 array (n, step.x.wanted))
        The field at the destination samples, without the carrier.
    """
    columns = workspace.columns(step)
    _to_columns(source, element, step, columns, workspace)
    _across_space(columns, element, step, distance, wavelength, workspace)
    yield from _to_rows(columns, step, workspace)


def to_directions(
    source: Rows, element: Element, step: Directions, workspace: Workspace
) -> Iterator[tuple[slice, Field]]:
    """Transform a field at the main lens to direction cosines.

    Parameters
    ----------
    source : iterable of (slice, array (n, step.x.count))
        The field just before the main lens.
    element : Element
        The main lens, and what takes out the path to the object plane.
    step : Directions
        Sampling.
    workspace : Workspace
        Where the work is done.

    Yields
    ------
    (slice, complex64 array (n, step.y.kept))
        Some cosines along x and all along y; contiguous, until the next one is asked for. Zero comes first on both
        axes, negative cosines last of the kept ones. Both transforms are divided by their lengths.
    """
    columns = workspace.columns(step)
    _to_columns(source, element, step, columns, workspace)
    yield from _spectra(columns, element, step, workspace)


def _to_columns(source: Rows, element: Element, step: Step | Directions, columns: Field, workspace: Workspace) -> None:
    """Transform rows and keep the lowest frequencies, turned into columns."""
    x = step.x
    block = workspace.array("rows", (workspace.block, x.padded))
    low, high = lowest(x.padded, x.kept)
    end = 0
    for rows, samples in source:
        for lit in element.lit(rows):
            columns[:, end : lit.start] = 0
            end = lit.stop
            part = block[: end - lit.start]
            element.through(lit, samples[lit.start - rows.start : end - rows.start], part[:, : x.count])
            part[:, x.count :] = 0
            part = _fft(part)
            columns[: low.stop, lit] = part[:, low].T
            columns[low.stop :, lit] = part[:, high].T
    columns[:, end : step.y.count] = 0


def _spectra(
    columns: Field, element: Element, step: Step | Directions, workspace: Workspace
) -> Iterator[tuple[slice, Field]]:
    """Transform columns block by block and keep the lowest frequencies."""
    x, y, together = step.x, step.y, workspace.block
    arrays = workspace.libraries.arrays
    block = workspace.array("rows", (together, y.padded))
    spectrum = workspace.array("spectrum", (together, y.kept))
    low, high = lowest(y.padded, y.kept)
    for place in range(0, x.kept, together):
        mine = slice(place, min(place + together, x.kept))
        size = mine.stop - place
        part = block[:size]
        if element.along_columns is None:
            part[:, : y.count] = columns[mine, : y.count]
        else:
            arrays.multiply(columns[mine, : y.count], element.along_columns, out=part[:, : y.count])
        part[:, y.count :] = 0
        part = _fft(part)
        if y.kept < y.padded:
            spectrum[:size, : low.stop] = part[:, low]
            spectrum[:size, low.stop :] = part[:, high]
            part = spectrum[:size]
        yield mine, part


def _across_space(
    columns: Field, element: Element, step: Step, distance: float, wavelength: float, workspace: Workspace
) -> None:
    """Transform columns, multiply by the transfer function, transform back, in place."""
    x, y = step.x, step.y
    for mine, part in _spectra(columns, element, step, workspace):
        part = advance(
            part,
            (x.new_pitch, y.new_pitch),
            distance,
            wavelength,
            shift=(x.start - x.first, y.start - y.first),
            part=(mine.start, x.kept),
        )
        columns[mine, : y.wanted] = _fft(part, inverse=True)[:, : y.wanted]


def _to_rows(columns: Field, step: Step, workspace: Workspace) -> Rows:
    """Turn columns into rows, transform these back and keep their first samples."""
    x, y, together = step.x, step.y, workspace.block
    block = workspace.array("next rows", (together, x.kept))
    for place in range(0, y.wanted, together):
        rows = slice(place, min(place + together, y.wanted))
        part = block[: rows.stop - place]
        for first in range(0, x.kept, _TILE):
            tile = slice(first, min(first + _TILE, x.kept))
            part[:, tile] = columns[tile, rows].T
        yield rows, _fft(part, inverse=True)[:, : x.wanted]


def lowest(size: int, kept: int) -> tuple[slice, slice]:
    """Where the lowest frequencies are in a spectrum with zero frequency first: from zero on, and below zero."""
    positive = (kept + 1) // 2
    return slice(0, positive), slice(size - (kept - positive), size)


def _fft(field: Field, *, inverse: bool = False) -> Field:
    """Transform rows in place; forward transforms are divided by the length, inverse ones are not."""
    return fft(field, axis=1, inverse=inverse, norm="forward")
