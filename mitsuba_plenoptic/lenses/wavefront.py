r"""Aberrations of the main lens: Zernike polynomials over its pupil.

The polynomials are in Noll's order, each with root mean square 1 over the pupil (R. J. Noll, "Zernike polynomials and
atmospheric turbulence", 1976). They are evaluated as polynomials of x and y, whose derivatives are again polynomials.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..bounds import WAVEFRONT_UNIT
from ..optics.phase import in_millimetres


def noll(j: int) -> tuple[int, int]:
    """Return radial order n and azimuthal order m, negative for sines, of the Zernike polynomial with Noll index j."""
    n = (math.isqrt(8 * j - 7) - 1) // 2
    place = j - n * (n + 1) // 2 - 1
    m = (-1) ** j * (n % 2 + 2 * ((place + (n + 1) % 2) // 2))
    return n, m


@functools.cache
def zernike(j: int) -> NDArray[np.float64]:
    """Return the coefficients of a Zernike polynomial; element [a, b] belongs to x^a y^b."""
    n, m = noll(j)
    order = abs(m)
    result = np.zeros((n + 1, n + 1))
    for k in range((n - order) // 2 + 1):
        radial = (-1) ** k * math.comb(n - k, k) * math.comb(n - 2 * k, (n - order) // 2 - k)
        half = (n - order) // 2 - k  # (x^2 + y^2)^half times the real or imaginary part of (x + i y)^order
        for i in range(half + 1):
            for p in range(order + 1):
                if p % 2 == (m < 0):
                    sign = (-1) ** (p // 2)
                    result[2 * i + order - p, 2 * (half - i) + p] += (
                        radial * math.comb(half, i) * math.comb(order, p) * sign
                    )
    return result * math.sqrt((n + 1) * (1 if m == 0 else 2))


class Wavefront:
    """A sum of Zernike polynomials."""

    def __init__(
        self,
        # In waves of 633 nm, from Noll index 1 on.
        coefficients: Any,
        # Radius of the pupil, in millimetres.
        radius: Any,
    ) -> None:
        self._radius = radius
        size = max((len(zernike(j)) for j in range(1, len(coefficients) + 1)), default=0)
        self._terms: list[list[Any]] = [[0.0] * (size - a) for a in range(size)]
        for j, coefficient in enumerate(coefficients, 1):
            for (a, b), factor in np.ndenumerate(zernike(j)):
                if factor:
                    self._terms[a][b] = self._terms[a][b] + coefficient * float(factor)

    def path(self, x: Any, y: Any) -> Any:
        """Return the path difference at a point of the pupil, in millimetres."""
        u, v = x / self._radius, y / self._radius
        return _sum([_sum(row, v) for row in self._terms], u) * in_millimetres(WAVEFRONT_UNIT)

    def slope(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Return the derivatives of `path` along x and y, which are the changes of direction."""
        u, v = x / self._radius, y / self._radius
        scale = in_millimetres(WAVEFRONT_UNIT) / self._radius
        along_x = _sum([_sum([a * term for term in row], v) for a, row in enumerate(self._terms)][1:], u)
        along_y = _sum([_sum([b * term for b, term in enumerate(row)][1:], v) for row in self._terms], u)
        return along_x * scale, along_y * scale


def _sum(terms: list[Any], x: Any) -> Any:
    """Return the value of a polynomial, by Horner's rule."""
    total: Any = 0.0
    for term in reversed(terms):
        total = total * x + term
    return total
