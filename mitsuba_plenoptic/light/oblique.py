r"""Aberrations of microlenses for light from different points of the pupil.

Microlenses refract direction cosines, while light lands in proportion to slopes. Light that meets a lens of power 1/f
with the direction cosines s leaves the point m of the lens with :math:`s - m/f`, and lands at

.. math:: m + z\, T(s - m/f), \qquad T(s) = \frac{s}{\sqrt{1 - s^2 / n^2}} ,

in a medium of index n at the reduced distance z. The kernels of a detector's image have the linear part of T alone. The
nonlinear part, given by `phase`, is spherical aberration, coma, and the astigmatism and field curvature that grow with
the square of s. Kernels with this phase change with s nearly as a polynomial of degree 2 without mixed higher terms,

.. math:: \varphi_n(s) \approx \varphi_n(0) + \sum_k b_k(s)\, \varphi_{nk},
          \qquad b = (s_u, s_v, s_u^2, s_u s_v, s_v^2).

The changes :math:`\varphi_{nk}` resemble each other. A few combinations of them, the *oblique kernels*, therefore
suffice (principal components: Jolliffe, "Principal component analysis", section 3.5). The coefficients of their images
are those of the functions times factors that depend on s.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..runtime.backend import backend_of

DIRECTIONS = np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (0.5**0.5, 0.5**0.5)])
"""Direction cosines, over the largest ones, for which kernels are computed to find their changes."""

_ODD = [(True, False), (False, True), (False, False), (True, True), (False, False)]
"""Whether each of the terms is odd in s_u, and in s_v."""

_LEAST = 1e-9
"""Part of the mean variance that is added to all variances, so that their matrices can be inverted."""


def terms(u: Any, v: Any) -> list[Any]:
    """Return the terms in which kernels change with direction cosines, relative to the largest cosines."""
    return [u, v, u * u, u * v, v * v]


def phase(u: Any, v: Any, cosines: tuple[float, float], power: float, index: float, enlargement: float) -> Any:
    """Return the nonlinear part of the path for points of a lens, in millimetres, in units of the reduced distance.

    The gradient of this path times the reduced distance is the displacement of light on the detector, without the mean
    displacement by which micro-images are enlarged.
    """

    def potential(a: Any, b: Any) -> Any:
        # Beyond, light would be reflected totally.
        return -index * np.sqrt(np.maximum(index * index - a * a - b * b, 0))

    a, b = cosines
    slope = [s / np.sqrt(1 - (a * a + b * b) / index**2) for s in cosines]
    curved = potential(a - u * power, b - v * power) - potential(a, b)
    return (u * u + v * v) * power / 2 - curved / power - enlargement * (slope[0] * u + slope[1] * v)


@dataclass(frozen=True)
class Oblique:
    """The combinations of kernels' changes that a plan of n functions uses."""

    # Largest direction cosine.
    largest: float
    # Factors of the functions' images in that of each combination, for each term: (combinations, n, terms).
    factors: NDArray[np.float64]
    # Factors of the changes of the functions' kernels in the kernel of each combination: (combinations, n, terms).
    kernels: NDArray[np.float64]

    @classmethod
    def nothing(cls, functions: int) -> Oblique:
        """Return an empty set of combinations."""
        empty = np.zeros((0, functions, len(_ODD)))
        return cls(1.0, empty, empty)

    @classmethod
    def best(
        cls,
        largest: float,
        cosines: NDArray[np.float64],
        images: NDArray[np.float64],
        light: NDArray[np.float64],
        odd: Sequence[tuple[bool, bool]],
        tolerance: float,
        most: int,
    ) -> Oblique:
        """Return the fewest combinations that leave at most a part `tolerance` of the images of random light.

        At most `most` combinations are returned.

        `cosines` (rays, 2) are those of rays, relative to the largest. `images` (directions, n, values) are the
        functions' kernels for each of `DIRECTIONS`, in an orthonormal basis of the detector; `light` (n, n) is the
        covariance of the functions' coefficients in random light, and `odd` the symmetry of the functions.
        """
        change = np.einsum("kd,dnx->nkx", changes(), images)
        expected = np.transpose(terms(*cosines.T))
        both = np.einsum("nm,kl->nkml", light, expected.T @ expected / len(expected))
        whole = float(np.einsum("nm,nx,mx->", light, images[0], images[0]))
        shape, found = change.shape[:2], []
        for parity in itertools.product((False, True), repeat=2):
            own = [
                (n, k)
                for (n, first), (k, second) in itertools.product(enumerate(odd), enumerate(_ODD))
                if tuple(a != b for a, b in zip(first, second, strict=True)) == parity
            ]
            rows, columns = (np.array(part, int) for part in zip(*own, strict=True))
            matrix = both[rows[:, None], columns[:, None], rows, columns]
            root = np.linalg.cholesky(matrix + _LEAST * np.trace(matrix) / len(matrix) * np.eye(len(matrix)))
            left, values, _ = np.linalg.svd(root.T @ change[rows, columns], full_matrices=False)
            factors, kernels = np.linalg.solve(root.T, left), root @ left
            for number, value in enumerate(values):
                pair = np.zeros((2, *shape))
                pair[:, rows, columns] = factors[:, number], kernels[:, number]
                found.append((float(value) ** 2, pair))
        found.sort(key=lambda each: -each[0])
        rest = np.cumsum([value for value, _ in found][::-1])[::-1]
        count = min(int(np.count_nonzero(rest > tolerance**2 * whole)), most)
        used = np.array([pair for _, pair in found[:count]]).reshape(count, 2, *shape)
        return cls(largest, used[:, 0], used[:, 1])

    @property
    def count(self) -> int:
        """Number of combinations."""
        return len(self.factors)

    def terms(self, cosines: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the terms (terms, ...) of direction cosines (2, ...); an empty array without combinations."""
        u, v = cosines / np.float32(self.largest)
        arrays = backend_of(u).arrays
        return arrays.stack(terms(u, v)) if self.count else arrays.zeros((0, *u.shape), np.float32)

    def slopes(self, cosines: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the derivatives (2, terms, ...) of `terms` with respect to each cosine."""
        scale = np.float32(1 / self.largest)
        u, v = cosines * scale
        arrays = backend_of(u).arrays
        none, one = arrays.zeros_like(u), arrays.full_like(u, scale)
        parts = [
            [du, dv, 2 * u * du, u * dv + v * du, 2 * v * dv] if self.count else []
            for du, dv in ((one, none), (none, one))
        ]
        return arrays.stack([arrays.stack(part) if part else arrays.zeros((0, *u.shape), np.float32) for part in parts])


def changes() -> NDArray[np.float64]:
    """Return the matrix (terms, directions) that turns kernels for `DIRECTIONS` into their changes with the terms."""
    return np.asarray(np.linalg.inv(_values(DIRECTIONS))[1:])


def moved(step: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix from (1, terms) of direction cosines to (1, terms) of cosines a step (2,) further."""
    return np.asarray(np.linalg.solve(_values(DIRECTIONS), _values(DIRECTIONS + step)).T)


def _values(cosines: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return 1 and the terms, (n, 1 + terms), of direction cosines (n, 2)."""
    return np.column_stack([np.ones(len(cosines)), *terms(*cosines.T)])
