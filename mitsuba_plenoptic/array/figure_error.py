"""Figure errors of microlens arrays: random optical paths over the whole array."""

import functools
import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ..runtime import Doubles, Pair, drjit_array, module_of

COSINES = 32
"""Cosines of a figure error: more cost time, fewer show in its statistics."""


@dataclass(frozen=True, eq=False)
class FigureError:
    r"""Figure error of one array: a random optical path of given size and correlation length over the whole array.

    The path is a sum of cosines of random directions, periods and phases,

    .. math:: W(x, y) = \sigma \sqrt{2 / K} \sum_{k=1}^{K} \cos(2 \pi (u_k x + v_k y) + \varphi_k),

    whose frequencies are normally distributed with the standard deviation :math:`1 / 2 \pi l`. Over all seeds the root
    mean square is :math:`\sigma`, and the correlation of points at a distance d is :math:`\exp(-d^2 / 2 l^2)`. The path
    depends on position and seed only, and has slopes everywhere.
    """

    amplitude: float  # of each cosine, in millimetres
    frequencies: Doubles  # (2, cosines), in 1/mm
    phases: Doubles  # in periods

    def path(self, x: Any, y: Any) -> Any:
        """Return the path in millimetres at positions on the array, NumPy or Dr.Jit arrays."""
        return self.amplitude * sum(cosine for cosine, _, _, _ in self._waves(x, y))

    def slopes(self, x: Any, y: Any) -> Pair:
        """Return the gradient of the path at positions, in millimetres per millimetre."""
        across = 0.0
        up = 0.0
        for _, sine, u, v in self._waves(x, y):
            across = across - sine * u
            up = up - sine * v
        scale = 2 * math.pi * self.amplitude
        return scale * across, scale * up

    def _waves(self, x: Any, y: Any) -> list[tuple[Any, Any, Any, Any]]:
        """Return cosine and sine of each wave, and its frequencies along x and y."""
        module = module_of(x)
        rows = [*self.frequencies, self.phases]
        if module is dr:
            # In tables, other numbers need no other kernel.
            tables = [drjit_array(type(x), row) for row in rows]
            rows = [[dr.gather(type(x), table, k) for k in range(len(self.phases))] for table in tables]
        cosines = []
        for u, v, phase in zip(*rows, strict=True):
            turns = u * x + v * y + phase
            turns = 2 * math.pi * (turns - module.floor(turns))
            cosines.append((module.cos(turns), module.sin(turns), u, v))
        return cosines


@functools.lru_cache(maxsize=4)
def random_figure_error(size: float, length: float, seed: int) -> FigureError:
    """Return a figure error of some size and correlation length in millimetres, from a seed."""
    random = np.random.default_rng([seed, COSINES])
    frequencies = random.normal(0, 1 / (2 * math.pi * length), (2, COSINES))
    return FigureError(size * math.sqrt(2 / COSINES), frequencies, random.random(COSINES))
