r"""Fields of many points, computed together, each on a patch of the detector.

A scene point lights a small patch of the MLA. There the point's field is a sum of plane waves, one for each direction
cosine s from a pupil point P to the centre Mc of the patch, times a common curvature (the Debye integral with its
quadratic term retained; Born and Wolf, "Principles of Optics", section 8.8):

.. math:: u(M_c + \mu) = \frac{ds^2}{\lambda} e^{i k \mu^2 / 2 R_0}
          \sum_s A(s) \, e^{i k (|P - X| + \Phi(P) + R - R_0)} \, e^{i k s \cdot \mu},
          \qquad P = M_c - R s, \quad R = \frac{b}{\sqrt{1 - s^2}}

with the lens's phase :math:`\Phi` and :math:`A = \mathrm{pupil}(P) \, g R^2 / (|P - X|^2 b)`, so that :math:`\sum |A|^2
ds^2` is the power through the pupil. The sum is an inverse FFT with few nonzero inputs. Curvature and, on square
lattices, the transmission of the microlenses are products of a function of x and one of y, so the transforms to the MLA
and back to the spectrum are done axis by axis, and rows outside the pupil are omitted. Behind other microlenses both
axes are transformed at once, which costs about twice the time. The transfer function to the detector is that of the
angular spectrum.

All computations are done in the frame that is turned with the microlens lattice about the axis, in which the main lens
is the same.

The tilt of the chief ray is rounded to an integer number of frequency samples and omitted: it shifts the spectrum,
without an effect on the intensity. The pitch must therefore represent only the cone of the pupil and the microlens, and
some of the light that the edges of the microlenses scatter.

`PatchBatch` computes the fields of many points as fast as possible, `FieldChain` that of one point with all
intermediate results, for derivatives: a field is multiplied by the pupil, by the factors on the microlens array, and by
the transfer function of free space; in between there are Fourier transforms. Where all factors on the array are along
one axis, the field passes it in two stages, axis by axis, else in one. A Jacobian-vector product (jvp) is the same
chain for changes of the factors, and a vector-Jacobian product (vjp) goes back through it.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ..runtime import Doubles, Field, Sizes, active_backend, fft
from .patch_factors import Fields, PatchFactors
from .windows import part_of


class _Sizes(NamedTuple):
    """Numbers of samples in fields that are transformed together, in a block of one field, and in chains of fields.

    A block fits into a core's own cache, and so do the fields of a chain if there is one point in it. On CUDA blocks
    bring no gain, and a group limits the memory only: a kernel is started for all of its points.
    """

    group: int
    block: int
    chain: int


_PROCESSOR = _Sizes(group=2**17, block=2**16, chain=1)
_CUDA = _Sizes(group=2**23, block=2**31, chain=2**21)


class PatchWorkspace:
    """Memory for the transforms of the points of a batch."""

    def __init__(self, batch: PatchBatch):
        arrays = batch.libraries.arrays
        count = batch.together
        m = batch.mla_samples
        self.rows = arrays.empty((count, batch.pupil.shape[1], m), np.complex64)
        blocks = (block for size in (batch.samples, m) for block in _blocks(size, m, batch.sizes.block))
        longest = max(block.stop - block.start for block in blocks)
        self.columns = arrays.empty((count, longest, m), np.complex64)
        self.plane = arrays.empty((0 if batch.is_separable else count, m, batch.samples), np.complex64)
        self.field = arrays.empty((count, batch.samples, batch.samples), np.complex64)


class PatchBatch:
    """The fields of points with patches of one size, with given amplitudes, ready to be transformed.

    `parts` are the factors on the fields, as `PatchFactors` has them: pupil, microlens array, transfer function.
    """

    def __init__(self, fields: Fields, amplitudes: Doubles):
        self.libraries = active_backend()
        self.sizes = _CUDA if self.libraries.is_cuda else _PROCESSOR
        self.factors = factors_of_points = PatchFactors(fields, amplitudes)
        self.samples = factors_of_points.samples
        self.mla_samples = factors_of_points.mla_samples
        self.corner = fields.placement.corner
        self.parts: list[Field] = [
            fft.as_field(fft.pack(value), shape)
            for value, shape in zip(factors_of_points.values(), factors_of_points.shapes, strict=True)
        ]
        # Plane waves from the pupil, (points, along y, along x).
        self.pupil = self.parts[0]
        # Whether every factor on the array depends on one axis alone.
        self.is_separable = len(factors_of_points.axes) == 2
        # Points that are transformed at a time: small fields in groups, so that calls cost little.
        self.together = min(len(self.pupil), max(1, self.sizes.group // self.mla_samples**2))

    @cached_property
    def _transfer(self) -> Field:
        """Transfer function from array to detector, (directions along x, along y)."""
        return self.libraries.arrays.ascontiguousarray(self.parts[-1].T)

    def chained(self, finer: int) -> list[slice]:
        """Return the points of each `FieldChain`, whose fields are `finer` on the detector by a factor."""
        widest = max(finer * self.samples, self.mla_samples)
        count = len(self.pupil)
        step = max(1, self.sizes.chain // widest**2)
        return [slice(first, min(first + step, count)) for first in range(0, count, step)]

    def to_detector(self, start: int, stop: int, work: PatchWorkspace) -> Iterator[tuple[slice, Field]]:
        """Yield the fields of points start ... stop on the detector, at most `together` at a time.

        Fields are computed in blocks that fit into a core's own cache. Yielded are a block's position along y, and part
        of the fields (points, samples along x, some samples along y); the memory of a part and of `work` is reused.
        """
        n = self.samples
        count = stop - start
        through = self._through_axes if self.is_separable else self._through_plane
        for block, columns in through(start, stop, work):
            spectrum = forward_along(columns, axis=2)[..., :n]
            starts = self.factors.first_directions[start:stop] + np.array([block.start, 0])
            for points in [slice(0, count)] if self.libraries.is_cuda else (slice(p, p + 1) for p in range(count)):
                spectrum[points] *= part_of(self._transfer, starts[points], spectrum.shape[1:])
            work.field[:count, block] = inverse_along(spectrum, axis=2)
        for block in _blocks(n, n, self.sizes.block):
            yield block, inverse_along(work.field[:count, :, block], axis=1)

    def _through_axes(self, start: int, stop: int, work: PatchWorkspace) -> Iterator[tuple[slice, Field]]:
        """Yield columns of the fields, spectra along x, behind microlenses that are a product of two axes."""
        count = stop - start
        along_x, along_y = (factor[start:stop, None] for factor in self.parts[1:-1])
        rows = _to_array(self.pupil[start:stop], work.rows[:count])
        rows *= along_x
        rows = forward_along(rows, axis=2)
        for block in _blocks(self.samples, self.mla_samples, self.sizes.block):
            columns = _to_array(rows[..., block].transpose(0, 2, 1), work.columns[:count, : block.stop - block.start])
            columns *= along_y
            yield block, columns

    def _through_plane(self, start: int, stop: int, work: PatchWorkspace) -> Iterator[tuple[slice, Field]]:
        """Yield columns of the fields, spectra along x, behind microlenses that are a function of both axes."""
        count = stop - start
        n = self.samples
        m = self.mla_samples
        along_x, along_y, plane = (factor[start:stop] for factor in self.parts[1:-1])
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
    """Return fields on the array, in the memory of `work`, from lines of spectra padded with zeros."""
    count = spectra.shape[2]
    work[..., :count] = spectra
    work[..., count:] = 0
    return inverse_along(work, axis=2)


def _blocks(count: int, length: int, samples: int) -> Iterator[slice]:
    """Yield slices that cut `count` rows of a given length into blocks of about `samples` samples."""
    parts = max(1, round(count * length / samples))
    edges = [count * block // parts for block in range(parts + 1)]
    return (slice(*pair) for pair in itertools.pairwise(edges))


def forward_along(field: Field, axis: int) -> Field:
    """Return the unscaled transform of a field along an axis, computed on this thread alone."""
    return fft.fft(field, axis=axis, workers=1)


def inverse_along(field: Field, axis: int) -> Field:
    """Return the unscaled inverse transform along an axis, computed on this thread alone."""
    return fft.fft(field, axis=axis, inverse=True, norm="forward", workers=1)


class Memory:
    """Memory for the fields of one point after another, by their shapes.

    Fields of some MiB that are allocated and freed are returned to the system each time, and clearing new memory for
    the next point takes longer than the transforms.
    """

    def __init__(self, arrays: Any = np):
        self.arrays = arrays
        self._fields: dict[Sizes, list[Field]] = {}
        self._used: Counter[Sizes] = Counter()

    def restart(self) -> None:
        """Make all memory available for the next point."""
        self._used.clear()

    @contextmanager
    def lent(self) -> Iterator[None]:
        """Release the memory taken in the context at its end, since few reused fields stay in the processor's cache."""
        in_use = self._used.copy()
        yield
        self._used = in_use

    def take(self, shape: Sizes) -> Field:
        """Return an uninitialised complex64 array."""
        fields = self._fields.setdefault(shape, [])
        in_use = self._used[shape]
        if in_use == len(fields):
            fields.append(self.arrays.empty(shape, np.complex64))
        self._used[shape] += 1
        return fields[in_use]

    def product(self, first: Field, second: Field) -> Field:
        """Return the product of two arrays."""
        return self.arrays.multiply(first, second, out=self.take(np.broadcast_shapes(first.shape, second.shape)))

    def widened(self, field: Field, length: int, axis: int) -> Field:
        """Return a field with zeros appended along one of its last two axes, -1 or -2."""
        shape = list(field.shape)
        shape[axis] = length
        wide = self.take(tuple(shape))
        count = field.shape[axis]
        along: Any = [(..., half, *[slice(None)] * (-1 - axis)) for half in (slice(count), slice(count, None))]
        wide[along[0]] = field
        wide[along[1]] = 0
        return wide


Parts = Sequence[Field | None]
"""A change or a cotangent for each factor of a field, or None."""

_Factor = tuple[Sizes, Field]
"""Axes of the camera, and the factor as fields are multiplied by it."""


class FieldChain:
    """Fields of some points from the pupil to the detector, with their intermediate results.

    `factors` are those of `PatchFactors` for these points, `axes` the axes of the array's factors. The `field` on the
    detector (points, rows, columns) has `finer` (1 or 2) times the samples of the patch along each axis. All data lie
    in `memory`, and are lost when it restarts. `returning` is the conjugate of the transfer function, for
    vector-Jacobian products.
    """

    def __init__(
        self,
        factors: Sequence[Field],
        axes: Sequence[Sizes],
        finer: int,
        memory: Memory,
        returning: Field | None = None,
    ):
        pupil, *lenses, self._transfer = factors
        self._finer = finer
        self._returning = returning
        self._memory = memory
        self._arrays = memory.arrays
        self._directions = pupil.shape[-1]
        self._samples = self._transfer.shape[-1]
        # Fields have x along the last axis.
        index: dict[Sizes, Any] = {(0,): (slice(None), None), (1,): (Ellipsis, None)}
        upright = [lens[index.get(rows, Ellipsis)] for rows, lens in zip(axes, lenses, strict=True)]
        named: list[_Factor] = list(zip(axes, upright, strict=True))
        self._stages = [((-1, -2), named)] if len(named) > 2 else [((-1,), named[:1]), ((-2,), named[1:])]
        self._size = lenses[0].shape[-1]
        self._spectrum = pupil
        self._before: list[Field] = []
        for along, stage in self._stages:
            self._before.append(self._inverse(self._spectrum, self._size, along))
            self._spectrum = _forward(self._product(self._before[-1], stage), self._samples, along)
        self.field = self._to_detector(memory.product(self._spectrum, self._transfer))

    @property
    def intensity(self) -> Any:
        """Squared modulus of the field, float32."""
        return self.field.real**2 + self.field.imag**2

    def jvp(self, changes: Parts) -> Any:
        """Return the change of the intensity for changes of the factors; None stands for an unchanged factor."""
        moved = self._moved(changes)
        product = self._memory.product
        spectrum = _total(
            None if moved is None else product(moved, self._transfer),
            None if changes[-1] is None else product(self._spectrum, changes[-1]),
        )
        return None if spectrum is None else self._intensity_change(spectrum)

    def spectrum_jvp(self, changes: Parts) -> Field:
        """Return the change of the spectrum that enters free space, for changes of the factors before free space."""
        result = self._memory.take(self._transfer.shape)
        with self._memory.lent():
            moved = self._moved(changes)
            result[...] = 0 if moved is None else moved
        return result

    def jvp_of_spectrum(self, change: Field) -> Any:
        """Return the change of the intensity for a change of the spectrum that enters free space."""
        with self._memory.lent():
            return self._intensity_change(self._memory.product(change, self._transfer))

    def vjp(self, gradient: Any, varies: Sequence[bool]) -> Parts:
        """Return the cotangents of the varying factors, from half the gradient with respect to the intensity.

        Intermediate fields are overwritten.
        """
        memory = self._memory
        arrays = self._arrays
        spectrum = self._from_detector(gradient)
        parts: list[Field | None] = [None]
        if varies[-1]:
            conjugate = arrays.conj(self._spectrum, out=memory.take(self._spectrum.shape))
            parts = [arrays.multiply(conjugate, spectrum, out=conjugate)]
        field = self._before_space(spectrum)
        varying = list(varies[1:-1])
        for (axes, factors), before in zip(self._stages[::-1], self._before[::-1], strict=True):
            field = self._inverse(field, self._size, axes)
            product = arrays.multiply(arrays.conj(before, out=before), field, out=before)
            for index, (of_factor, _) in reversed(list(enumerate(factors))):
                if not varying.pop():
                    parts.append(None)
                    continue
                cotangent = product
                for _, factor in factors[:index] + factors[index + 1 :]:
                    cotangent = memory.product(cotangent, arrays.conj(factor))
                # The camera's axis 0 is along the last axis of fields, so that a factor along x is summed over rows.
                parts.append(cotangent.sum(of_factor[0] - 2) if len(of_factor) == 1 else cotangent)
            for _, factor in factors:
                field *= arrays.conj(factor, out=memory.take(factor.shape))
            field = _forward(field, self._directions, axes)
        return [field if varies[0] else None, *parts[::-1]]

    def products(self, gradient: Any, changes: list[Field]) -> Any:
        """Return the products of half the gradient, by the intensity of all points, with changes of the spectrum."""
        spectrum = self._before_space(self._from_detector(gradient))
        return self._arrays.stack([self._arrays.vdot(spectrum, change).real for change in changes])

    def _moved(self, changes: Parts) -> Field | None:
        """Return the change of the spectrum for changes of all factors before free space."""
        moved = changes[0]
        factor_changes = list(changes[1:-1])
        for (axes, factors), before in zip(self._stages, self._before, strict=True):
            total = None if moved is None else self._product(self._inverse(moved, self._size, axes), factors)
            for index, (_, factor) in enumerate(factors):
                if (change := factor_changes.pop(0)) is not None:
                    others = factors[:index] + factors[index + 1 :]
                    change_of_field = self._product(self._memory.product(before, change.reshape(factor.shape)), others)
                    total = _total(total, change_of_field)
            moved = None if total is None else _forward(total, self._samples, axes)
        return moved

    def _product(self, field: Field, factors: list[_Factor]) -> Field:
        """Return a field on the array multiplied by factors."""
        for _, factor in factors:
            field = self._memory.product(field, factor)
        return field

    def _intensity_change(self, spectrum: Field) -> Any:
        """Return the change of the intensity for a change of the spectrum on the detector, whose memory is reused."""
        change = self._to_detector(spectrum)
        return 2 * (self.field.real * change.real + self.field.imag * change.imag)

    def _before_space(self, spectrum: Field) -> Field:
        """Return the cotangent behind the array from a cotangent of the spectrum on the detector, computed in place."""
        assert self._returning is not None
        return self._arrays.multiply(spectrum, self._returning, out=spectrum)

    def _to_detector(self, spectrum: Field) -> Field:
        """Return the field on the detector from a spectrum, computed in place."""
        if self._finer == 1:
            return inverse_along(inverse_along(spectrum, -2), -1)
        return self._inverse(spectrum, self._finer * self._samples, (-2, -1))

    def _from_detector(self, gradient: Any) -> Field:
        """Return the adjoint of `_to_detector` applied to the field times a gradient."""
        count, size, _ = self.field.shape
        n = self._samples
        arrays = self._arrays
        columns = self._memory.take((count, size, n))
        # Samples of one point on the detector that are multiplied and transformed together: they fit into a core's
        # cache.
        rows = max(1, 2**16 // size) if arrays is np else size
        for block in (slice(first, first + rows) for first in range(0, size, rows)):
            columns[:, block] = _forward(self.field[:, block] * gradient[:, block], n, (-1,))
        return arrays.ascontiguousarray(_forward(columns, n, (-2,)))

    def _inverse(self, field: Field, size: int, axes: Sizes) -> Field:
        """Return the inverse transform of a field padded with zeros to given sizes along given axes."""
        for axis in axes:
            field = inverse_along(self._memory.widened(field, size, axis), axis)
        return field


def _total(first: Field | None, second: Field | None) -> Field | None:
    """Return the sum of two changes, in the memory of the first."""
    if first is None or second is None:
        return second if first is None else first
    first += second
    return first


def _forward(field: Field, count: int, axes: Sizes) -> Field:
    """Return the first samples of the unscaled transform along axes, computed in place on this thread alone."""
    for axis in axes[::-1]:
        field = forward_along(field, axis)
        field = field[..., :count, :] if axis == -2 else field[..., :count]
    return field
