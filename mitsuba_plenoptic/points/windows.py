"""Windows of many patches in one plane, one for each copy of a patch: added to, and gathered from.

On the processor, windows are visited one after another, since each fits into the cache of a core. A device would need
longer to start a kernel for each window than to compute it: there, one kernel serves all windows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ..runtime import Backend, Doubles, Field, Floats, Integers, backend_of, drjit_array, fft

_LANES = 2**24
"""Samples of windows that one kernel of a device adds."""


@dataclass(frozen=True)
class Windows:
    """Windows of equal size in planes (channels, rows, columns), each of one patch of several."""

    patch: Integers  # number of each window's patch, in ascending order, (n,)
    start: Integers  # first row and first column of each window, (n, 2)

    @classmethod
    def of(cls, starts: list[Integers]) -> Windows:
        """Return the windows from the rows and columns of each patch's windows."""
        return cls(np.repeat(np.arange(len(starts)), [len(run) for run in starts]), np.concatenate(starts))


def part_of(table: Field, starts: Integers, size: tuple[int, int]) -> Field:
    """Return windows (n, rows, columns) of a table, with given first rows and columns (n, 2)."""
    libraries = backend_of(table)
    rows, columns = size
    if len(starts) == 1:
        ((top, left),) = starts.tolist()
        return table[None, top : top + rows, left : left + columns]
    row, column = (
        libraries.arrays.asarray(first[:, None] + np.arange(count)) for first, count in zip(starts.T, size, strict=True)
    )
    return table[row[:, :, None], column[:, None, :]]


def add_on_device(sums: Floats, values: Floats, windows: Windows, weights: Floats) -> Floats:
    """Return sums (channels, rows, columns) with patches (n, rows, columns) added to all windows, by one kernel.

    `weights` (windows, channels) are factors on the patches. The memory of `sums` may be reused; the rounding depends
    on the order in which threads add.
    """
    libraries = backend_of(sums)
    types = backend_of(sums).types
    _, height, width = sums.shape
    _, rows, columns = values.shape
    target, source_values = (drjit_array(types.Float, array) for array in (sums, values))
    row_index, channels = np.nonzero(weights)
    for first in range(0, len(row_index), step := max(1, _LANES // (rows * columns))):
        window = row_index[first : first + step]
        channel = channels[first : first + step]
        entry, row, column = fft.split(types, dr.arange(types.UInt32, len(window) * rows * columns), rows, columns)
        places = (channel * height + windows.start[window, 0]) * width + windows.start[window, 1]
        address = _each(types, places, entry) + row * dr.opaque(types.UInt32, width) + column
        source = _each(types, windows.patch[window] * (rows * columns), entry)
        source += row * dr.opaque(types.UInt32, columns) + column
        factor = dr.gather(types.Float, drjit_array(types.Float, weights[window, channel]), entry)
        dr.scatter_add(target, dr.gather(types.Float, source_values, source) * factor, address)
    dr.eval(target)
    return libraries.from_drjit(target).reshape(sums.shape)


def products_on_device(planes: Floats, values: Floats, windows: Windows) -> Any:
    """Return the products (windows, channels), float64 and on the device, of windows of planes with their patches."""
    libraries = backend_of(planes)
    types = backend_of(planes).types
    channels, height, width = planes.shape
    _, rows, columns = values.shape
    source_planes, patches = (drjit_array(types.Float, array) for array in (planes, values))
    count = len(windows.patch) * channels
    _, entry, row = fft.split(types, dr.arange(types.UInt32, count * rows), count, rows)
    first = (np.arange(channels) * height + windows.start[:, :1]) * width + windows.start[:, 1:]
    address = _each(types, first.ravel(), entry) + row * dr.opaque(types.UInt32, width)
    source = _each(types, np.repeat(windows.patch * (rows * columns), channels), entry)
    source += row * dr.opaque(types.UInt32, columns)
    # Only rows are summed in single precision, which limits rounding errors.
    total = _loop(
        types,
        dr.zeros(types.UInt32, count * rows),
        dr.opaque(types.UInt32, columns),
        [dr.zeros(types.Float, count * rows)],
        lambda k: [dr.gather(types.Float, source_planes, address + k) * dr.gather(types.Float, patches, source + k)],
    )
    (sums,) = _evaluated(libraries, total)
    return sums.reshape(len(windows.patch), channels, rows).sum(2, dtype=np.float64)


def gathered_on_device(
    planes: Floats, windows: Windows, weights: Floats, moments: Doubles, size: tuple[int, int]
) -> list[Floats]:
    """Return the sums (patches, rows, columns) of each patch's windows of planes, by one kernel.

    Windows have the factors `weights` (windows, channels), times those of each row of `moments` (sums, windows).
    """
    libraries = backend_of(planes)
    types = backend_of(planes).types
    _, height, width = planes.shape
    rows, columns = size
    source = drjit_array(types.Float, planes)
    window, channel = np.nonzero(weights)
    places = (channel * height + windows.start[window, 0]) * width + windows.start[window, 1]
    address = drjit_array(types.UInt32, places.astype(np.uint32))
    factors = [drjit_array(types.Float, row[window] * weights[window, channel]) for row in moments]
    count = int(windows.patch[-1]) + 1
    ends = np.searchsorted(windows.patch[window], np.arange(count + 1))
    patch, row, column = fft.split(types, dr.arange(types.UInt32, count * rows * columns), rows, columns)
    inside = row * dr.opaque(types.UInt32, width) + column

    def step(k: Any) -> list[Any]:
        value = dr.gather(types.Float, source, dr.gather(types.UInt32, address, k) + inside)
        return [value * dr.gather(types.Float, factor, k) for factor in factors]

    none = [dr.zeros(types.Float, count * rows * columns) for _ in moments]
    sums = _loop(types, _each(types, ends[:-1], patch), _each(types, ends[1:], patch), none, step)
    return [rows_of.reshape(count, rows, columns) for rows_of in _evaluated(libraries, sums)]


def _each(types: Any, numbers: Integers, entry: Any) -> Any:
    """Return the number that belongs to each lane's entry."""
    return dr.gather(types.UInt32, drjit_array(types.UInt32, numbers.astype(np.uint32)), entry)


def _loop(types: Any, first: Any, last: Any, totals: list[Any], step: Callable[[Any], list[Any]]) -> list[Any]:
    """Return totals with the results of a step added for each index from `first` up to `last`, which is excluded."""

    def body(k: Any, last: Any, *totals: Any) -> tuple[Any, ...]:
        return k + 1, last, *(total + term for total, term in zip(totals, step(k), strict=True))

    last = last + dr.zeros(types.UInt32, dr.width(first))
    return list(dr.while_loop((first, last, *totals), lambda k, last, *totals: k < last, body)[2:])


def _evaluated(libraries: Backend, arrays: list[Any]) -> list[Any]:
    """Return the memory of Dr.Jit arrays that one kernel computes."""
    dr.eval(*arrays)
    return [libraries.from_drjit(array) for array in arrays]
