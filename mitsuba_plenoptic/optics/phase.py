"""Phase factors of path differences, and softened edges of pupils, of which thin elements are made."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np

from ..runtime.fft import array_types

_MM_PER_NM = 1e-6


def in_millimetres(wavelength: float) -> float:
    """Return a wavelength in millimetres, from nanometres."""
    return wavelength * _MM_PER_NM


def phasor(waves: Any) -> Any:
    r"""Return :math:`\exp(2 \pi i w)` for path differences in waves.

    Paths may be 10^6 waves, which single precision cannot represent. Whole waves are therefore removed in double
    precision, and only the remainder is passed to sine and cosine in single precision, with an error of 3e-7 rad at any
    distance.
    """
    if not dr.is_array_v(waves):
        return np.exp(2j * math.pi * waves).astype(np.complex64)
    types = array_types(waves)
    sine, cosine = dr.sincos(types.Float(waves - dr.round(waves)) * (2 * math.pi))
    return types.Complex2f(cosine, sine)


def parabola(square: Any, focal_length: Any, wavelength: float) -> Any:
    r"""Return the path difference of a thin parabolic lens in waves, :math:`-r^2 / 2 \lambda f`.

    Goodman, "Introduction to Fourier Optics", section 5.1.
    """
    return square * (-0.5 / (in_millimetres(wavelength) * focal_length))


def soft_edge(samples: Any) -> Any:
    """Return the transmission of an edge that is softened over one sample, at distances inside it in samples.

    The steep spectrum of a hard edge would be aliased into the band of the grid.
    """
    clip = dr.clip if dr.is_array_v(samples) else np.clip
    return clip(samples + 0.5, 0, 1)


def smooth_edge(samples: Any) -> Any:
    """Return the transmission of an edge as `soft_edge` does, but smoothed by a cubic between the same ends."""
    passed = soft_edge(samples)
    return passed * passed * (3 - 2 * passed)
