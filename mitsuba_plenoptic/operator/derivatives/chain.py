"""Memory that the fields of many points use one after another."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ...runtime.fft import Field, fft


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


_BLOCK = 2**16
"""Samples of the field on the detector that are multiplied and transformed at a time: they stay in a core's cache."""


@dataclass(frozen=True)
class Factors:
    """What a field is multiplied by.

    Attributes
    ----------
    pupil : complex64 array (directions, directions)
        Plane waves from the pupil.
    along_x, along_y : complex64 arrays (m,)
        Factors on the MLA along its axes.
    lenses : complex64 array (m, m), or None
        A further factor on the MLA.
    transfer : complex64 array (n, n)
        From the MLA to the detector.
    """

    pupil: Field
    along_x: Field
    along_y: Field
    lenses: Field | None
    transfer: Field

    @property
    def parts(self) -> list[Field | None]:
        """All of them."""
        return [self.pupil, self.along_x, self.along_y, self.lenses, self.transfer]


@dataclass(frozen=True)
class Changes:
    """Changes of the factors, or cotangents of them; attributes as of `Factors`, None for what does not change."""

    pupil: Field | None = None
    along_x: Field | None = None
    along_y: Field | None = None
    lenses: Field | None = None
    transfer: Field | None = None

    @property
    def parts(self) -> list[Field | None]:
        """All of them."""
        return [self.pupil, self.along_x, self.along_y, self.lenses, self.transfer]


class _Passage(Protocol):
    """From the pupil through the MLA to the spectrum that goes to the detector, and back."""

    spectrum: Field

    def behind(self, change: Changes) -> Field | None:
        """Return the change behind the MLA, None where nothing changes there."""

    def to_spectrum(self, behind: Field) -> Field:
        """Take a field from behind the MLA to its spectrum."""

    def from_spectrum(self, spectrum: Field) -> Field:
        """Take a cotangent of the spectrum to behind the MLA."""

    def back(self, behind: Field) -> tuple[Field, Field, Field, Field | None]:
        """Return the cotangents of pupil, along_x, along_y and lenses from that behind the MLA; both are used up."""


class Way:
    """The way of a field from the pupil to the detector, with what it has been in between.

    Parameters
    ----------
    factors : Factors
        What it is multiplied by.
    finer : {1, 2}
        How many samples of the field on the detector there are for one of the patch, along each axis.
    memory : Memory
        Where it lies: it is lost when this restarts.
    returning : complex64 array (n, n), optional
        The conjugate of the transfer function, for the ways back.

    Attributes
    ----------
    field : complex64 array (finer n, finer n)
        On the detector.
    """

    def __init__(self, factors: Factors, finer: int, memory: Memory, returning: Field | None = None) -> None:
        self._transfer, self._returning, self._finer = factors.transfer, returning, finer
        self._memory, self._arrays = memory, memory.arrays
        self._passage: _Passage = (_Product if factors.lenses is None else _Plane)(factors, memory)
        self.field = self._to_detector(memory.product(self._passage.spectrum, factors.transfer))

    @property
    def intensity(self) -> Any:
        """The square of the field, float32."""
        return self.field.real**2 + self.field.imag**2

    def tangent(self, change: Changes) -> Any:
        """Return the change of the intensity with changes of the factors, None where it does not change."""
        behind = self._passage.behind(change)
        spectrum = _total(
            None if behind is None else self._memory.product(self._passage.to_spectrum(behind), self._transfer),
            None if change.transfer is None else self._memory.product(self._passage.spectrum, change.transfer),
        )
        return None if spectrum is None else self._intensity_change(self._to_detector(spectrum))

    def _intensity_change(self, change: Field) -> Any:
        """Return the change of the intensity with one of the field."""
        return 2 * (self.field.real * change.real + self.field.imag * change.imag)

    def moved(self, change: Changes) -> Field:
        """Return the change of the spectrum that goes to the detector, as `products` takes it; zero for none."""
        result = self._memory.take(self._transfer.shape)
        with self._memory.lent():
            behind = self._passage.behind(change)
            result[...] = 0 if behind is None else self._passage.to_spectrum(behind)
        return result

    def slope(self, moved: Field) -> Any:
        """Return the change of the intensity with a change `moved` of the spectrum."""
        with self._memory.lent():
            return self._intensity_change(self._to_detector(self._memory.product(moved, self._transfer)))

    def back(self, gradient: Any, transfer: bool = True) -> Changes:
        """Return the cotangents of the factors from half the gradient with respect to the intensity.

        That of the transfer function is left out unless it is asked for.
        """
        spectrum = self._from_detector(gradient)
        own = self._memory.back(self._passage.spectrum, spectrum) if transfer else None
        behind = self._passage.from_spectrum(self._before_space(spectrum))
        return Changes(*self._passage.back(behind), own)

    def products(self, gradient: Any, moved: list[Field]) -> list[float]:
        """Multiply half the gradient with respect to the intensity with changes `moved` of the spectrum."""
        spectrum = self._before_space(self._from_detector(gradient))
        return [float(self._arrays.vdot(spectrum, change).real) for change in moved]

    def _before_space(self, spectrum: Field) -> Field:
        """Take a cotangent of the spectrum on the detector, whose memory is used, to that behind the MLA."""
        assert self._returning is not None
        return self._arrays.multiply(spectrum, self._returning, out=spectrum)

    def _to_detector(self, spectrum: Field) -> Field:
        """Take a spectrum, whose memory is used, to the detector."""
        size = self._finer * len(spectrum)
        if self._finer == 1:
            return _inverse(_inverse(spectrum, 0), 1)
        columns = _inverse(self._memory.widened(spectrum, size, 0), 0)
        return _inverse(self._memory.widened(columns, size, 1), 1)

    def _from_detector(self, gradient: Any) -> Field:
        """Apply the adjoint of `_to_detector` to the field times a gradient."""
        (size, _), n, arrays = self.field.shape, len(self._transfer), self._arrays
        columns, rows = self._memory.take((size, n)), max(1, _BLOCK // size)
        for block in (slice(first, first + rows) for first in range(0, size, rows)):
            columns[block] = _forward(self.field[block] * gradient[block], 1)[:, :n]
        return arrays.ascontiguousarray(_forward(columns, 0)[:n])


class _Product:
    """Through microlenses that are a product of a factor along x and one along y."""

    def __init__(self, factors: Factors, memory: Memory) -> None:
        self._factors, self._memory, self._arrays = factors, memory, memory.arrays
        self._samples, self._mla_samples = len(factors.transfer), len(factors.along_x)
        self._along_rows = self._to_rows(factors.pupil)
        self._columns = self._to_columns(memory.product(self._along_rows, factors.along_x))
        self.spectrum = self.to_spectrum(memory.product(self._columns, factors.along_y[:, None]))

    def behind(self, change: Changes) -> Field | None:
        f, product = self._factors, self._memory.product
        rows = _total(
            None if change.pupil is None else product(self._to_rows(change.pupil), f.along_x),
            None if change.along_x is None else product(self._along_rows, change.along_x),
        )
        return _total(
            None if rows is None else product(self._to_columns(rows), f.along_y[:, None]),
            None if change.along_y is None else product(self._columns, change.along_y[:, None]),
        )

    def to_spectrum(self, behind: Field) -> Field:
        return self._arrays.ascontiguousarray(_forward(behind, 0)[: self._samples])

    def from_spectrum(self, spectrum: Field) -> Field:
        return _inverse(self._memory.widened(spectrum, self._mla_samples, 0), 0)

    def back(self, behind: Field) -> tuple[Field, Field, Field, None]:
        f, conj, size = self._factors, self._arrays.conj, len(self._factors.pupil)
        columns = conj(self._columns, out=self._columns)
        with self._memory.lent():
            along_y = self._memory.product(columns, behind).sum(1)
        behind *= conj(f.along_y)[:, None]
        rows = self._arrays.ascontiguousarray(_forward(behind, 0)[:size])
        rows = _inverse(self._memory.widened(rows, self._mla_samples, 1), 1)
        along_x = self._memory.back(self._along_rows, rows).sum(0)
        rows *= conj(f.along_x)
        return _forward(rows, 1)[:, :size], along_x, along_y, None

    def _to_rows(self, pupil: Field) -> Field:
        return _inverse(self._memory.widened(pupil, self._mla_samples, 1), 1)

    def _to_columns(self, rows: Field) -> Field:
        return self.from_spectrum(_forward(rows, 1)[:, : self._samples])


class _Plane:
    """Through any microlenses: the field is on the MLA along both axes."""

    def __init__(self, factors: Factors, memory: Memory) -> None:
        assert factors.lenses is not None
        self._factors, self._lenses = factors, factors.lenses
        self._memory, self._arrays = memory, memory.arrays
        self._samples, self._mla_samples = len(factors.transfer), len(factors.along_x)
        self._axes = memory.product(factors.along_y[:, None], factors.along_x)
        self._on_mla = memory.product(self._axes, self._lenses)
        self._before = self._to_mla(factors.pupil)
        self.spectrum = self.to_spectrum(memory.product(self._before, self._on_mla))

    def behind(self, change: Changes) -> Field | None:
        f = self._factors
        axes = _total(
            None if change.along_x is None else f.along_y[:, None] * change.along_x,
            None if change.along_y is None else change.along_y[:, None] * f.along_x,
        )
        on_mla = _total(
            None if axes is None else self._lenses * axes,
            None if change.lenses is None else self._axes * change.lenses,
        )
        return _total(
            None if change.pupil is None else self._to_mla(change.pupil) * self._on_mla,
            None if on_mla is None else self._before * on_mla,
        )

    def to_spectrum(self, behind: Field) -> Field:
        rows = self._arrays.ascontiguousarray(_forward(behind, 0)[: self._samples])
        return self._arrays.ascontiguousarray(_forward(rows, 1)[:, : self._samples])

    def from_spectrum(self, spectrum: Field) -> Field:
        rows = _inverse(self._memory.widened(spectrum, self._mla_samples, 1), 1)
        return _inverse(self._memory.widened(rows, self._mla_samples, 0), 0)

    def back(self, behind: Field) -> tuple[Field, Field, Field, Field]:
        f, conj, size = self._factors, self._arrays.conj, len(self._factors.pupil)
        on_mla = self._memory.back(self._before, behind)
        lenses = self._memory.back(self._axes, on_mla)
        on_mla *= conj(self._lenses)
        along_x, along_y = conj(f.along_y) @ on_mla, on_mla @ conj(f.along_x)
        behind = self._memory.back(self._on_mla, behind)
        rows = self._arrays.ascontiguousarray(_forward(behind, 0)[:size])
        return _forward(rows, 1)[:, :size], along_x, along_y, lenses

    def _to_mla(self, pupil: Field) -> Field:
        rows = _inverse(self._memory.widened(pupil, self._mla_samples, 1), 1)
        return _inverse(self._memory.widened(rows, self._mla_samples, 0), 0)


def _total(one: Field | None, other: Field | None) -> Field | None:
    """Add two changes, of which each may be none, in the memory of the first."""
    if one is None or other is None:
        return other if one is None else one
    one += other
    return one


def _forward(field: Field, axis: int) -> Field:
    """Transform unscaled, on this thread alone."""
    return fft(field, axis=axis, workers=1)


def _inverse(field: Field, axis: int) -> Field:
    """Transform back unscaled, on this thread alone."""
    return fft(field, axis=axis, inverse=True, norm="forward", workers=1)
