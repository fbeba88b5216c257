"""Memory that the fields of many points use one after another."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from ...runtime.fft import Field


class Memory:
    """Memory for the fields of one point after another, by their shapes.

    Fields of some MiB that are made and dropped go back to the system each time, and clearing them anew for the next
    point takes longer than their transforms.
    """

    def __init__(self, arrays: Any = np) -> None:
        self.arrays = arrays
        self._fields: dict[tuple[int, ...], list[Field]] = {}
        self._used: Counter[tuple[int, ...]] = Counter()

    def restart(self) -> None:
        """Let the next point have all of it."""
        self._used.clear()

    @contextmanager
    def lent(self) -> Iterator[None]:
        """Take back at the end what is taken meanwhile: few fields, used again, stay in the processor's cache."""
        used = self._used.copy()
        yield
        self._used = used

    def take(self, shape: tuple[int, ...]) -> Field:
        """Return a complex64 array that holds anything."""
        fields, used = self._fields.setdefault(shape, []), self._used[shape]
        if used == len(fields):
            fields.append(self.arrays.empty(shape, np.complex64))
        self._used[shape] += 1
        return fields[used]

    def product(self, one: Field, other: Field) -> Field:
        """Return the product of two arrays."""
        shape = np.broadcast_shapes(one.shape, other.shape)
        return self.arrays.multiply(one, other, out=self.take(shape))

    def back(self, factor: Field, field: Field) -> Field:
        """Return the product of the conjugate of the one and the other."""
        shape = np.broadcast_shapes(factor.shape, field.shape)
        conjugate = self.arrays.conj(factor, out=self.take(factor.shape))
        return self.arrays.multiply(conjugate, field, out=conjugate if factor.shape == shape else self.take(shape))

    def widened(self, field: Field, length: int, axis: int) -> Field:
        """Return a field with zeros behind it along an axis."""
        shape = list(field.shape)
        shape[axis] = length
        wide = self.take(tuple(shape))
        rows, columns = field.shape
        wide[:rows, :columns] = field
        wide[(slice(rows, None), slice(None)) if axis == 0 else (slice(None), slice(columns, None))] = 0
        return wide
