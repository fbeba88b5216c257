"""Guards of the physics: what a computation loses or folds, measured on its own data, warned of or refused.

Grids and windows are chosen beforehand, by geometry or by the caller. The guards look at the fields that come out,
and tell by one share of the power each whether the choice was good. All bounds are here, with their reasons.
"""

from __future__ import annotations

import contextlib
import math
import sys
import warnings
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..runtime.backend import backend_of
from ..runtime.fft import Field, as_field
from .phase import in_millimetres

_EDGE = 1 / 8
"""Outer part of a window or a spectrum, which should be dark. A field that fills all evenly has 23 % there."""

_ROWS = 32
"""Rows of a large field that are looked at, about."""

_SMALL = 2**18
"""Samples up to which a field is looked at whole."""

_UNSEEN = 0.01
"""Power that those rows may hold too much or too little; beyond that all are looked at."""

_DIGITS = 3
"""Of the measured shares: what is beyond differs with the number of threads."""


class PhysicsWarning(UserWarning):
    """A result is less true than its sampling promises; the message holds the share of the power that tells."""


class PhysicsError(InputError):
    """A result would be false, because its sampling loses or folds too much of the light."""


@dataclass(frozen=True)
class Guard:
    """A share of the power, and how much of it is too much.

    Attributes
    ----------
    name : str
        What metadata call it.
    fault : str
        Words after the share.
    remedy : str
        What the user can do.
    warn, refuse : float
        Shares above which a result is warned of, and refused.
    """

    name: str
    fault: str
    remedy: str
    warn: float
    refuse: float


# A field that the grid resolves fades before the grid's band limit; the hard edge of a pupil leaves 0.1 % in the outer
# eighth. Samples that know nothing of each other have 23 %: of such a field nothing is known between the samples.
UNDERSAMPLED = Guard(
    "undersampled",
    "of a field's power is in the outer eighth of its spectrum, next to what its pitch can hold: it is under-sampled",
    "use a finer pitch",
    warn=0.01,
    refuse=0.2,
)

# Waves shorter than the wavelength do not propagate, and the angular spectrum cuts them.
EVANESCENT = Guard(
    "evanescent",
    "of a field's power is in detail finer than the wavelength, which does not propagate",
    "check pitch and wavelength",
    warn=0.01,
    refuse=0.5,
)

# Light that crosses the edge of a window comes in on the other side. The rim must stay dark for that not to happen. A
# periodic field rightly lights it, but the same before and after.
WINDOW = Guard(
    "window_rim",
    "of a field's power is in the outer eighth of its window, from where light comes in on the other side",
    "use a wider window, unless the field is periodic",
    warn=0.01,
    refuse=1.0,
)

# Light that has come round from all sides lights the window evenly: 23 %.
WRAPPED = Guard(
    "wrapped",
    "of a field's power has come into the outer eighth of its window on the way: it has gone round the window's edges",
    "use a wider window or a shorter distance",
    warn=1.0,
    refuse=0.2,
)

# The default accuracy cuts 0.4 to 1.7 % of the light, which the edges of microlenses scatter far, and the coarsest
# one up to 4 %, for microlens Fresnel numbers from 0.4 to 13. A quarter is lost where a part of the cone of
# geometry does not fit the grid.
PATCH = Guard(
    "patch_loss",
    "of the power through the pupil is lost by the patches of the point spreads",
    "use a smaller 'accuracy', or method 'full_field'",
    warn=0.05,
    refuse=0.25,
)

# The same light, cut by the grid of the full field, which keeps all but 0.2 %.
MICROLENS = Guard(
    "microlens_loss",
    "of the power on the microlenses is sent into directions that the grid does not hold",
    "the microlenses are too strong for scalar thin elements",
    warn=0.02,
    refuse=0.25,
)

# Evenly grey pixels lose what lies beside the round micro-images: 65 % by the default camera. More is not a capture of
# this camera.
PUPIL = Guard(
    "outside_pupil",
    "of the capture's light does not go back through the main lens",
    "check that the camera is the capture's own",
    warn=0.5,
    refuse=0.999,
)

# The planned window is wider than the geometric image, by bins that only what the pupil's edge diffracts reaches.
OBJECT = Guard(
    "object_window",
    "of the light through the main lens misses the window that is kept of the object plane, or comes to its rim",
    "its aperture is so small that diffraction blurs over many bins",
    warn=0.05,
    refuse=0.5,
)

# The lenses that can light a pixel follow from geometry; that of a wide field is approximate. 16 samples a pixel are
# noisier than the one bound; a single lens at f/3 would lose 28 %.
CROSSTALK = Guard(
    "crosstalk_missed",
    "of the light comes through microlenses that are too far from a pixel to be tried",
    "use a smaller aperture or a longer mla_distance",
    warn=0.002,
    refuse=0.05,
)


class _Findings(dict[Guard, float]):
    """Worst share so far, by guard."""


_findings: ContextVar[_Findings | None] = ContextVar("findings", default=None)


@contextlib.contextmanager
def watch() -> Iterator[dict[str, float]]:
    """Gather what guards find in a computation, and warn of each guard at most once, of its worst finding.

    Yields
    ------
    dict
        By the name of the guard, its worst share, once the computation is done. Within another `watch` it stays empty:
        the outer one gathers all.
    """
    if _findings.get() is not None:
        yield {}
        return
    findings = _Findings()
    shares: dict[str, float] = {}
    token = _findings.set(findings)
    try:
        yield shares
    finally:
        _findings.reset(token)
    for guard, share in findings.items():
        shares[guard.name] = _rounded(share)
        _warn(guard, share)


def judge(guard: Guard, share: float) -> None:
    """Take note of a share of the power.

    Raises
    ------
    PhysicsError
        If it is more than the guard's bound.
    """
    require(guard, share)
    share = max(0.0, share)
    findings = _findings.get()
    if findings is None:
        _warn(guard, share)
    else:
        findings[guard] = max(share, findings.get(guard, 0.0))


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
        held = _weighted(weight, waves) / math.prod(self._shape)
        self._representative = abs(share(held, self._power) - 1) < _UNSEEN
        if not self._representative:
            chosen, weight = np.arange(count), np.ones(count)
            waves = _packed_rows(packed, self._shape, None)
        rows, columns = (_frequencies(size) for size in self._shape)
        rows = rows[chosen]
        self._band_edge = band_edge_share(waves, rows, weight)
        if self._cosine**2 * 2 > 1:
            lost = backend_of(waves).arrays.asarray(self._cosine**2 * (rows[:, None] ** 2 + columns**2) >= 1)
            self._evanescent = share(_weighted(weight, waves * lost), _weighted(weight, waves))

    def see_result(self, field: Field) -> None:
        """Look at the field after the step, and judge it all.

        Raises
        ------
        PhysicsError
            If a guard's bound is passed.
        """
        after, rim = self._of_field(field)
        with watch():
            judge(EVANESCENT, self._evanescent)
            judge(UNDERSAMPLED, self._band_edge)
            # where few rows do not tell, nothing is known about the field before
            judge_window(share(rim, after), share(self._rim, self._power) if self._representative else 1.0)

    def _of_field(self, field: Field) -> tuple[float, float]:
        """Power in all and in the rim of the window."""
        rows = _some_rows(field)
        high, wide = (rim(size) for size in field.shape)
        place = np.arange(len(rows)) * self._step
        outer = (place < high) | (place >= len(field) - high)
        sides = sum(_weighted(~outer, side) for side in (rows[:, :wide], rows[:, -wide:]))
        return self._step * power(rows), self._step * (_weighted(outer, rows) + sides)


def require(guard: Guard, share: float) -> None:
    """Refuse a share of the power that is beyond a guard's bound, without taking note of it.

    Raises
    ------
    PhysicsError
        With the share.
    """
    if share > guard.refuse:
        raise PhysicsError(_sentence(guard, share))


def judge_window(in_rim: float, before: float = 0.0) -> None:
    """Take note of the share of a field's power in the rim of its window, after a way and before.

    Raises
    ------
    PhysicsError
        If light has gone round the window.
    """
    judge(WINDOW, in_rim)
    judge(WRAPPED, in_rim - before)


def _some_rows(field: Field) -> Field:
    """Give a view of the rows of a field from which a share of its power is told."""
    return field[:: _row_step(field)]


def _row_step(field: Field) -> int:
    # odd, so that the rows keep no step with what repeats by powers of two
    return len(field) // _ROWS | 1 if field.size > _SMALL else 1


def power(field: Field) -> float:
    """Sum of the squared moduli of a field whose rows are contiguous."""
    return float(_power_by_row(field).sum())


def rim(size: int) -> int:
    """Give the samples of a window's rim on one side."""
    return max(1, round(size * _EDGE / 2))


def band_edge_share(spectrum: Field, frequencies: np.ndarray | None = None, weight: np.ndarray | float = 1.0) -> float:
    """Share of the power in the outer eighth of the frequencies, zero frequency first.

    Parameters
    ----------
    spectrum : complex64 array (rows, columns)
        All of a spectrum, or some rows.
    frequencies : float64 array (rows,), optional
        Those of some rows, over the band limit.
    weight : float64 array (rows,)
        How many rows of the whole each of them stands for.
    """
    rows = _frequencies(len(spectrum)) if frequencies is None else frequencies
    outer, high = np.abs(rows) > 1 - _EDGE, np.flatnonzero(np.abs(_frequencies(spectrum.shape[1])) > 1 - _EDGE)
    # they are in the middle
    columns = spectrum[:, int(high[0]) : int(high[-1]) + 1] if high.size else spectrum[:, :0]
    edge = _weighted(weight * outer, spectrum) + _weighted(weight * ~outer, columns)
    return share(edge, _weighted(weight * np.ones(len(rows)), spectrum))


def _frequencies(size: int) -> np.ndarray:
    """Frequencies of a transform over the grid's band limit, zero first; float64 (size,)."""
    return np.fft.fftfreq(size) * 2


def share(part: float, whole: float) -> float:
    """Quotient, 0 of nothing."""
    return float(part / whole) if whole > 0 else 0.0


def _packed_rows(packed: Any, shape: tuple[int, ...], chosen: np.ndarray | None) -> Field:
    """Give some or all rows of a field held as 64-bit words."""
    field = as_field(packed, shape)
    return field if chosen is None else field[backend_of(field).arrays.asarray(chosen)]


def _weighted(weight: np.ndarray, field: Field) -> float:
    """Power of some rows, each as often as its weight says."""
    return float((backend_of(field).arrays.asarray(weight.astype(np.float64)) * _power_by_row(field)).sum())


def _power_by_row(field: Field) -> NDArray[np.float64]:
    """Sum of the squared moduli of each row, where the field lies."""
    parts = field.view(np.float32)
    return backend_of(field).arrays.einsum("ij,ij->i", parts, parts).astype(np.float64)


def _rounded(number: float) -> float:
    return float(f"{number:.{_DIGITS}g}")


def _sentence(guard: Guard, share: float) -> str:
    return f"{share:.2%} {guard.fault}; {guard.remedy}"


def _warn(guard: Guard, share: float) -> None:
    if share > guard.warn:
        warnings.warn(_sentence(guard, share), PhysicsWarning, stacklevel=_callers_level())


def _callers_level() -> int:
    """Frames from `_warn` up to the first one outside this package."""
    ours = str(Path(__file__).parent.parent)
    level, frame = 1, sys._getframe(1)
    while frame.f_back is not None and (
        frame.f_code.co_filename.startswith(ours) or frame.f_code.co_filename == contextlib.__file__
    ):
        level, frame = level + 1, frame.f_back
    return level
