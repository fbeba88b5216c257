"""Mean light of cells of rays, which straight edges divide."""

import functools
import itertools
import math
from typing import Any

import drjit as dr
import numpy as np

from ..array import Lattice
from ..runtime import Pair, Shape

_ASIDE = math.sqrt(0.15)
STAR = _ASIDE * np.vstack([np.zeros(4), *([-axis, axis] for axis in np.eye(4))])
"""Offsets of rays from the middle of a cell, over its widths: along each axis Gauss's quadrature with three points."""


def lens_cells(lattice: Lattice, wide: float) -> Shape:
    """Return how many cells along both sides of `Lattice.aperture_point` are about `wide` along a lens."""
    if lattice.aperture == "circle":
        return math.ceil(wide) or 1, max(3, math.ceil(3 * wide))
    # Cells of lenses are squares, or three rhombi one after the other.
    sectors = 1 if lattice.rectangular else 3
    side = math.ceil(wide / math.sqrt(sectors)) or 1
    return sectors * side, side


def light_of_cells(rays: list[Pair]) -> Any:
    """Return the mean light of cells, of which the side of a straight edge counts that is inside.

    Distance and light of the rays of `STAR` are linear over a cell, up to curvatures, which change their means. The
    distance is a sum of four evenly distributed numbers, whose chance to be positive is an alternating sum of powers.
    """
    (distance, widths), (power, rises) = (
        (
            middle + sum(end - middle for end in ends) / (24 * _ASIDE**2),
            [(high - low) / (2 * _ASIDE) for low, high in zip(ends[::2], ends[1::2], strict=True)],
        )
        for middle, *ends in zip(*rays[: len(STAR)], strict=True)
    )
    slope = sum(a * b for a, b in zip(widths, rises, strict=True)) / dr.maximum(sum(a * a for a in widths), 1e-30)
    if len(rays) > len(STAR):
        slope = 0.0
        power = rays[-1][1]
    kind = dr.float64_array_t(type(distance))
    widths = [dr.abs(width) for width in widths]
    # Of narrower ones rounding is more than they change.
    least = dr.maximum(0.02 * functools.reduce(dr.maximum, widths), 1e-9)
    widths = [kind(dr.maximum(width, least)) for width in widths]
    distance = dr.clip(kind(distance), -sum(widths) / 2, sum(widths) / 2)
    part = kind(0)
    above = kind(0)
    for signs in itertools.product((-0.5, 0.5), repeat=4):
        end = dr.maximum(distance + sum(sign * width for sign, width in zip(signs, widths, strict=True)), 0)
        term = math.prod(signs) * dr.square(dr.square(end))
        part += term
        above += term * end
    volume = 1.5 * math.prod(widths)
    # Mean of the light times whether it is inside, and of the distance where it is.
    return dr.maximum(power * part + slope * (above / 5 - distance * part), 0) / volume
