r"""Light that a small sphere scatters, by angle and polarisation (Mie 1908).

After Bohren and Huffman 1983, "Absorption and Scattering of Light by Small Particles", chapter 4. With the size
parameter :math:`x = \pi d n / \lambda` and the relative index m, and the Riccati-Bessel functions :math:`\psi_n` and
:math:`\xi_n`,

.. math:: a_n = \frac{(D_n(mx) / m + n / x) \psi_n(x) - \psi_{n-1}(x)}
                     {(D_n(mx) / m + n / x) \xi_n(x) - \xi_{n-1}(x)}

and :math:`b_n` with :math:`m D_n` in the place of :math:`D_n / m` (their equation 4.88). :math:`D_n` is the logarithmic
derivative of :math:`\psi_n`, which is stable in downward recurrence.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import spherical_jn, spherical_yn

from ...errors import refuse_if

LARGEST = 2000.0
"""Size parameter at most: 250 micrometres in water, where rays would do, and the series has 2000 terms."""

_BEYOND = 15
"""Terms beyond the last one, besides eight times its cube root, from which the downward recurrence starts."""


def coefficients(size: NDArray[np.float64], index: complex) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return the scattering coefficients a and b of spheres, (terms, spheres), 0 beyond a sphere's own last term.

    Parameters
    ----------
    size : float64 array (spheres,)
        Size parameters, above 0.
    index : complex
        Refractive index over that of the medium, with a positive imaginary part where it absorbs.
    """
    refuse_if(size.max(initial=0) > LARGEST, f"diameter: a size parameter is {size.max():.4g}, at most {LARGEST:g}")
    # Wiscombe's criterion of convergence (1980, Applied Optics 19, 1505).
    last = np.ceil(size + 4.05 * np.cbrt(size) + 2).astype(int)
    terms = int(last.max(initial=1))
    inner = index * size
    derivative = np.zeros((terms + 1, len(size)), complex)
    current = np.zeros(len(size), complex)
    largest = max(float(terms), float(np.abs(inner).max(initial=0)))
    for order in range(int(largest + 8 * largest ** (1 / 3)) + _BEYOND, 0, -1):
        current = order / inner - 1 / (current + order / inner)
        if order <= terms + 1:
            derivative[order - 1] = current
    orders = np.arange(terms + 1)[:, None]
    n, found = orders[1:], []
    with np.errstate(all="ignore"):
        psi = size * spherical_jn(orders, size)
        xi = psi + 1j * size * spherical_yn(orders, size)
        for factor in (1 / index, index):
            inside = factor * derivative[1:] + n / size
            found.append((inside * psi[1:] - psi[:-1]) / (inside * xi[1:] - xi[:-1]))
    # Beyond its last term a small sphere's functions leave what floats hold.
    a, b = (np.where(n <= last, each, 0) for each in found)
    return a, b


def amplitudes(
    diameters: NDArray[np.float64], index: complex, wavelength: float, cosines: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """Return the amplitudes S1 and S2, of light across the plane of scattering and in it, (2, spheres, angles).

    Parameters are those of `cross_sections`. Phases are those of light that travels as exp(i k r).
    """
    a, b = coefficients(np.pi * diameters / (wavelength * 1e-3), index)
    found = np.zeros((2, *cosines.shape), complex)
    # Angular functions pi and tau, Bohren and Huffman's equation 4.47.
    before, pi = np.zeros(cosines.shape), np.ones(cosines.shape)
    for n in range(1, len(a) + 1):
        tau = n * cosines * pi - (n + 1) * before
        weight = (2 * n + 1) / (n * (n + 1))
        own_a, own_b = weight * a[n - 1, :, None], weight * b[n - 1, :, None]
        found[0] += own_a * pi + own_b * tau
        found[1] += own_a * tau + own_b * pi
        before, pi = pi, ((2 * n + 1) * cosines * pi - (n + 1) * before) / n
    return found


def cross_sections(
    diameters: NDArray[np.float64], index: complex, wavelength: float, cosines: NDArray[np.float64]
) -> NDArray[np.float64]:
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
