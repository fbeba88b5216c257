r"""Fields of many points together, each on a patch of the detector.

A scene point lights a small patch of the MLA. There its field is a sum of plane waves, one for each direction
cosine s from a pupil point P to the centre Mc of the patch, times a common curvature (the Debye integral with its
quadratic term retained; Born and Wolf, "Principles of Optics", section 8.8):

.. math:: u(M_c + \mu) = \frac{ds^2}{\lambda} e^{i k \mu^2 / 2 R_0}
          \sum_s A(s) \, e^{i k (|P - X| - P^2 / 2 f_1 + R - R_0)} \, e^{i k s \cdot \mu},
          \qquad P = M_c - R s, \quad R = \frac{b}{\sqrt{1 - s^2}}

with :math:`A = \mathrm{pupil}(P) \, g R^2 / (|P - X|^2 b)`, so that :math:`\sum |A|^2 ds^2` is the power through the
pupil. The sum is an inverse FFT of which few inputs are not zero. Curvature and, on square lattices,
the transmission of the microlenses are products of a function of x and one of y, so the transforms to the MLA and back
to the spectrum are done axis by axis, and rows outside the pupil are omitted. Behind other microlenses the field is on
the MLA along both axes at once, which costs about twice the time. The transfer function to the detector is that of the
angular spectrum.

All of this is done in the frame that is turned with the microlens lattice about the axis, in which the main lens is
the same.

The tilt of the chief ray is rounded to an integer number of frequency samples and omitted: it shifts the spectrum,
without an effect on the intensity. The pitch must therefore represent only the cone of the pupil and the microlens, and
some of the light that the edges of the microlenses scatter.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..runtime.backend import backend
from ..runtime.fft import Field, as_field, fft, pack
from .patch_factors import Fields, PatchFactors


class _Sizes(NamedTuple):
    """Samples of the fields that are transformed together, enough for calls to cost little, and of a block of them.

    A block fits into a core's own cache; on CUDA there is nothing to gain from blocks.
    """

    group: int
    block: int


_PROCESSOR = _Sizes(group=2**17, block=2**16)
_CUDA = _Sizes(group=2**25, block=2**31)


class PatchWorkspace:
    """Memory for the transforms of a batch's points."""

    def __init__(self, batch: PatchBatch) -> None:
        arrays, count, m = batch.libraries.arrays, batch.together, batch.mla_samples
        self.rows = arrays.empty((count, batch.pupil.shape[1], m), np.complex64)
        longest = max(_largest(_blocks(size, m, batch.sizes.block)) for size in (batch.samples, m))
        self.columns = arrays.empty((count, longest, m), np.complex64)
        self.plane = arrays.empty((0 if batch.is_separable else count, m, batch.samples), np.complex64)
        self.field = arrays.empty((count, batch.samples, batch.samples), np.complex64)


class PatchBatch:
    """The fields of points whose patches have one size, with some amplitudes, ready to be transformed.

    `parts` are the factors on the fields, as `PatchFactors` has them: pupil, microlens array, transfer function.
    """

    def __init__(self, fields: Fields, amplitudes: NDArray[np.float64]) -> None:
        self.libraries = backend()
        self.sizes = _CUDA if self.libraries.is_cuda else _PROCESSOR
        self.factors = made = PatchFactors(fields, amplitudes)
        self.samples, self.mla_samples, self.corner = made.samples, made.mla_samples, fields.placement.corner
        self.parts: list[Field] = [
            as_field(pack(value), shape) for value, shape in zip(made.values(), made.shapes, strict=True)
        ]

    @property
    def pupil(self) -> Field:
        """Plane waves from the pupil, (n, along y, along x)."""
        return self.parts[0]

    @property
    def is_separable(self) -> bool:
        """Whether all factors on the array are along one axis."""
        return len(self.factors.axes) == 2

    @cached_property
    def _transfer(self) -> Field:
        """The transfer function, (directions along x, along y)."""
        return self.libraries.arrays.ascontiguousarray(self.parts[-1].T)

    @property
    def together(self) -> int:
        """Points to transform at a time: small ones in groups, so that the calls cost little."""
        return min(len(self.pupil), max(1, self.sizes.group // self.mla_samples**2))

    def to_detector(self, start: int, stop: int, work: PatchWorkspace) -> Iterator[tuple[int, slice, Field]]:
        """Transform the fields of points start ... stop, at most `together`, to the detector.

        Everything is done on blocks that fit into a core's own cache. Yields points, by their index in the batch, with
        parts of their fields, (samples along x, some samples along y), and where these lie along y; the memory of a
        part and of `work` is used again.
        """
        n, count = self.samples, stop - start
        through = self._through_axes if self.is_separable else self._through_plane
        for block, columns in through(start, stop, work):
            spectrum = forward_along(columns, axis=2)[..., :n]
            for part, point in zip(spectrum, range(start, stop), strict=True):
                along_y, along_x = self.factors.directions_of(point)
                part *= self._transfer[along_x.start + block.start : along_x.start + block.stop, along_y]
            work.field[:count, block] = inverse_along(spectrum, axis=2)
        for block in _blocks(n, n, self.sizes.block):
            detector = inverse_along(work.field[:count, :, block], axis=1)
            for part, point in zip(detector, range(start, stop), strict=True):
                yield point, block, part

    def _through_axes(self, start: int, stop: int, work: PatchWorkspace) -> Iterator[tuple[slice, Field]]:
        """Yield columns of the fields, spectra along x, behind microlenses that are a product of two axes."""
        count, (along_x, along_y) = stop - start, (part[start:stop, None] for part in self.parts[1:-1])
        rows = _to_array(self.pupil[start:stop], work.rows[:count])
        rows *= along_x
        rows = forward_along(rows, axis=2)
        for block in _blocks(self.samples, self.mla_samples, self.sizes.block):
            columns = _to_array(rows[..., block].transpose(0, 2, 1), work.columns[:count, : block.stop - block.start])
            columns *= along_y
            yield block, columns

    def _through_plane(self, start: int, stop: int, work: PatchWorkspace) -> Iterator[tuple[slice, Field]]:
        """Yield columns of the fields, spectra along x, behind microlenses that are a function of both axes."""
        count, n, m = stop - start, self.samples, self.mla_samples
        along_x, along_y, plane = (part[start:stop] for part in self.parts[1:-1])
        rows = _to_array(self.pupil[start:stop].transpose(0, 2, 1), work.rows[:count])
        rows *= along_y[:, None]
        for block in _blocks(m, m, self.sizes.block):
            columns = _to_array(rows[..., block].transpose(0, 2, 1), work.columns[:count, : block.stop - block.start])
            columns *= along_x[:, None]
            columns *= plane[:, block]
            work.plane[:count, block] = forward_along(columns, axis=2)[..., :n]
        for block in _blocks(n, m, self.sizes.block):
            columns = work.columns[:count, : block.stop - block.start]
            columns[...] = work.plane[:count, :, block].transpose(0, 2, 1)
            yield block, columns


def _to_array(spectra: Field, work: Field) -> Field:
    """Transform lines of spectra, with zeros behind them, to positions on the array, in the memory of `work`."""
    count = spectra.shape[2]
    work[..., :count], work[..., count:] = spectra, 0
    return inverse_along(work, axis=2)


def _blocks(count: int, length: int, samples: int) -> Iterator[slice]:
    """Cut `count` rows of some length into blocks of about some samples."""
    parts = max(1, round(count * length / samples))
    edges = [count * part // parts for part in range(parts + 1)]
    return (slice(*pair) for pair in itertools.pairwise(edges))


def _largest(blocks: Iterator[slice]) -> int:
    return max(block.stop - block.start for block in blocks)


def forward_along(field: Field, axis: int) -> Field:
    """Transform unscaled, on this thread alone."""
    return fft(field, axis=axis, workers=1)


def inverse_along(field: Field, axis: int) -> Field:
    """Transform back unscaled, on this thread alone."""
    return fft(field, axis=axis, inverse=True, norm="forward", workers=1)
