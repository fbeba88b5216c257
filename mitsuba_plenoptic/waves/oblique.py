r"""Changes of the microlenses' kernels with the direction of light.

Microlenses refract direction cosines, while light lands in proportion to slopes. Light that meets a lens of power 1/f
with the direction cosines s leaves the point m of the lens with :math:`s - m/f`, and lands at

.. math:: m + z\, T(s - m/f), \qquad T(s) = \frac{s}{\sqrt{1 - s^2 / n^2}} ,

in a medium of index n at the reduced distance z. Kernels are relative to the landing point of the lens's centre, so
that spherical aberration, coma, and the astigmatism and field curvature that grow with the square of s remain. Kernels
change with s nearly as a polynomial of degree 2 without mixed higher terms,

.. math:: \varphi_n(s) \approx \varphi_n(0) + \sum_k b_k(s)\, \varphi_{nk},
          \qquad b = (s_u, s_v, s_u^2, s_u s_v, s_v^2) ,

and where light is steeper as one of degree 4. The changes :math:`\varphi_{nk}` resemble each other. A few combinations
of them, the *oblique kernels*, therefore suffice (principal components: Jolliffe, "Principal component analysis",
section 3.5). The coefficients of their images are those of the functions times factors that depend on s.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..runtime import Doubles, Floats, backend_of, exponents, monomials
from .accuracy import USUAL


def terms(u: Any, v: Any, degree: int) -> list:
    """Return the terms in which kernels change with direction cosines, relative to the largest cosines."""
    return monomials(u, v, exponents(degree, lowest=1))


@functools.cache
def directions(degree: int) -> Doubles:
    """Return direction cosines, over the largest ones, whose kernels give their changes; the first are zeros."""
    if degree == 2:
        return np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (0.5**0.5, 0.5**0.5)])
    # Between them, two rings of eight tell all terms of degree 4 apart.
    rings = [
        radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        for radius, angles in ((1.0, np.arange(8) * np.pi / 4), (USUAL.inner_ring, (np.arange(8) + 0.5) * np.pi / 4))
    ]
    return np.concatenate([np.zeros((1, 2)), *rings])


@dataclass(frozen=True)
class Oblique:
    """The combinations of kernels' changes that a plan of n functions uses."""

    # Largest direction cosine.
    largest: float
    # Factors of the functions' images in that of each combination, for each term: (combinations, n, terms).
    factors: Doubles
    # Factors of the changes of the functions' kernels in the kernel of each combination: (combinations, n, terms).
    kernels: Doubles
    # Matrix from 1 and the terms, made orthonormal in light from all directions, to 1 and the terms.
    basis: Doubles

    @classmethod
    def nothing(cls, functions: int) -> Oblique:
        """Return an empty set of combinations."""
        count = len(exponents(2, lowest=1))
        empty = np.zeros((0, functions, count))
        return cls(1.0, empty, empty, np.eye(1 + count))

    @classmethod
    def best(
        cls,
        largest: float,
        cosines: Doubles,
        images: Doubles,
        light: Doubles,
        odd: Sequence[tuple[bool, bool]],
        tolerance: float,
        most: int,
    ) -> Oblique:
        """Return the fewest combinations that leave at most a part `tolerance` of the images of random light.

        At most `most` combinations are returned.

        `cosines` (rays, 2) are those of rays, relative to the largest. `images` (directions, n, values) are the
        functions' kernels for each of the `directions` of a degree, in an orthonormal basis of the detector; `light`
        (n, n) is the covariance of the functions' coefficients in random light, and `odd` the symmetry of the
        functions.
        """
        degree = 2 if len(images) == len(directions(2)) else 4
        change = np.einsum("kd,dnx->nkx", changes(degree), images)
        of_rays = _values(cosines, degree)
        moments = of_rays.T @ of_rays / len(of_rays)
        odd_terms = [(i % 2 == 1, j % 2 == 1) for i, j in exponents(degree, lowest=1)]
        both = np.einsum("nm,kl->nkml", light, moments[1:, 1:])
        in_all = float(np.einsum("nm,nx,mx->", light, images[0], images[0]))
        shape = change.shape[:2]
        candidates = []
        for parity in itertools.product((False, True), repeat=2):
            pairs = [
                (n, k)
                for (n, first), (k, second) in itertools.product(enumerate(odd), enumerate(odd_terms))
                if tuple(a != b for a, b in zip(first, second, strict=True)) == parity
            ]
            rows, columns = (np.array(indices, int) for indices in zip(*pairs, strict=True))
            matrix = both[rows[:, None], columns[:, None], rows, columns]
            added = USUAL.added_variance * np.trace(matrix) / len(matrix)
            root = np.linalg.cholesky(matrix + added * np.eye(len(matrix)))
            left, values, _ = np.linalg.svd(root.T @ change[rows, columns], full_matrices=False)
            factors = np.linalg.solve(root.T, left)
            kernels = root @ left
            for index, value in enumerate(values):
                pair = np.zeros((2, *shape))
                pair[:, rows, columns] = factors[:, index], kernels[:, index]
                candidates.append((float(value) ** 2, pair))
        candidates.sort(key=lambda candidate: -candidate[0])
        left_out = np.cumsum([value for value, _ in candidates][::-1])[::-1]
        count = min(int(np.count_nonzero(left_out > tolerance**2 * in_all)), most)
        combinations = np.array([pair for _, pair in candidates[:count]]).reshape(count, 2, *shape)
        basis = np.asarray(np.linalg.cholesky(moments + USUAL.added_variance * np.diag(moments.diagonal())))
        return cls(largest, combinations[:, 0], combinations[:, 1], basis)

    @property
    def count(self) -> int:
        """Number of combinations."""
        return len(self.factors)

    @property
    def degree(self) -> int:
        """Degree of the terms."""
        # There are degree (degree + 3) / 2 of them.
        return math.isqrt(2 * self.factors.shape[2]) - 1

    def terms(self, cosines: Floats) -> Floats:
        """Return the orthonormal terms (terms, pixels), after the first, of direction cosines (2, pixels).

        The array is empty without combinations.
        """
        u, v = cosines / np.float32(self.largest)
        arrays = backend_of(u).arrays
        if not self.count:
            return arrays.zeros((0, *u.shape), np.float32)
        return self._orthonormal(arrays, [arrays.ones_like(u), *terms(u, v, self.degree)])

    def _orthonormal(self, arrays: Any, values: list) -> Any:
        """Return the orthonormal terms after the first, or their slopes, from 1 and the terms, or from their slopes."""
        inverse = np.linalg.inv(self.basis)[1:].astype(np.float32)
        return arrays.asarray(inverse) @ arrays.stack(values)

    def slopes(self, cosines: Floats) -> Floats:
        """Return the derivatives (2, terms, ...) of `terms` with respect to each cosine."""
        scale = np.float32(1 / self.largest)
        u, v = cosines * scale
        arrays = backend_of(u).arrays
        if not self.count:
            return arrays.zeros((2, 0, *u.shape), np.float32)
        pairs = exponents(self.degree, lowest=1)
        lower = dict(zip(pairs, terms(u, v, self.degree), strict=True)) | {(0, 0): arrays.ones_like(u)}
        slopes = []
        for axis in (0, 1):
            along = [arrays.zeros_like(u)]
            for pair in pairs:
                i = pair[0] - (axis == 0)
                j = pair[1] - (axis == 1)
                along.append(lower[i, j] * (scale * pair[axis]) if pair[axis] else along[0])
            slopes.append(self._orthonormal(arrays, along))
        return arrays.stack(slopes)


def changes(degree: int) -> Doubles:
    """Return the matrix (terms, directions) that turns kernels for `directions` into their changes with the terms."""
    some = np.linalg.pinv(_values(directions(degree), degree)[1:, 1:])
    return np.column_stack([-some.sum(1), some])


def moved(step: Doubles, degree: int) -> Doubles:
    """Return the matrix from (1, terms) of direction cosines to (1, terms) of cosines a step (2,) further."""
    cosines = directions(degree)
    return np.asarray(np.linalg.lstsq(_values(cosines, degree), _values(cosines + step, degree), rcond=None)[0].T)


def _values(cosines: Doubles, degree: int) -> Doubles:
    """Return 1 and the terms, (n, 1 + terms), of direction cosines (n, 2)."""
    return np.column_stack([np.ones(len(cosines)), *terms(cosines[:, 0], cosines[:, 1], degree)])
