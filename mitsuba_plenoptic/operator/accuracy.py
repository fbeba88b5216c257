"""Rules from the allowed error of an image: how much light to discard, and which wavefronts may count as equal.

The two rules are fitted to captures of walls and scenes by the camera of the paper, compared with images in which no
point spreads are shared and only the last 0.1 % of the light is discarded (the case `speed.sharing` of `tools/bench`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError, refuse_if, require_number
from ..lenses.base import MainLens
from .grid import Band

DEFAULT_ACCURACY = 0.01
"""Default allowed relative error, L2 over the image."""

_BANDS = (
    (0.004, Band(cone=2.5, margin=120, bends=3.45, orders=22)),
    (0.02, Band(cone=1.8, margin=60, bends=2.3, orders=10)),
    (1.0, Band(cone=1.5, margin=45, bends=1.8, orders=8)),
)
"""Bands, each with the allowed error for many points below which it is used."""

_FINEST = Band(cone=2.5, margin=200, bends=5, orders=32, edge=3.0, smooth=True)
"""Band of derivatives at high accuracy (`tools/bench/cases/derivatives.py`)."""

_EXACT = 0.004
"""Allowed error below which `_FINEST` is used."""

_FEW = 512
"""Number of points up to which the errors by discarded light do not average out."""

_FEW_STRICTER = 5.0

_SHARP = 1 / 4
"""Samples over which edges of the pupil are softened for many points: walls lose 0.3 % of the light, not 1.2 %."""

WAVES_PER_ERROR = 10.0
"""Waves across a microlens by which wavefronts may differ, over the allowed error of a sum of many points."""

_NEIGHBOURHOOD = 25
"""Approximate number of lenses whose points have overlapping spreads."""

_MANY = 1600
"""Number of overlapping point spreads above which `WAVES_PER_ERROR` gives the allowed error."""


def check_accuracy(accuracy: Any, name: str = "accuracy") -> float:
    """Return an allowed error as a float."""
    number = require_number(name, accuracy)
    if not 0 <= number < 1:
        raise InputError(f"{name} = {accuracy!r}: it must be from 0 (exact) to below 1")
    return number


def chosen_accuracy(accuracy: float | None, method: str, default: float = DEFAULT_ACCURACY) -> float:
    """Return the allowed error of a method, by default its own, and refuse one that the method would ignore."""
    if accuracy is None:
        return default if method == "patch" else 0.0
    checked = check_accuracy(accuracy)
    refuse_if(
        checked and method != "patch",
        f"accuracy = {checked:g}: method = {method} takes none, as it computes every point spread without shortcuts",
    )
    return checked


def band_for(accuracy: float, count: int) -> Band:
    """Choose how much of the diffracted light to retain for an allowed error of the sum of some points."""
    allowed = accuracy / _FEW_STRICTER if count <= _FEW else accuracy
    band = next(band for limit, band in _BANDS if allowed < limit)
    if count <= _FEW:
        return band
    # Light that many points send beyond these orders averages out, so that retaining it gains nothing.
    return replace(band, edge=_SHARP, beyond=math.inf if allowed < _EXACT else band.orders)


def derivative_band_for(accuracy: float, count: int) -> Band:
    """Choose how much of the diffracted light to retain for derivatives.

    Derivatives give more weight to light at large angles, whose phase changes fastest. Light of a hard pupil edge that
    is aliased changes fastest of all, so that edges are softer than for images.
    """
    if accuracy < _EXACT:
        return _FINEST
    return replace(band_for(accuracy, count), edge=2.0, smooth=True)


def derivatives_share(accuracy: float, count: int) -> bool:
    """Return whether derivatives of the sum of some points share point spreads, as images do."""
    return accuracy >= _EXACT and count > _FEW


def wavefront_step(accuracy: float, camera: PlenopticCamera, lens: MainLens, positions: NDArray[np.float64]) -> float:
    """Choose the largest difference, in waves across a microlens, of wavefronts that count as equal.

    The errors of overlapping point spreads average out, so that fewer of them must each be more accurate.

    The positions are in the camera frame or, behind a round lens, in one that is rotated about the axis. The result is
    0 if nothing may be shared.
    """
    if not len(positions):
        return 0.0
    image = lens.images(positions)
    lenses = np.unique(np.floor(image / camera.mla_pitch), axis=0)
    overlap = min(len(positions), _NEIGHBOURHOOD * len(positions) / len(lenses))
    return accuracy * WAVES_PER_ERROR * min(1.0, (overlap / _MANY) ** 0.5)
