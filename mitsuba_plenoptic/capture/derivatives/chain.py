r"""The way of one radiator's field over its patch, how it changes with the factors on it, and the way back.

With the pupil's plane waves p, the factor f on the microlens array, and the transfer function h the field is
:math:`u = F^{-1} h \, C F f \, F^{-1} Z p`, Z adding zeros and C cutting to the patch's frequencies (see `patch`). It
is linear in each factor. The way back takes :math:`\bar u`, for which :math:`dL = \mathrm{Re} \sum \bar u^* du`, to
the same of every factor; the transforms' adjoints are the transforms with the other sign. All arrays are (along y,
along x).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...runtime.fft import Field, fft


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

    @property
    def on_mla(self) -> Field:
        """The factor on the MLA, (m, m)."""
        product = self.along_y[:, None] * self.along_x
        return product if self.lenses is None else product * self.lenses


@dataclass(frozen=True)
class Changes:
    """Changes of the factors; attributes as of `Factors`, None for what does not change."""

    pupil: Field | None
    along_x: Field | None
    along_y: Field | None
    lenses: Field | None
    transfer: Field | None


class Way:
    """The way of a field from the pupil to the detector, with what it has been in between.

    Parameters
    ----------
    factors : Factors
        What it is multiplied by.
    arrays : module
        NumPy, or CuPy.

    Attributes
    ----------
    field : complex64 array (2 n, 2 n)
        On the detector, at half the distance of the patch's samples: its square has twice its frequencies, and those
        that would fold change fastest.
    """

    def __init__(self, factors: Factors, arrays: Any = np) -> None:
        self._factors, self._arrays = factors, arrays
        self._samples, self._mla_samples = len(factors.transfer), len(factors.along_x)
        self._on_mla = factors.on_mla
        self._before = self._to_mla(factors.pupil)
        self._spectrum = self._to_spectrum(self._before * self._on_mla)
        self.field = self._to_detector(self._spectrum * factors.transfer)

    def tangent(self, change: Changes) -> Field | None:
        """Return the change of the field with changes of the factors, None where it does not change."""
        behind = _total(
            None if change.pupil is None else self._to_mla(change.pupil) * self._on_mla,
            _product(self._before, self._change_on_mla(change)),
        )
        spectrum = _total(
            None if behind is None else self._to_spectrum(behind) * self._factors.transfer,
            _product(self._spectrum, change.transfer),
        )
        return None if spectrum is None else self._to_detector(spectrum)

    def _change_on_mla(self, change: Changes) -> Field | None:
        """Return the change of the factor on the MLA."""
        f = self._factors
        axes = _total(
            None if change.along_x is None else f.along_y[:, None] * change.along_x,
            None if change.along_y is None else change.along_y[:, None] * f.along_x,
        )
        if f.lenses is None:
            return axes
        return _total(_product(f.lenses, axes), _product(f.along_y[:, None] * f.along_x, change.lenses))

    def back(self, field: Field) -> Factors:
        """Return the cotangents of the factors from that of the field, whose memory is used."""
        f, conj, n, m = self._factors, self._arrays.conj, self._samples, self._mla_samples
        columns = self._arrays.ascontiguousarray(_forward(field, 1)[:, :n])
        spectrum = self._arrays.ascontiguousarray(_forward(columns, 0)[:n])
        transfer = conj(self._spectrum) * spectrum
        spectrum *= conj(f.transfer)
        wide = self._arrays.zeros((n, m), np.complex64)
        wide[:, :n] = spectrum
        behind = self._arrays.zeros((m, m), np.complex64)
        behind[:n] = _inverse(wide, 1)
        behind = _inverse(behind, 0)
        on_mla = conj(self._before) * behind
        lenses = None if f.lenses is None else on_mla * conj(f.along_y[:, None] * f.along_x)
        if f.lenses is not None:
            on_mla *= conj(f.lenses)
        along_x, along_y = conj(f.along_y) @ on_mla, on_mla @ conj(f.along_x)
        behind *= conj(self._on_mla)
        size = len(f.pupil)
        pupil = _forward(self._arrays.ascontiguousarray(_forward(behind, 0)[:size]), 1)[:, :size]
        return Factors(pupil, along_x, along_y, lenses, transfer)

    def _to_mla(self, pupil: Field) -> Field:
        size, m = len(pupil), self._mla_samples
        rows = self._arrays.zeros((size, m), np.complex64)
        rows[:, :size] = pupil
        plane = self._arrays.zeros((m, m), np.complex64)
        plane[:size] = _inverse(rows, 1)
        return _inverse(plane, 0)

    def _to_spectrum(self, field: Field) -> Field:
        rows = self._arrays.ascontiguousarray(_forward(field, 0)[: self._samples])
        return self._arrays.ascontiguousarray(_forward(rows, 1)[:, : self._samples])

    def _to_detector(self, spectrum: Field) -> Field:
        n = len(spectrum)
        columns = self._arrays.zeros((2 * n, n), np.complex64)
        columns[:n] = spectrum
        field = self._arrays.zeros((2 * n, 2 * n), np.complex64)
        field[:, :n] = _inverse(columns, 0)
        return _inverse(field, 1)


def _total(one: Field | None, other: Field | None) -> Field | None:
    """Add two changes, of which each may be none."""
    return other if one is None else one if other is None else one + other


def _product(field: Field, change: Field | None) -> Field | None:
    """Multiply a field by a change, which may be none."""
    return None if change is None else field * change


def _forward(field: Field, axis: int) -> Field:
    """Transform unscaled, on this thread alone."""
    return fft(field, axis=axis, workers=1)


def _inverse(field: Field, axis: int) -> Field:
    """Transform back unscaled, on this thread alone."""
    return fft(field, axis=axis, inverse=True, norm="forward", workers=1)
