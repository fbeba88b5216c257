"""What one step of the angular spectrum loses or folds, found on its own data."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..runtime.backend import backend_of
from ..runtime.fft import Field, as_field
from . import guards
from .phase import in_millimetres
from .power import band_edge_fraction, fraction, frequencies_of, power, rim, weighted

_ROWS = 32
"""Rows of a large field that are looked at, about."""

_SMALL = 2**18
"""Samples up to which a field is looked at whole."""

_UNSEEN = 0.01
"""Power that those rows may hold too much or too little; beyond that all are looked at."""


class StepGuard:
    """Looks at one step of the angular spectrum: at the field before, at its spectrum, and at the field after.

    Some 32 rows of each are looked at if it is large, which takes about a hundredth of the step's time. Where they do
    not hold their part of the power, because it is in few places or in few waves, all rows of the spectrum are.

    Parameters
    ----------
    field : complex64 array (rows, columns)
        The field before the step.
    pitch : float
        Distance between samples in millimetres.
    wavelength : float
        Wavelength in nanometres.
    """

    def __init__(self, field: Field, pitch: float, wavelength: float) -> None:
        self._shape = field.shape
        self._cosine = in_millimetres(wavelength) / (2 * pitch)
        self._step = _row_step(field)
        self._power, self._rim = self._of_field(field)
        self._band_edge = self._evanescent = 0.0
        self._representative = True

    def see_spectrum(self, packed: Any) -> None:
        """Look at the spectrum, zero frequency first, held as 64-bit words."""
        count = self._shape[0]
        # every one of the lowest frequencies, which hold most of a smooth field
        order = np.rint(np.fft.fftfreq(count) * count).astype(int)
        chosen = np.flatnonzero((np.abs(order) <= self._step) | (np.arange(count) % self._step == 0))
        weight = np.where(np.abs(order[chosen]) <= self._step, 1, self._step)
        waves = _packed_rows(packed, self._shape, chosen)
        held = weighted(weight, waves) / math.prod(self._shape)
        self._representative = abs(fraction(held, self._power) - 1) < _UNSEEN
        if not self._representative:
            chosen, weight = np.arange(count), np.ones(count)
            waves = _packed_rows(packed, self._shape, None)
        rows, columns = (frequencies_of(size) for size in self._shape)
        rows = rows[chosen]
        self._band_edge = band_edge_fraction(waves, rows, weight)
        if self._cosine**2 * 2 > 1:
            lost = backend_of(waves).arrays.asarray(self._cosine**2 * (rows[:, None] ** 2 + columns**2) >= 1)
            self._evanescent = fraction(weighted(weight, waves * lost), weighted(weight, waves))

    def see_result(self, field: Field) -> None:
        """Look at the field after the step, and judge it all.

        Raises
        ------
        PhysicsError
            If a guard's bound is passed.
        """
        after, rim = self._of_field(field)
        with guards.watch():
            guards.judge(guards.EVANESCENT, self._evanescent)
            guards.judge(guards.UNDERSAMPLED, self._band_edge)
            # where few rows do not tell, nothing is known about the field before
            guards.judge_window(fraction(rim, after), fraction(self._rim, self._power) if self._representative else 1.0)

    def _of_field(self, field: Field) -> tuple[float, float]:
        """Power in all and in the rim of the window."""
        rows = _some_rows(field)
        high, wide = (rim(size) for size in field.shape)
        place = np.arange(len(rows)) * self._step
        outer = (place < high) | (place >= len(field) - high)
        sides = sum(weighted(~outer, side) for side in (rows[:, :wide], rows[:, -wide:]))
        return self._step * power(rows), self._step * (weighted(outer, rows) + sides)


def _some_rows(field: Field) -> Field:
    """Return a view of the rows of a field from which a fraction of its power is told."""
    return field[:: _row_step(field)]


def _row_step(field: Field) -> int:
    # odd, so that the rows keep no step with what repeats by powers of two
    return len(field) // _ROWS | 1 if field.size > _SMALL else 1


def _packed_rows(packed: Any, shape: tuple[int, ...], chosen: np.ndarray | None) -> Field:
    """Return some or all rows of a field held as 64-bit words."""
    field = as_field(packed, shape)
    return field if chosen is None else field[backend_of(field).arrays.asarray(chosen)]
