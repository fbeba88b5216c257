"""Light that a small sphere scatters, by angle and polarisation (Mie 1908).

The package miepython has the coefficients of the series, and equations 4.47 and 4.74 of Bohren and Huffman 1983,
"Absorption and Scattering of Light by Small Particles", are their sum.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ...errors import refuse_if, require_module
from ...runtime import Doubles

LARGEST = 2000.0
"""Size parameter at most: 250 micrometres in water, where rays would do, and the series has 2000 terms."""


def coefficients(size: Doubles, index: complex) -> NDArray[np.complex128]:
    """Return the scattering coefficients a and b of spheres by size parameter, (2, terms, spheres), 0 beyond the last.

    The index, over that of the medium, has a positive imaginary part where it absorbs.
    """
    refuse_if(size.max(initial=0) > LARGEST, f"diameter: a size parameter is {size.max():.4g}, at most {LARGEST:g}")
    series = [_of_sphere(x, complex(index)) for x in size.tolist()]
    result = np.zeros((2, max((terms.shape[1] for terms in series), default=1), len(size)), complex)
    for sphere, terms in enumerate(series):
        result[:, : terms.shape[1], sphere] = terms
    return result


@lru_cache(maxsize=2**14)
def _of_sphere(size: float, index: complex) -> NDArray[np.complex128]:
    """Return the coefficients of one sphere, which captures ask for several times."""
    miepython = require_module(
        "miepython", "light scattered by spheres needs a package: pip install 'mitsuba-plenoptic[particles]'"
    )
    # There the imaginary part is negative where a sphere absorbs.
    return np.asarray(miepython.coefficients(index.conjugate(), size))


def amplitudes(diameters: Doubles, index: complex, wavelength: float, cosines: Doubles) -> NDArray[np.complex128]:
    """Return the amplitudes S1 and S2, of light across the plane of scattering and in it, (2, spheres, angles).

    Parameters are those of `cross_sections`. Phases are those of light that travels as exp(i k r).
    """
    a, b = coefficients(np.pi * diameters / (wavelength * 1e-3), index)
    scattered = np.zeros((2, *cosines.shape), complex)
    # Angular functions pi and tau, Bohren and Huffman's equation 4.47.
    before = np.zeros(cosines.shape)
    pi = np.ones(cosines.shape)
    for n in range(1, len(a) + 1):
        tau = n * cosines * pi - (n + 1) * before
        weight = (2 * n + 1) / (n * (n + 1))
        own_a = weight * a[n - 1, :, None]
        own_b = weight * b[n - 1, :, None]
        scattered[0] += own_a * pi + own_b * tau
        scattered[1] += own_a * tau + own_b * pi
        before, pi = pi, ((2 * n + 1) * cosines * pi - (n + 1) * before) / n
    return scattered


def cross_sections(diameters: Doubles, index: complex, wavelength: float, cosines: Doubles) -> Doubles:
    """Return differential scattering cross-sections, in square micrometres per steradian, of unpolarised light.

    Parameters
    ----------
    diameters : float64 array (spheres,)
        Diameters in micrometres.
    index : complex
        Refractive index over that of the medium.
    wavelength : float
        Wavelength in the medium, in nanometres.
    cosines : float64 array (spheres, angles)
        Cosines of the angle between the incident and the scattered light.
    """
    wavenumber = 2 * np.pi / (wavelength * 1e-3)
    power = (np.abs(amplitudes(diameters, index, wavelength, cosines)) ** 2).sum(0)
    return np.asarray(power / (2 * wavenumber**2))
