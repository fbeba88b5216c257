"""Polynomials of two variables: the powers of their terms, by rising degree, and the terms' values."""

from collections.abc import Sequence
from typing import Any

import numpy as np


def exponents(degree: int, lowest: int = 0) -> list[tuple[int, int]]:
    """Return the powers (i, j) of both variables for all terms of the degrees from `lowest` to `degree`."""
    return [(total - j, j) for total in range(lowest, degree + 1) for j in range(total + 1)]


def monomials(u: Any, v: Any, pairs: Sequence[tuple[int, int]]) -> list:
    """Return the terms u^i v^j of floats, NumPy or Dr.Jit arrays; among Dr.Jit arrays that of degree 0 is a number."""
    unit = np.ones_like(u) if isinstance(u, np.ndarray) else 1.0
    powers = [[unit, u], [unit, v]]
    for series in powers:
        while len(series) <= max(map(sum, pairs), default=0):
            series.append(series[-1] * series[1])
    return [powers[0][i] * powers[1][j] for i, j in pairs]
