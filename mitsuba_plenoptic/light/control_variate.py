"""The known part of signed rays: means of radiance over independent rays of the same cell and lens.

There are `spp` rays for each of `count` cells. Rays of even and of odd indices are independent, and each half is
corrected by the mean of the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from ..lenses.main_lens import Pair


def known_means(radiance: list[Any], seen: Any, count: int, spp: int) -> tuple[list[Pair], Any]:
    """Return, for each value of the radiance, its means over rays of even indices and of odd indices.

    Return also which cells have nonzero radiance: derivatives of radiance may cancel in the means.
    """
    (counts, *sums), lit = halves(seen, radiance, count, spp)
    means = [means_of(pair, counts) for pair in sums]
    dr.eval(means, lit)
    return means, lit


def means_of(sums: Sequence[Any], counts: Sequence[Any]) -> Pair:
    """Return the means over each half of the rays from their sums and counts; 0 where there is no ray."""
    first, second = (dr.select(number > 0, total / number, 0) for total, number in zip(sums, counts, strict=True))
    return first, second


def halves(seen: Any, values: list[Any], count: int, spp: int) -> tuple[list[Pair], Any]:
    """Return for each cell the sums over rays of even and of odd indices, of `seen` and of each of the values.

    Return also the mask of the cells in which any of the values is not zero.
    """
    rays = dr.opaque(mi.UInt32, spp)
    first = dr.arange(mi.UInt32, count) * rays

    def add(k: Any, totals: list[Pair], some: Any) -> tuple[Any, list[Pair], Any]:
        own = [dr.gather(mi.Float, each, first + k) for each in (seen, *values)]
        even = (k & 1) == 0
        totals = [
            (a + dr.select(even, value, 0), b + dr.select(even, 0, value))
            for (a, b), value in zip(totals, own, strict=True)
        ]
        return k + 1, totals, some | dr.any([value != 0 for value in own[1:]], axis=0)

    state = mi.UInt32(0), [(mi.Float(0), mi.Float(0)) for _ in range(1 + len(values))], mi.Bool(False)
    _, totals, some = dr.while_loop(state, lambda k, *_: k < rays, add, label="halves")
    return totals, some
