"""From path differences to complex factors, and the edges of pupils: what every thin element is made of."""

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
    r"""Return :math:`\exp(2 \pi i w)` of path differences in waves.

    They may be 10^6 waves, which single precision cannot hold: whole waves are dropped in double precision, and only
    the rest goes to sine and cosine in single precision, with an error of 3e-7 rad at any distance.
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
    """Return what an edge that is softened over one sample lets through.

    A hard edge would fold its steep spectrum back into the band of the grid.
    """
    clip = dr.clip if dr.is_array_v(samples) else np.clip
    return clip(samples + 0.5, 0, 1)


def smooth_edge(samples: Any) -> Any:
    """Return what `soft_edge` does, without its kinks: a cubic between the same ends."""
    passed = soft_edge(samples)
    return passed * passed * (3 - 2 * passed)
