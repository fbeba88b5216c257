r"""The control variate of signed rays: the mean radiance of the other half of a pixel's rays through a lens.

A coefficient w of either sign times the radiance L has much noise even where L is the same for all rays. With a mean c
of L over other, independent rays, and the known mean 1 of the coefficient, :math:`w (L - c) + c` has the same mean, and
no noise in uniform light (Owen, "Monte Carlo theory, methods and examples", section 8.9). Rays of even indices subtract
the mean of those of odd indices, and vice versa.
"""

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from ..runtime import Pair


def means_of_halves(values: list, valid: Any, count: int, rays: int) -> tuple[list[Pair], Any]:
    """Return the means of each value over the even and over the odd valid rays of `count` pixels, of `rays` rays each.

    A mask of the pixels where some value is not zero is returned, too, as derivatives may cancel in the means.
    """
    end = dr.opaque(mi.UInt32, rays)
    first = dr.arange(mi.UInt32, count) * end

    def add(k: Any, totals: list[Pair], lit: Any) -> tuple[Any, list[Pair], Any]:
        ray = [at_rays(value, first + k) for value in (valid, *values)]
        even = (k & 1) == 0
        totals = [
            (a + dr.select(even, value, 0), b + dr.select(even, 0, value))
            for (a, b), value in zip(totals, ray, strict=True)
        ]
        return k + 1, totals, lit | dr.any([value != 0 for value in ray[1:]], axis=0)

    state = mi.UInt32(0), [(mi.Float(0), mi.Float(0)) for _ in range(1 + len(values))], mi.Bool(False)
    # Loops that only add up are differentiated in reverse without their states.
    _, (counts, *sums), lit = dr.while_loop(state, lambda k, *_: k < end, add, label="halves", max_iterations=-1)
    means = [mean_of_half(pair, counts) for pair in sums]
    dr.eval(means, lit)
    return means, lit


def mean_of_half(sums: Sequence, counts: Sequence) -> Pair:
    """Return the means over each half of the rays from sums and counts; 0 without rays."""
    first, second = (dr.select(count > 0, total / count, 0) for total, count in zip(sums, counts, strict=True))
    return first, second


def of_other_half(even: Any, halves: Sequence) -> Any:
    """Return for rays of the even (first) half what belongs to the odd (second) half, and vice versa."""
    return dr.select(even, halves[1], halves[0])


def at_rays(values: Any, index: Any) -> Any:
    """Return the values of rays, no two of which are the same, so that gradients need no atomic sums."""
    return dr.gather(type(values), values, index, mode=dr.ReduceMode.NoConflicts)
