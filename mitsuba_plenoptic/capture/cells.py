"""Many copies of patterns, each moved by whole lenses, added at once: a product with a sparse matrix.

Where all copies are moved by multiples of some width, patterns and what they are added to are cut into cells of that
width. Each copy then adds whole cells, so that for all samples of a cell the same weights of the same cells are summed:
a sparse matrix, of which each row is a cell of the sum, times the cells of the patterns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ..runtime.backend import backend

_FEWEST_COPIES = 3
"""Copies of a pattern, in the mean, from which on cutting it pays."""

_SMALLEST_CELL = 64
"""Samples of a cell below which the matrix would be as large as the patterns."""

_MOST_PADDING = 4
"""Samples of a pattern's cells over its own, at most: small patterns are added one by one."""

_TOGETHER = 2**20
"""Samples of the patterns that are multiplied together, which a core's caches hold."""


@dataclass(frozen=True)
class Cells:
    """Patterns of one size, and their sum, cut into cells.

    Attributes
    ----------
    width : int array (2,)
        Samples of a cell along x and y.
    count : int array (2,)
        Cells that a pattern reaches, wherever it begins.
    """

    width: NDArray[np.int64]
    count: NDArray[np.int64]

    @classmethod
    def of(cls, shifts: list[NDArray[np.int64]], samples: int) -> Cells | None:
        """Choose cells for patterns of `samples` x `samples` and the shifts of their copies; None if it does not pay.

        Parameters
        ----------
        shifts : list of int arrays (copies, 2)
            For each pattern, along x and y.
        samples : int
            Width of the patterns.
        """
        every = np.concatenate([shift - shift[0] for shift in shifts])
        width = np.gcd.reduce(every, axis=0)
        # Along an axis that no copy is moved along, one cell holds the pattern.
        width = np.where(width > 0, width, samples).astype(np.int64)
        count = (samples + 2 * width - 2) // width
        pays = len(every) >= _FEWEST_COPIES * len(shifts) and width.prod() >= _SMALLEST_CELL
        return cls(width, count) if pays and (count * width).prod() <= _MOST_PADDING * samples**2 else None

    def sum(self, size: NDArray[np.int64], channels: int, patterns: int) -> CellSum:
        """Return an empty sum of so many samples along x and y, which holds so many patterns at a time or more."""
        return CellSum(self, size, channels, patterns)

    def cut(self, planes: Any) -> Any:
        """Cut planes (n, x, y), of whole cells, into (cells of all planes, samples)."""
        shape = np.array(planes.shape[1:]) // self.width
        cut = planes.reshape(len(planes), shape[0], self.width[0], shape[1], self.width[1])
        return cut.transpose(0, 1, 3, 2, 4).reshape(-1, int(self.width.prod()))

    def join(self, cells: Any, planes: int, shape: NDArray[np.int64]) -> Any:
        """Undo `cut` of so many planes, of `shape` cells each."""
        cells = cells.reshape(planes, *shape.tolist(), *self.width.tolist()).transpose(0, 1, 3, 2, 4)
        return cells.reshape(planes, *(shape * self.width).tolist())


class CellSum:
    """A sum of copies of patterns; they are collected, and multiplied some at a time."""

    def __init__(self, cells: Cells, size: NDArray[np.int64], channels: int, patterns: int) -> None:
        self._cells, self._size, self._channels = cells, size, channels
        self._shape = size // cells.width + 1 + cells.count
        self._arrays = backend().arrays
        self._sums = self._arrays.zeros((channels * int(self._shape.prod()), int(cells.width.prod())), np.float32)
        planes = max(patterns, _TOGETHER // int((cells.count * cells.width).prod()))
        self._planes = self._arrays.zeros((planes, *(cells.count * cells.width).tolist()), np.float32)
        self._held: dict[int, int] = {}
        self._entries: list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]] = []

    def plane(self, pattern: int, places: NDArray[np.int64], weights: NDArray[np.float32]) -> Any:
        """Return where the intensity of a pattern is to be written, (samples along x, along y) and some beyond.

        Parameters
        ----------
        pattern : int
            Its number, by which it is known when the next part of it is written.
        places : int array (copies, 2)
            First sample of each copy along x and y.
        weights : float32 array (copies, channels)
            Factors on the copies.
        """
        if pattern not in self._held:
            self._held[pattern] = len(self._held)
            self._enter(self._held[pattern], places // self._cells.width, weights)
        x, y = (places[0] % self._cells.width).tolist()
        return self._planes[self._held[pattern], x:, y:]

    def _enter(self, number: int, places: NDArray[np.int64], weights: NDArray[np.float32]) -> None:
        """Enter the copies of a plane into the matrix."""
        inner = np.indices(self._cells.count.tolist()).reshape(2, -1)
        x, y = places.T[..., None] + inner[:, None]
        copy, channel = np.nonzero(weights)
        # One channel after the other of the same cell: what is added to them stays in the processor's cache.
        rows = (x[copy] * self._shape[1] + y[copy]) * self._channels + channel[:, None]
        columns = np.broadcast_to(number * inner.shape[1] + np.arange(inner.shape[1]), rows.shape)
        values = np.broadcast_to(weights[copy, channel][:, None], rows.shape)
        self._entries.append((rows.ravel(), columns.ravel(), values.ravel()))

    @property
    def free(self) -> int:
        """How many more patterns can be written before the next `add`."""
        return len(self._planes) - len(self._held)

    def add(self) -> None:
        """Add what has been written."""
        if not self._held:
            return
        rows, columns, values = (np.concatenate(entries) for entries in zip(*self._entries, strict=True))
        held = len(self._held)
        shape = len(self._sums), held * int(self._cells.count.prod())
        matrix: Any = scipy.sparse.csr_array((values, (rows, columns)), shape=shape)
        libraries = backend()
        if libraries.is_cuda:
            matrix = libraries.sparse.csr_matrix(matrix)
        self._sums += matrix @ self._cells.cut(self._planes[:held])
        self._planes[:held] = 0
        self._held, self._entries = {}, []

    def total(self) -> Any:
        """Return the sum, (channels, samples along x, along y)."""
        self.add()
        x, y = self._size.tolist()
        sums = self._sums.reshape(*self._shape.tolist(), self._channels, *self._cells.width.tolist())
        return self._cells.join(sums.transpose(2, 0, 1, 3, 4), self._channels, self._shape)[:, :x, :y]
