"""Memory in which fields are transformed, block by block, shared by all links of a chain."""

import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from ..runtime import Field, Floats, Shape, active_backend, fft
from .steps import Step

Rows = Iterable[tuple[slice, Field]]
"""Blocks of rows of a field, from the first on, with their numbers. What is left out is dark.

A block holds until the next one is asked for, and who takes it may overwrite it.
"""


class FieldWorkspace:
    """Memory shared by steps, since fresh memory pages would cost nearly as much as the transforms.

    `report` is called with the number of samples that Fourier transforms have processed. `buffers` are arrays of
    another workspace that is not used any more.
    """

    def __init__(
        self,
        steps: Iterable[Step],
        report: Callable[[int], None] = lambda transformed: None,
        buffers: dict[str, Field] | None = None,
    ):
        self.libraries = active_backend()
        # Rows that are transformed together: enough to keep a CUDA device busy, or in the processor's cache.
        self.block = 4096 if self.libraries.is_cuda else 64
        self._transformed = 0
        self._report = report
        self._buffers = {} if buffers is None else buffers
        columns, rows = (max(sizes) for sizes in zip(*(step.columns for step in steps), strict=True))
        # Columns whose distance is a multiple of the page size would map to the same few cache lines when
        # transposed.
        self._columns = self.array("columns", (columns, rows + -rows % 512 + 24))

    def columns(self, step: Step) -> Field:
        """Return the memory of a step's columns, shared with the last step's columns."""
        return self._columns[: step.x.held]

    def array(self, name: str, shape: Shape) -> Field:
        """Return an uninitialised array, valid until the same name is requested again."""
        size = shape[0] * shape[1]
        if name not in self._buffers or self._buffers[name].size < size:
            self._buffers[name] = self.libraries.arrays.empty(size, np.complex64)
        return self._buffers[name][:size].reshape(shape)

    def runs(self, count: int, block: int | None = None) -> Iterator[slice]:
        """Yield slices of rows that are processed together."""
        block = block or self.block
        for first in range(0, count, block):
            yield slice(first, min(first + block, count))

    def blocks(self, field: Field, first: int = 0) -> Rows:
        """Yield all rows of a field in blocks, which are views of the field; `first` is the number of its first row."""
        for rows in self.runs(len(field)):
            yield slice(rows.start + first, rows.stop + first), field[rows]

    def repeated(self, pixels: Floats, count: int) -> Rows:
        """Yield the rows of pixels that are repeated `count` times along both axes."""
        for rows in self.runs(len(pixels), max(1, self.block // count)):
            part: Any = pixels[rows]
            for axis in (0, 1) if count > 1 else ():
                part = self.libraries.arrays.repeat(part, count, axis)
            yield slice(rows.start * count, rows.stop * count), part

    def whole(self, blocks: Rows, shape: Shape) -> Field:
        """Return a field gathered from all its rows."""
        field = self.libraries.arrays.empty(shape, np.complex64)
        for rows, samples in blocks:
            field[rows] = samples
        return field

    def fft(self, field: Field, *, inverse: bool = False) -> Field:
        """Transform rows in place; forward transforms are divided by the length, inverse ones are not."""
        result = fft.fft(field, axis=1, inverse=inverse, norm="forward")
        self._transformed += field.size
        self._report(self._transformed)
        return result


_of_thread = threading.local()


@contextmanager
def retained_workspace(steps: Iterable[Step]) -> Iterator[FieldWorkspace]:
    """Provide a workspace in the memory of this thread's last one, which is retained unless there is much of it.

    On CUDA, CuPy retains memory by itself.
    """
    if active_backend().is_cuda:
        yield FieldWorkspace(steps)
        return
    buffers = _of_thread.__dict__.pop("buffers", {})
    yield FieldWorkspace(steps, buffers=buffers)
    # Bytes of a thread's memory, at most, that wait for its next field.
    if sum(buffer.nbytes for buffer in buffers.values()) <= 2**29:
        _of_thread.buffers = buffers
