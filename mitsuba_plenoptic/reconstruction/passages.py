"""Propagation steps of a reconstruction on whole fields, each with its adjoint.

The steps are those of `steps`, which does them block by block and keeps nothing. A transform that is divided by its
length has as adjoint the other transform divided by that length, and the transfer function its conjugate: the way
back by the same distance.
"""

from __future__ import annotations

import numpy as np

from ..optics.free_space import advance
from ..runtime.backend import backend
from ..runtime.fft import Field, fft
from .grids import AxisDirections, AxisStep, Directions, Step
from .steps import Element, lowest


class Spectrum:
    """A thin element, and the transform to the lowest frequencies.

    Parameters
    ----------
    element : Element
        What the field passes first.
    step : Step or Directions
        Sampling.
    """

    def __init__(self, element: Element, step: Step | Directions) -> None:
        arrays = backend().arrays
        shape = (step.y.count, step.x.count)
        self._step, self._arrays = step, arrays
        self._factor = arrays.zeros(shape, np.complex64)
        for lit in element.lit(slice(0, step.y.count)):
            ones = arrays.ones((lit.stop - lit.start, step.x.count), np.complex64)
            element.through(lit, ones, self._factor[lit])
        if element.along_columns is not None:
            self._factor *= element.along_columns[:, None]

    def forward(self, field: Field) -> Field:
        """Return the spectrum, (frequencies along x, along y), of a field (rows, columns)."""
        step = self._step
        part = _to_lowest(field * self._factor, step.x)
        return _to_lowest(self._arrays.ascontiguousarray(part.T), step.y)

    def adjoint(self, spectrum: Field) -> Field:
        """Apply the adjoint of `forward`."""
        step = self._step
        part = _from_lowest(spectrum, step.y)[:, : step.y.count]
        part = _from_lowest(self._arrays.ascontiguousarray(part.T), step.x)[:, : step.x.count]
        return part * self._factor.conj()


class Passage:
    """A thin element, and free space to the next plane.

    Parameters
    ----------
    element : Element
        What the field passes first.
    step : Step
        Sampling.
    distance : float
        To the next plane, in millimetres.
    wavelength : float
        In nanometres.
    """

    def __init__(self, element: Element, step: Step, distance: float, wavelength: float) -> None:
        self._spectrum, self._step, self._arrays = Spectrum(element, step), step, backend().arrays
        self._distance, self._wavelength = distance, wavelength

    def forward(self, field: Field) -> Field:
        """Return the field (rows, columns) at the destination samples of one at the source samples."""
        x, y = self._step.x, self._step.y
        part = self._advance(self._spectrum.forward(field), 1)
        part = self._arrays.ascontiguousarray(_fft(part, inverse=True)[:, : y.wanted].T)
        return _fft(part, inverse=True)[:, : x.wanted]

    def adjoint(self, field: Field) -> Field:
        """Apply the adjoint of `forward`."""
        x, y, arrays = self._step.x, self._step.y, self._arrays
        rows = arrays.zeros((y.wanted, x.kept), np.complex64)
        rows[:, : x.wanted] = field
        columns = arrays.zeros((x.kept, y.kept), np.complex64)
        columns[:, : y.wanted] = _unscaled(rows).T
        return self._spectrum.adjoint(self._advance(_unscaled(columns), -1))

    def _advance(self, spectrum: Field, sign: int) -> Field:
        x, y = self._step.x, self._step.y
        shift = (sign * (x.start - x.first), sign * (y.start - y.first))
        return advance(spectrum, (x.new_pitch, y.new_pitch), sign * self._distance, self._wavelength, shift=shift)


def _to_lowest(field: Field, axis: AxisStep | AxisDirections) -> Field:
    """Transform rows, filled up with zeros, and keep the lowest frequencies."""
    padded = backend().arrays.zeros((len(field), axis.padded), np.complex64)
    padded[:, : axis.count] = field
    padded = _fft(padded)
    low, high = lowest(axis.padded, axis.kept)
    return backend().arrays.concatenate([padded[:, low], padded[:, high]], 1)


def _from_lowest(spectrum: Field, axis: AxisStep | AxisDirections) -> Field:
    """Apply the adjoint of `_to_lowest`, but for leaving samples out."""
    low, high = lowest(axis.padded, axis.kept)
    padded = backend().arrays.zeros((len(spectrum), axis.padded), np.complex64)
    padded[:, low], padded[:, high] = spectrum[:, : low.stop], spectrum[:, low.stop :]
    return fft(padded, axis=1, inverse=True, norm="backward")


def _fft(field: Field, *, inverse: bool = False) -> Field:
    """Transform rows; forward transforms are divided by the length, inverse ones are not."""
    return fft(field, axis=1, inverse=inverse, norm="forward")


def _unscaled(field: Field) -> Field:
    """Apply the adjoint of the inverse transform of rows."""
    return fft(field, axis=1, norm="backward")
