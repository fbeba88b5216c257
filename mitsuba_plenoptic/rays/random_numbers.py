"""Random numbers of rays: evenly spread sequences, and 16-bit words."""

import functools
from typing import Any

import mitsuba as mi
import numpy as np

from ..runtime import Doubles, Sizes

_ROUNDS = 5
"""Rounds of the cipher of `mi.sample_tea_32`: after its default of four the first word is not yet even, and numbers of
neighbouring lanes depend on one another."""


@functools.cache
def even_steps(dimensions: int) -> Doubles:
    """Return the steps (dimensions,) of an additive sequence that fills the unit cube evenly, modulo 1.

    The steps are powers of the reciprocal of the root of x^(d + 1) = x + 1, which in one dimension is the golden ratio
    (Roberts 2018, "The unreasonable effectiveness of quasirandom sequences").
    """
    root = 2.0
    for _ in range(64):
        root = (1 + root) ** (1 / (dimensions + 1))
    return root ** -np.arange(1.0, dimensions + 1)


def even_words(dimensions: int) -> Sizes:
    """Return the `even_steps` as integers in units of 2^-32, with which a sequence stays exact at any index."""
    return tuple(int(step * 2**32) for step in even_steps(dimensions).tolist())


def low_discrepancy(lane: Any, key: Any, index: Any, dimensions: int) -> list:
    """Return the numbers from 0 to 1, of 24 bits, at an index of a sequence that fills the unit cube evenly.

    Sequences are displaced at random, by the lane and the key, modulo 1.
    """
    words = [word for pair in range(-(-dimensions // 2)) for word in mi.sample_tea_32(lane, key ^ (1 + pair), _ROUNDS)]
    shifted = (word + index * step for word, step in zip(words, even_words(dimensions), strict=False))
    return [mi.Float(word >> 8) * 2.0**-24 for word in shifted]


def chances_of(lane: Any, key: Any) -> tuple[Any, Any, Any, Any]:
    """Return four random numbers from 0 to 1, of 16 bits each."""
    words = mi.sample_tea_32(lane, key, _ROUNDS)
    low = [mi.Float(word & 0xFFFF) * 2.0**-16 for word in words]
    high = [mi.Float(word >> 16) * 2.0**-16 for word in words]
    return low[0], low[1], high[0], high[1]
