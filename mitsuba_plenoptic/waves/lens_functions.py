r"""The functions of a ray's point on a lens that describe where the lens diffracts the ray's light.

The light L(m) that a lens receives gives the image :math:`\int L(m) K(m, p)\, dm` on the detector. Functions
:math:`a_n` and kernels :math:`\varphi_n` approximate :math:`K(m, p) \approx \sum_n a_n(m) \varphi_n(p)`. The chosen
functions have, for their number, the smallest mean square error of the images of random light (reduced-rank regression:
Izenman, J. Multivar. Anal. 5, 248 (1975)). Random light has edges at random places in random directions, so that its
covariance decreases linearly with distance.

The functions are combinations of polynomials that are orthonormal over the aperture of a lens. The first is 1, and the
others have the mean 0, so that uniform light is exact. The kernels are the integrals of K with the duals :math:`d_n` of
the functions, for which :math:`\int d_n a_k\, dm = \delta_{nk}`.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..runtime import Doubles, Pair, Shape, exponents, monomials, on_all_cores
from .accuracy import USUAL


def of_middles(exponents: list[Shape], fields: dict[Shape, NDArray[np.complex128]]) -> list[Doubles]:
    r"""Return the diffraction of powers of the middle of two points, from that of fields times powers of one point.

    Integrals are sums of products, as :math:`m^i = 2^{-i} \sum_a \binom{i}{a} x_1^a x_2^{i-a}` for middles m.
    """
    moments = []
    for i, j in exponents:
        both = np.zeros(fields[0, 0].shape)
        for a, b in itertools.product(range(i + 1), range(j + 1)):
            weight = math.comb(i, a) * math.comb(j, b) / 2 ** (i + j)
            both += weight * (fields[a, b] * fields[i - a, j - b].conj()).real
        moments.append(both)
    return moments


@dataclass(frozen=True)
class LensFunctions:
    """Functions over a lens, as combinations of orthonormal polynomials."""

    # Length by which coordinates are divided in the monomials.
    scale: float
    # Powers of u and v of the monomial that each polynomial adds to the previous ones.
    exponents: list[Shape]
    # Coefficients (monomials, polynomials).
    triangle: Doubles
    # Coefficients (polynomials, functions) of the functions and of their duals.
    functions: Doubles
    duals: Doubles
    # Whether each function is odd in u, and in v.
    odd: list[tuple[bool, bool]]

    @classmethod
    def polynomials(cls, u: Doubles, v: Doubles, degree: int, scale: float) -> LensFunctions:
        """Return polynomials that are orthonormal over an aperture of points u and v, by Gram-Schmidt."""
        powers = exponents(degree)
        terms = np.stack(monomials(u / scale, v / scale, powers))
        triangle = np.linalg.inv(np.linalg.cholesky(terms @ terms.T / len(u))).T
        unit = np.eye(len(powers))
        return cls(scale, powers, triangle, unit, unit, [(i % 2 == 1, j % 2 == 1) for i, j in powers])

    def values(self, u: Doubles, v: Doubles, coefficients: Doubles) -> Doubles:
        """Return the values (n, ...) at positions of combinations of the polynomials, by their coefficients."""
        terms = monomials(u / self.scale, v / self.scale, self.exponents)
        return np.tensordot((self.triangle @ coefficients).T, np.stack(terms), 1)

    @property
    def count(self) -> int:
        """Number of functions."""
        return self.functions.shape[1]

    @cached_property
    def combined(self) -> Doubles:
        """Coefficients (monomials, functions) of the functions."""
        return self.triangle @ self.functions

    def best(self, count: int, tolerance: float, points: Pair, images: Doubles) -> LensFunctions:
        """Return the fewest combinations of polynomials that leave a part `tolerance` of the images of random light.

        At most `count` combinations are returned.

        Parameters are points u and v that fill the aperture evenly, and images (polynomials, values): the integrals of
        the polynomials with K, in an orthonormal basis of the detector.
        """
        odd = np.array(self.odd)
        expected = _differing(self.values(*points, np.eye(len(self.odd))).T, *points, self.scale)
        # Rounding would mix functions of different symmetry.
        expected *= (odd == odd[:, None]).all(-1)
        products = images @ images.T
        candidates = []
        for parity in ((False, False), (True, False), (False, True), (True, True)):
            (alike,) = np.nonzero((odd == parity).all(1) & (np.arange(len(odd)) > 0))
            if not len(alike):
                continue
            own_products = products[np.ix_(alike, alike)]
            root = np.linalg.cholesky(expected[np.ix_(alike, alike)])
            removed, directions = np.linalg.eigh(root.T @ own_products @ root)
            for error, function in zip(removed, (own_products @ root @ directions).T, strict=True):
                full = np.zeros(len(odd))
                full[alike] = function / np.linalg.norm(function)
                candidates.append((float(error), parity, full))
        candidates.sort(key=lambda candidate: -candidate[0])
        errors = np.array([error for error, _, _ in candidates])
        left = np.append(np.cumsum(errors[::-1])[::-1], 0)
        apart = np.append(errors[:-1] >= errors[1:] * (1 + USUAL.tied), True)
        allowed = np.append(0, 1 + np.flatnonzero(apart))
        allowed = allowed[allowed < count]
        enough = allowed[left[allowed] <= tolerance**2 * 2 * np.pi * (_covariance(expected) * products).sum()]
        most = int(enough[0] if len(enough) else allowed[-1])
        first = np.eye(len(odd))[:, :1]
        functions = np.column_stack([first, *(full for _, _, full in candidates[:most])])
        others = functions[:, 1:]
        duals = np.column_stack([first, expected @ others @ np.linalg.inv(others.T @ expected @ others)])
        parities = [(False, False), *(parity for _, parity, _ in candidates[:most])]
        return LensFunctions(self.scale, self.exponents, self.triangle, functions, duals, parities)

    def light(self, u: Doubles, v: Doubles) -> Doubles:
        """Return the covariance of the functions' coefficients for light that has, on average, one edge on a lens.

        The light is 0 on one side of the edge and 1 on the other; parameters are as for `best`.
        """
        return edge_covariance(self.values(u, v, self.duals).T, u, v, self.scale)


class LegendreProducts:
    """Products of Legendre polynomials of both coordinates over a part of a lens, less their means.

    They are many functions that cost rays little. Where the part is symmetric about the lens's centre, so are kernels,
    and functions of odd degrees have none.
    """

    scale = 1.0

    def __init__(self, u: Doubles, v: Doubles, degree: int, symmetric: bool):
        """Take points that fill the part evenly."""
        self.pairs = [(i, j) for i, j in exponents(degree) if not (symmetric and (i + j) % 2)]
        # Middle and half width, along u and v, of the box around the part.
        ends = [(values.min(), values.max()) for values in (u, v)]
        self._box = [(0.0 if symmetric else (low + high) / 2, (high - low) / 2) for low, high in ends]
        self._means = np.zeros(len(self.pairs))
        self._means = np.append(0.0, self.values(u, v)[:, 1:].mean(0))
        values = self.values(u, v)
        # Coefficients (monomials, functions) of the duals, whose integrals with the kernel of the light are kernels.
        self.exponents = self.pairs
        terms = np.stack(monomials(u, v, self.exponents), -1)
        self.combined = np.linalg.lstsq(terms, values @ np.linalg.inv(values.T @ values / len(u)), rcond=None)[0]

    @property
    def count(self) -> int:
        """Number of functions."""
        return len(self.pairs)

    def values(self, u: Doubles, v: Doubles) -> Doubles:
        """Return the values (points, functions) at points."""
        along = [legendre(x, max(map(sum, self.pairs))) for x in self._boxed(u, v)]
        return np.stack([along[0][i] * along[1][j] + 0 * u for i, j in self.pairs], -1) - self._means

    def at_rays(self, u: Any, v: Any) -> list:
        """Return the values at Dr.Jit points."""
        along = [legendre(x, max(map(sum, self.pairs))) for x in self._boxed(u, v, dr.opaque)]
        others = zip(self.pairs[1:], self._means[1:].tolist(), strict=True)
        return [mi.Float(1), *(along[0][i] * along[1][j] - dr.opaque(mi.Float, mean) for (i, j), mean in others)]

    def light(self, u: Doubles, v: Doubles) -> Doubles:
        """Return the covariance of the functions' integrals over light with random edges."""
        return edge_covariance(self.values(u, v), u, v, self.scale)

    def _boxed(self, u: Any, v: Any, opaque: Any = None) -> Pair:
        """Return coordinates in the box around the part, from -1 to 1."""
        boxed = []
        for x, numbers in zip((u, v), self._box, strict=True):
            middle, half = (dr.opaque(mi.Float, number) for number in numbers) if opaque else numbers
            boxed.append((x - middle) / half)
        return boxed[0], boxed[1]


def legendre(x: Any, degree: int) -> list:
    """Return Legendre's polynomials up to a degree, by their recurrence."""
    series = [1.0, x]
    for n in range(1, degree):
        series.append(((2 * n + 1) / (n + 1)) * x * series[n] - (n / (n + 1)) * series[n - 1])
    return series


def even_polynomials(parts: Sequence[Pair], degree: int) -> list[LensFunctions]:
    """Return polynomials that are orthonormal over each of some sets of points, all of the largest degree possible.

    The degree is at most `degree`, and less where points lie so that single precision does not suffice for it.
    """
    for highest in range(degree, 0, -1):
        with contextlib.suppress(np.linalg.LinAlgError):
            sets = [LensFunctions.polynomials(u, v, highest, 1.0) for u, v in parts]
            if max(np.linalg.cond(functions.triangle) for functions in sets) < USUAL.worst_condition:
                return sets
    return [LensFunctions.polynomials(u, v, 0, 1.0) for u, v in parts]


def edge_covariance(values: Doubles, u: Doubles, v: Doubles, scale: float) -> Doubles:
    """Return the covariance of the integrals of functions over light with random edges; see `LensFunctions.light`.

    `values` (points, functions) are those at points u and v, which have the density of the integrals.
    """
    return _covariance(_differing(values, u, v, scale))


def _differing(values: Any, u: Any, v: Any, scale: float) -> Doubles:
    """Return the covariance of functions' integrals over light with random edges, less the mean."""
    values = (values - values.mean(0)).astype(np.float32)
    u, v = (np.asarray(coordinate, np.float32) for coordinate in (u, v))

    def of_some(rows: slice) -> Any:
        apart = np.square(u[rows, None] - u)
        apart += np.square(v[rows, None] - v)
        return values[rows].T @ (np.sqrt(apart, out=apart) @ values)

    # 128: Points of a lens whose distances from all others are computed at a time, so that these fit into a cache.
    parts = on_all_cores(of_some, [slice(row, row + 128) for row in range(0, len(u), 128)])
    return np.asarray(-sum(parts) / (scale * len(u) ** 2))


def _covariance(expected: Doubles) -> Doubles:
    """Return the covariance of the polynomials' coefficients for light that has, on average, one edge on a lens."""
    # An edge is between two points with a probability in proportion to their distance.
    full = expected / (2 * np.pi)
    # 0.5: Mean square of light that is 0 or 1.
    full[0, 0] += 0.5
    return full
