"""Least squares that gross errors do not bend: the median states what is typical; rows far beyond it do not count."""

from __future__ import annotations

import numpy as np

# Rows beyond this number of deviations are outliers: they are named, and do not count in a fit. In data with normal
# errors one row in 60 million lies there.
OUTLIER = 6.0

# Rows beyond this number of deviations count by their distance instead of its square (Huber).
_HUBER = 4.0

_MOST_REPEATS = 30


def deviation(distance: np.ndarray) -> float:
    """Return the deviation along an axis of positions whose distances these are, from their median."""
    return float(np.median(distance)) / 1.17741


def outlying(distance: np.ndarray) -> np.ndarray:
    """Return which rows are outliers, by their distance from where they should be."""
    outliers: np.ndarray = distance > OUTLIER * max(deviation(distance), 1e-9)
    return outliers


def huber(distance: np.ndarray) -> np.ndarray:
    """Return the weights by which rows far from where they should be count by their distance, not its square."""
    bound = _HUBER * max(deviation(distance), 1e-9)
    return bound / np.maximum(distance, bound)


def robust_lines(matrix: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit positions linearly, as long as more than half of them are right.

    The least sum of distances shows which rows are outliers; the others are then fitted by least squares.

    Parameters
    ----------
    matrix : (n, 2, k) array
        What each of k coefficients adds to a position.
    values : (n, 2) array
        The positions.

    Returns
    -------
    coefficients : (k,) array
    distance : (n,) array
        Of each position from the fitted one.
    good : (n,) bool array
        Rows that are no outliers.
    """
    scale = np.sqrt((matrix**2).sum((0, 1)))
    matrix = matrix / np.where(scale > 0, scale, 1)

    def solve(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        root = np.sqrt(weights)
        rows = (matrix * root[:, None, None]).reshape(-1, matrix.shape[2])
        found = np.linalg.lstsq(rows, (values * root[:, None]).ravel())[0]
        return found, np.hypot(*(matrix @ found - values).T)

    found, distance = solve(np.ones(len(values)))
    last = np.inf
    for _ in range(_MOST_REPEATS):
        total = float(distance.sum())
        if not total < 0.999 * last:
            break
        last = total
        found, distance = solve(1 / np.maximum(distance, 1e-3 * np.median(distance) + 1e-12))
    good = ~outlying(distance)
    for _ in range(_MOST_REPEATS):
        found, distance = solve(good.astype(float))
        before, good = good, ~outlying(distance)
        if (before == good).all():
            break
    return found / np.where(scale > 0, scale, 1), distance, good


def both_axes(matrix: np.ndarray) -> np.ndarray:
    """Return the matrix (n, 2, 2 k) by which each axis of a position has coefficients of its own, of one of (n, k)."""
    return np.einsum("ab,nk->nabk", np.eye(2), matrix).reshape(len(matrix), 2, -1)
