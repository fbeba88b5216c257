r"""Sums of plane waves of any directions on a regular grid, and the adjoint: a non-uniform Fourier transform.

.. math:: F(k_y, k_x) = \sum_j c_j \, e^{2 \pi i (k_x x_j + k_y y_j)}

for integers :math:`k = -\lfloor N/2 \rfloor, \ldots` and frequencies :math:`|x_j|, |y_j| < 1/2` in cycles per sample. A
Kaiser-Bessel function spreads each plane wave over neighbouring frequencies of a grid twice as fine as that of the
transform; the transform of the fine grid is divided by the function's transform (Beatty, Nishimura and Pauly, "Rapid
gridding reconstruction with a minimal oversampling ratio", 2005, for the function's parameter). Only the frequencies
that occur are stored and transformed: laser spots occupy some tenth of them along each axis, for which FINUFFT 2.5, at
the same error, takes 2.6 to 5 times the processor time of a sum.
"""

import math
from collections.abc import Iterator

import numpy as np
import scipy

from ...points import blocks
from ...runtime import Doubles, Field, active_backend, backend_of, fft

_WIDTH = 8
"""Frequencies of the fine grid, along an axis, over which a plane wave is spread."""

_OVERSAMPLING = 2
"""Length of the transforms over the samples that are wanted."""

_SHAPE = math.pi * math.sqrt((_WIDTH / _OVERSAMPLING * (_OVERSAMPLING - 0.5)) ** 2 - 0.8)
"""Parameter of the Kaiser-Bessel function; with it the sums have a relative error of about 1e-6."""

POINT_BYTES = 8.0 * _WIDTH**2 + 80
"""Memory per plane wave: its weights and their indices."""


class PlaneWaves:
    """Plane waves of frequencies (n, 2) in cycles per sample, x and y, on a grid of `count` x `count` samples.

    Sums are computed by the active variant's libraries, on whose device their samples and amplitudes are.
    """

    def __init__(self, frequencies: Doubles, count: int):
        libraries = active_backend()
        self.count = count
        self._length = length(count)
        position = frequencies * self._length
        first = np.ceil(position - _WIDTH / 2).astype(np.int64)
        low = first.min(0)
        high = first.max(0) + _WIDTH
        self._low = low
        self._shape = (int(high[1] - low[1]), int(high[0] - low[0]))
        steps = np.arange(_WIDTH)
        distances = (position[:, axis, None] - (first[:, axis, None] + steps) for axis in (0, 1))
        inside = (np.sqrt(np.maximum(0, 1 - (2 * distance / _WIDTH) ** 2)) for distance in distances)
        i0 = scipy.special.i0
        weights = [(i0(_SHAPE * root) / i0(_SHAPE)).astype(np.float32) for root in inside]
        index = [first[:, axis, None] - low[axis] + steps for axis in (0, 1)]
        values = weights[1][:, :, None] * weights[0][:, None, :]
        columns = index[1][:, :, None] * self._shape[1] + index[0][:, None, :]
        n = len(frequencies)
        spread = values.reshape(-1), columns.astype(np.int32).reshape(-1), np.arange(n + 1) * _WIDTH**2
        self._spread = libraries.sparse.csr_matrix(
            tuple(map(libraries.arrays.asarray, spread)), shape=(n, self._shape[0] * self._shape[1])
        )
        order = np.arange(count) - count // 2
        # The Fourier transform of the Kaiser-Bessel function.
        root = np.sqrt(_SHAPE**2 - (math.pi * _WIDTH * (order / self._length)) ** 2)
        correction = (1 / (_WIDTH * np.sinh(root) / root / i0(_SHAPE))).astype(np.float32)
        self._correction = libraries.arrays.asarray(correction)

    @staticmethod
    def memory(count: int, band: float = 1.0) -> float:
        """Return an upper bound, in bytes, of the memory of the sums, apart from memory that grows with the waves.

        `band` is the occupied part, along each axis, of the frequencies from -1/2 to 1/2.
        """
        frequencies = band * length(count) + 2 * _WIDTH
        return 8.0 * frequencies * (2.0 * count + frequencies)

    def forward(self, amplitudes: Field) -> Iterator[tuple[slice, Field]]:
        """Yield blocks of rows of the sum of plane waves with given amplitudes (n,)."""
        parts = self._spread.T @ amplitudes.view(np.float32).reshape(-1, 2)
        spread = backend_of(parts).arrays.ascontiguousarray(parts).view(np.complex64).reshape(self._shape)
        tall = _to_samples(spread, self._low[1], self._length, self.count, 0) * self._correction[:, None]
        for rows in blocks(self.count):
            yield rows, _to_samples(tall[rows], self._low[0], self._length, self.count, 1) * self._correction

    def adjoint(self, samples: Iterator[tuple[slice, Field]]) -> Field:
        """Return each plane wave's inner product with samples, which come in blocks of rows."""
        arrays = backend_of(self._correction).arrays
        tall = arrays.empty((self.count, self._shape[1]), np.complex64)
        for rows, block in samples:
            tall[rows] = _to_frequencies(block * self._correction, self._low[0], self._length, self._shape[1], 1)
        tall *= self._correction[:, None]
        spread = _to_frequencies(tall, self._low[1], self._length, self._shape[0], 0)
        parts = self._spread @ arrays.ascontiguousarray(spread).reshape(-1).view(np.float32).reshape(-1, 2)
        return arrays.ascontiguousarray(parts).view(np.complex64).reshape(-1)


def length(count: int) -> int:
    """Return the length of the transforms for a number of samples."""
    return fft.fast_length(_OVERSAMPLING * count + 2 * _WIDTH)


def _to_samples(spectrum: Field, first: int, size: int, count: int, axis: int) -> Field:
    """Return `count` samples around the origin along an axis; `first` is the index of the lowest frequency given."""
    samples = fft.fft(embedded(spectrum, first, size, axis), axis=axis, inverse=True, norm="forward")
    return taken(samples, -(count // 2), count, axis)


def _to_frequencies(samples: Field, first: int, size: int, count: int, axis: int) -> Field:
    """Return the adjoint of `_to_samples`, with `count` frequencies."""
    frequencies = fft.fft(embedded(samples, -(samples.shape[axis] // 2), size, axis), axis=axis)
    return taken(frequencies, first, count, axis)


def taken(values: Field, first: int, count: int, axis: int) -> Field:
    """Return `count` values along an axis from an index on, modulo the number of the values."""
    parts = [values[(slice(None),) * axis + (there,)] for _, there in _runs(first, count, values.shape[axis])]
    return backend_of(values).arrays.concatenate(parts, axis)


def embedded(values: Field, first: int, size: int, axis: int) -> Field:
    """Return values placed from an index on, modulo `size`, along an axis of `size` samples that are otherwise 0."""
    shape = list(values.shape)
    shape[axis] = size
    padded = backend_of(values).arrays.zeros(shape, np.complex64)
    for here, there in _runs(first, values.shape[axis], size):
        padded[(slice(None),) * axis + (there,)] = values[(slice(None),) * axis + (here,)]
    return padded


def _runs(first: int, count: int, size: int) -> Iterator[tuple[slice, slice]]:
    """Yield slices of `count` values, and of their places from an index on, modulo `size`; `count` is at most that."""
    start = int(first) % size
    end = min(count, size - start)
    yield slice(0, end), slice(start, start + end)
    if end < count:
        yield slice(end, count), slice(0, count - end)
