"""Memory that the fields of many radiators use one after another."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...runtime.fft import Field


class Memory:
    """Memory for the fields of one radiator after another, in the order in which they ask for it.

    Fields of some MiB that are made and dropped go back to the system each time, and clearing them anew for the next
    radiator takes longer than their transforms.
    """

    def __init__(self, arrays: Any = np) -> None:
        self.arrays = arrays
        self._fields: list[Field] = []
        self._next = 0

    def restart(self) -> None:
        """Let the next radiator have all of it."""
        self._next = 0

    def take(self, shape: tuple[int, ...]) -> Field:
        """Return a complex64 array that holds anything."""
        if self._next == len(self._fields):
            self._fields.append(self.arrays.empty(shape, np.complex64))
        elif self._fields[self._next].shape != shape:
            self._fields[self._next] = self.arrays.empty(shape, np.complex64)
        self._next += 1
        return self._fields[self._next - 1]

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
