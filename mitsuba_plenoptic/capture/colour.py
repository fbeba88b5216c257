r"""Colours as spectra and spectra as colours, by Mitsuba's own tables of CIE 1931 and D65.

Light of a colour gets the spectrum of D65 times a reflectance, and that is :math:`\sum_c v_c \rho_c(\lambda)` with
three reflectances, of the primaries red, green and blue of sRGB: nowhere negative, of sum 1, and as smooth as they can
be (the rule of Mallett and Yuksel 2019, "Spectral primary decomposition for rendering with sRGB reflectance", section
4; the numbers are found here). It is linear, so that light of any strength, and sums of lights, have spectra.
"""

from __future__ import annotations

import functools

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..optics.spectrum import WAVELENGTHS, Spectrum

_STEP = 10.0
"""Distance in nanometres of the wavelengths at which reflectances are found."""

_EXACT = 1e5
"""How much more the colours count than the smoothness."""

_LOW, _HIGH = 380.0, 730.0
"""What is visible: beyond, the luminous efficiency is below 1/1000 of its peak."""


def srgb(count: int = WAVELENGTHS) -> Spectrum:
    """Return the responses of linear sRGB to light, as Mitsuba's films of colours have them.

    Parameters
    ----------
    count : int
        Wavelengths, from 380 to 730 nm.
    """
    return Spectrum.smooth(_srgb_responses, _LOW, _HIGH, count)


def _srgb_responses(wavelengths: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the responses (3, n) per nanometre of red, green and blue."""
    xyz = np.array(mi.cie1931_xyz(mi.Float(wavelengths)), np.float64)
    matrix = np.array([np.ravel(mi.xyz_to_srgb(mi.ScalarColor3f(unit))) for unit in np.eye(3).tolist()], np.float64).T
    return np.asarray(matrix @ xyz * mi.MI_CIE_Y_NORMALIZATION)


def _d65(wavelengths: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the spectrum of D65, of luminance 1."""
    return np.array(mi.cie_d65(mi.Float(wavelengths)), np.float64)


def upsampling(wavelengths: tuple[float, ...]) -> NDArray[np.float64]:
    """Return the spectra (3, n) of light of red, green and blue 1 at some wavelengths in nanometres."""
    grid, basis = _reflectances()
    places = np.array(wavelengths)
    return np.stack([np.interp(places, grid, row) for row in basis]) * _d65(places)


@functools.cache
def _reflectances() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return wavelengths, and at each the reflectances (3, n) of the primaries."""
    # It takes a while to import, and few captures upsample.
    from scipy.optimize import lsq_linear

    grid = np.arange(mi.MI_CIE_MIN, mi.MI_CIE_MAX + _STEP / 2, _STEP)
    count = len(grid)
    seen = _srgb_responses(grid) * _d65(grid) * _STEP
    # D65 itself is white to the last digit.
    seen /= seen.sum(axis=1, keepdims=True)
    smooth = np.kron(np.eye(3), np.diff(np.eye(count), axis=0))
    colours = np.kron(np.eye(3), seen)
    whole = np.kron(np.ones((1, 3)), np.eye(count))
    matrix = np.vstack([smooth, _EXACT * colours, _EXACT * whole])
    target = np.concatenate([np.zeros(len(smooth)), _EXACT * np.eye(3).ravel(), np.full(count, _EXACT)])
    found = lsq_linear(matrix, target, bounds=(0, 1), method="bvls", max_iter=2000)
    return grid, np.maximum(found.x, 0).reshape(3, count)
