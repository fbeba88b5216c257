"""What an allowed error of an image permits: how much light to cut, and how unlike wavefronts may be that count as one.

The two rules are fitted to captures of walls and scenes by the camera of the paper, measured against images in which
nothing is shared and nothing but the last 0.1 % of the light is cut (the case `speed.sharing` of `tools/bench`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError, require_number
from ..lenses.base import MainLens
from .grid import Band

DEFAULT_ACCURACY = 0.01
"""Relative error, L2 over the image, that is allowed by default."""

_BANDS = (
    (0.004, Band(cone=2.5, margin=120, bends=3.45, orders=22)),
    (0.02, Band(cone=1.8, margin=60, bends=2.3, orders=10)),
    (1.0, Band(cone=1.5, margin=45, bends=1.8, orders=8)),
)
"""Bands, each with the allowed error of many points below which it is used."""

_FINEST = Band(cone=2.5, margin=200, bends=5, orders=32, edge=3.0, smooth=True)
"""Band of derivatives that are judged one by one (`tools/bench/cases/derivatives.py`)."""

_EXACT = 0.004
"""Allowed error below which it is used."""

_FEW = 512
"""Points up to which the light that is cut does not average out."""

_FEW_STRICTER = 5.0

_SHARP = 1 / 4
"""Samples over which edges of the pupil are softened for many points: walls lose 0.3 % of the light, not 1.2 %."""

WAVES_PER_ERROR = 10.0
"""Waves across one microlens by which wavefronts may differ, over the allowed error of the sum of many."""

_NEIGHBOURHOOD = 25
"""Lenses whose points have overlapping spreads, about."""

_MANY = 1600
"""Overlapping point spreads from which on the allowed error is reached by `WAVES_PER_ERROR`."""


def check_accuracy(accuracy: Any, name: str = "accuracy") -> float:
    """Return an allowed error as a float."""
    number = require_number(name, accuracy)
    if not 0 <= number < 1:
        raise InputError(f"{name} = {accuracy!r}: it must be from 0 (exact) to below 1")
    return number


def band_for(accuracy: float, count: int) -> Band:
    """Choose how much of the diffracted light to keep for an allowed error of the sum of some points."""
    allowed = accuracy / _FEW_STRICTER if count <= _FEW else accuracy
    band = next(band for limit, band in _BANDS if allowed < limit)
    if count <= _FEW:
        return band
    # What many points send farther than their orders averages out: nothing is gained by keeping it.
    return replace(band, edge=_SHARP, beyond=math.inf if allowed < _EXACT else band.orders)


def derivative_band_for(accuracy: float, count: int) -> Band:
    """Choose how much of the diffracted light to keep for derivatives.

    They weigh light that goes far: its phase changes fastest. What a hard edge of the pupil folds back changes fastest
    of all, so that edges are softer.
    """
    if accuracy < _EXACT:
        return _FINEST
    return replace(band_for(accuracy, count), edge=2.0, smooth=True)


def derivatives_share(accuracy: float, count: int) -> bool:
    """Return whether derivatives of the sum of some points share point spreads, as its image does."""
    return accuracy >= _EXACT and count > _FEW


def wavefront_step(accuracy: float, camera: PlenopticCamera, lens: MainLens, positions: NDArray[np.float64]) -> float:
    """Choose by how much wavefronts that count as one may differ across a microlens, in waves.

    The errors of point spreads that overlap average out, so fewer of them must each be truer.

    The positions are in the camera frame, or, behind a round lens, in one that is turned about the axis. The result is
    0 where nothing may be shared.
    """
    if not len(positions):
        return 0.0
    image = lens.images(positions)
    lenses = np.unique(np.floor(image / camera.mla_pitch), axis=0)
    overlap = min(len(positions), _NEIGHBOURHOOD * len(positions) / len(lenses))
    return accuracy * WAVES_PER_ERROR * min(1.0, (overlap / _MANY) ** 0.5)
