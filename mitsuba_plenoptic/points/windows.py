"""Windows of many patches in planes, one for each copy of a patch: added to, and gathered from.

On the processor, windows are visited one after another, since each fits into the cache of a core. A device would need
longer to start a kernel for each window than to compute it: there, one index has all windows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..runtime import Array, Doubles, Field, Floats, Integers, Shape, Sizes, backend_of

_LANES = 2**24
"""Samples of windows that a device gathers together."""


@dataclass(frozen=True)
class Windows:
    """Windows of equal size in planes (channels, rows, columns), each of one patch of several."""

    patch: Integers  # number of each window's patch, in ascending order, (n,)
    start: Integers  # first row and first column of each window, (n, 2)

    @classmethod
    def of(cls, starts: list[Integers]) -> Windows:
        """Return the windows from the rows and columns of each patch's windows."""
        return cls(np.repeat(np.arange(len(starts)), [len(run) for run in starts]), np.concatenate(starts))

    def of_patches(self, first: int, stop: int) -> slice:
        """Return which windows belong to the patches from `first` up to `stop`."""
        return slice(*np.searchsorted(self.patch, (first, stop)).tolist())

    def take(self, some: slice, first: int = 0, inside: Shape = (0, 0)) -> Windows:
        """Return some windows, of parts that begin `inside` their patches, of which `first` gets the number 0."""
        return Windows(self.patch[some] - first, self.start[some] + inside)


def runs(length: int, step: int) -> Iterator[slice]:
    """Yield slices of at most `step` that cut a length."""
    return (slice(start, min(start + step, length)) for start in range(0, length, step))


def index_of(planes: Array, plane: Integers, starts: Integers, size: Sizes) -> Any:
    """Return the index of windows (n, rows, columns) of planes, from the plane, first row and column of each."""
    if len(starts) == 1:
        first = int(plane[0]), *starts[0].tolist()
        return tuple(slice(at, at + count) for at, count in zip(first, (1, *size), strict=True))
    row, column = (first[:, None] + np.arange(count) for first, count in zip(starts.T, size, strict=True))
    indices = plane[:, None, None], row[:, :, None], column[:, None, :]
    return tuple(backend_of(planes).arrays.asarray(index) for index in indices)


def taken(planes: Array, plane: Integers, starts: Integers, size: Sizes) -> Array:
    """Return windows (n, rows, columns) of planes: a view of one, copies of several."""
    libraries = backend_of(planes)
    step = len(starts) if libraries.is_cuda else 1
    parts = [planes[index_of(planes, plane[some], starts[some], size)] for some in runs(len(starts), step)]
    return parts[0] if len(parts) == 1 else libraries.arrays.concatenate(parts)


def part_of(table: Field, starts: Integers, size: Shape) -> Field:
    """Return windows (n, rows, columns) of a table, with given first rows and columns (n, 2)."""
    return taken(table[None], np.zeros(len(starts), np.int64), starts, size)


def add_to_windows(sums: Floats, values: Floats, windows: Windows, weights: Floats) -> None:
    """Add patches (n, rows, columns), times `weights` (windows, channels), to their windows of `sums`.

    On a device, the rounding depends on the order in which threads add.
    """
    arrays = backend_of(sums).arrays
    size = values.shape[1:]
    if arrays is np:
        rows, columns = size
        weighted = np.empty(size, sums.dtype)
        for patch, (top, left), factors in zip(
            windows.patch.tolist(), windows.start.tolist(), weights.tolist(), strict=True
        ):
            for plane, factor in enumerate(factors):
                if factor:
                    spread = values[patch] if factor == 1 else np.multiply(values[patch], factor, out=weighted)
                    sums[plane, top : top + rows, left : left + columns] += spread
        return
    window, channel = np.nonzero(weights)
    for some in runs(len(window), max(1, _LANES // math.prod(size))):
        factors = arrays.asarray(weights[window[some], channel[some]])
        spread = values[arrays.asarray(windows.patch[window[some]])] * factors[:, None, None]
        arrays.add.at(sums, index_of(sums, channel[some], windows.start[window[some]], size), spread)


def products(planes: Floats, values: Floats, windows: Windows) -> Any:
    """Return the products (windows, channels), float64, of windows of planes with their patches."""
    libraries = backend_of(planes)
    arrays = libraries.arrays
    channels = len(planes)
    size = values.shape[1:]
    sums = []
    # Only rows are summed in single precision, which limits rounding errors.
    if not libraries.is_cuda:
        rows, columns = size
        for patch, (top, left) in zip(windows.patch.tolist(), windows.start.tolist(), strict=True):
            window = planes[:, top : top + rows, left : left + columns]
            sums.append(np.einsum("cij,ij->ci", window, values[patch]).sum(1, dtype=np.float64))
        return np.array(sums).reshape(-1, channels)
    starts, patches = (np.repeat(numbers, channels, 0) for numbers in (windows.start, windows.patch))
    plane = np.tile(np.arange(channels), len(windows.patch))
    for some in runs(len(plane), max(1, _LANES // math.prod(size))):
        samples = taken(planes, plane[some], starts[some], size)
        spread = taken(values, patches[some], np.zeros_like(starts[some]), size)
        sums.append(arrays.einsum("nij,nij->ni", samples, spread).sum(1, dtype=np.float64))
    return arrays.concatenate(sums).reshape(-1, channels)


def gathered(planes: Floats, windows: Windows, weights: Floats, moments: Doubles, size: int) -> list[Floats]:
    """Return the weighted sums (patches, size, size) of each patch's windows, one for each row of `moments`.

    Windows have the factors `weights` (windows, channels), times those of each row of `moments`, (sums, windows).
    """
    libraries = backend_of(planes)
    arrays = libraries.arrays
    window, channel = np.nonzero(weights)
    count = int(windows.patch[-1]) + 1
    matrix = np.zeros((len(moments), count, len(window)), np.float32)
    matrix[:, windows.patch[window], np.arange(len(window))] = moments[:, window] * weights[window, channel]
    factors = arrays.asarray(matrix.reshape(-1, len(window)))
    result = arrays.empty((len(factors), size, size), np.float32)
    # 2**18: Samples that fit into the cache of a core.
    block = (_LANES if libraries.is_cuda else 2**18) // max(1, len(window) * size)
    for rows in runs(size, max(1, block)):
        height = rows.stop - rows.start
        samples = taken(planes, channel, windows.start[window] + (rows.start, 0), (height, size))
        result[:, rows] = (factors @ samples.reshape(len(window), -1)).reshape(-1, height, size)
    return list(result.reshape(len(moments), count, size, size))
