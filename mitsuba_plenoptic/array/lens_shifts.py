"""Displacements of microlenses from their regular positions: smooth ones of the array, and irregular ones."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import drjit as dr
import numpy as np

from ..runtime import Doubles, Numbers, Pair, Shape, Triple, exponents, module_of, monomials, turn

Corner = Sequence[float] | Doubles
"""X and y of a corner of a rectangle."""

MOST_DEVIATIONS = 3.0
"""Standard deviations at which deviates are clipped."""

WARP_POWERS = exponents(5, lowest=2)
"""Powers of x and y of the terms of a warp; those of a warp of lower degree are the first ones."""

_STEPS = 3
"""Steps from a position to the regular one, each of which leaves the gradient's part of the error."""

_SMALL = 1e-6
"""Step in mm of finite differences of displacements."""


class Lenslet(NamedTuple):
    """Single lenses of an array."""

    centre: Pair
    focal_length: Any  # in air, in millimetres
    height: Any = 0.0  # in mm, towards the main lens, of a tilted array
    gain: Any = 1.0  # relative brightness


@dataclass(frozen=True)
class Displacement:
    """Displacements of lenses in millimetres, by their regular positions and lattice indices.

    Positions are floats, NumPy or Dr.Jit arrays, in the camera frame.
    """

    # Coefficients of the smooth displacement along x, then along y, for as many of `WARP_POWERS`; may be empty.
    warp: Numbers = ()
    # Pairs of an image height in mm and a chief-ray angle in degrees; may be empty.
    chief_rays: Numbers = ()
    # Distance to the detector in mm, and refractive index in between, which move lenses aligned to chief rays.
    distance: Any = 0.0
    medium: float = 1.0
    # Standard deviation along each axis of irregular displacements, and their seed.
    deviation: float = 0.0
    seed: int = 0

    @property
    def is_smooth(self) -> bool:
        """Whether the lens of a position depends on smooth displacements."""
        return bool(self.warp or self.chief_rays)

    @property
    def powers(self) -> list[Shape]:
        """Powers of x and y of the terms of the warp, whose degree its number of coefficients tells."""
        return WARP_POWERS[: len(self.warp) // 2]

    def smooth(self, x: Any, y: Any) -> Pair:
        """Return the smooth displacements of lenses at regular positions."""
        right, up = self._to_chief_rays(x, y) if self.chief_rays else (0.0, 0.0)
        if self.warp:
            terms = monomials(x, y, self.powers)
            right += sum(coefficient * term for coefficient, term in zip(self.warp[: len(terms)], terms, strict=True))
            up += sum(coefficient * term for coefficient, term in zip(self.warp[len(terms) :], terms, strict=True))
        return right, up

    def regular(self, x: Any, y: Any) -> Pair:
        """Return the regular positions that smooth displacements bring to given ones."""
        before = x, y
        for _ in range(_STEPS if self.is_smooth else 0):
            right, up = self.smooth(*before)
            before = x - right, y - up
        return before

    def irregular(self, i: Any, j: Any) -> Pair:
        """Return the irregular displacements of lenses with given indices."""
        x, y, _ = deviates(self.seed, i, j)
        return self.deviation * x, self.deviation * y

    def _to_chief_rays(self, x: Any, y: Any) -> Pair:
        """Return the displacements, towards the axis, that align lenses to chief rays."""
        module = module_of(x)
        height = module.sqrt(x * x + y * y)
        angle = sum(
            math.radians(angles[1] - angles[0]) * module.clip((height - low) / (high - low), 0, 1)
            for (low, high), angles in zip(
                itertools.pairwise(self.chief_rays[::2]), itertools.pairwise(self.chief_rays[1::2]), strict=True
            )
        )
        # Snell's law at the border of the medium behind the lenses.
        sine = module.sin(angle) / self.medium
        scale = -self.distance * sine / module.sqrt(1 - sine * sine) / module.maximum(height, 1e-9)
        return scale * x, scale * y

    @property
    def farthest_irregular(self) -> float:
        """Largest irregular displacement in millimetres."""
        return math.sqrt(2) * MOST_DEVIATIONS * self.deviation

    def most_smooth(self, low: Corner, high: Corner) -> Pair:
        """Return the largest smooth displacement in a rectangle, in mm, and the largest change of one per mm."""
        # 33: Places along each axis at which displacements are compared.
        x, y = np.meshgrid(*(np.linspace(*ends, 33) for ends in zip(low, high, strict=True)))
        moved = np.array(self._moved(x, y))
        slopes = np.array([self._moved(x + _SMALL, y), self._moved(x, y + _SMALL)]) - moved
        # No singular value is larger than the root of the sum of squares.
        return float(np.hypot(*moved).max()), float(np.sqrt(((slopes / _SMALL) ** 2).sum((0, 1))).max())

    def _moved(self, x: Doubles, y: Doubles) -> list[Doubles]:
        return [value + 0 * x for value in self.smooth(x, y)]

    def turned(self, degrees: float) -> Displacement:
        """Return the smooth displacement in a frame that is turned counter-clockwise about the axis."""
        if not self.warp or not degrees:
            return self
        # As many places as there are terms determine the polynomials of the new frame.
        x, y = np.random.default_rng(0).uniform(-1, 1, (2, 2 * len(self.warp)))
        moved = turn(*replace(self, chief_rays=()).smooth(*turn(x, y, degrees)), -degrees)
        terms = np.stack(monomials(x, y, self.powers), axis=-1)
        return replace(self, warp=tuple(np.linalg.lstsq(terms, np.stack(moved, -1))[0].T.ravel().tolist()))


def deviates(seed: int, i: Any, j: Any) -> Triple:
    """Return three normal deviates, clipped at `MOST_DEVIATIONS`, for each lens of an array with a given seed."""
    start = int(_hashed(np.array([seed], np.uint32))[0])
    module = module_of(i)
    deviates = []
    # Single numbers of NumPy warn where arrays of them wrap round.
    with np.errstate(over="ignore"):
        lens = _hashed(_hashed(_words(i) ^ start) ^ _words(j))
        integers = [_hashed(lens ^ (0x9E3779B9 * (stream + 1) & 0xFFFFFFFF)) >> 9 for stream in range(6)]
    for words in zip(integers[::2], integers[1::2], strict=True):
        # Two uniform numbers make a normal one (Box and Muller 1958).
        if module is dr:
            words = tuple(dr.float32_array_t(type(word))(word) for word in words)
        first, second = ((word + 0.5) * 2.0**-23 for word in words)
        deviate = module.sqrt(-2 * module.log(first)) * module.cos(2 * math.pi * second)
        deviates.append(module.clip(deviate, -MOST_DEVIATIONS, MOST_DEVIATIONS))
    x, y, f = deviates
    return x, y, f


def _hashed(word: Any) -> Any:
    """Return 32-bit hashes of words (Wellons 2018, "Prospecting for hash functions").

    Words are NumPy or Dr.Jit arrays of unsigned integers.
    """
    kind = type(word) if dr.is_array_v(word) else np.uint32
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        word = (word ^ (word >> shift)) * kind(factor)
    return word ^ (word >> 16)


def _words(index: Any) -> Any:
    """Return indices as 32-bit integers, modulo 2^32."""
    if not dr.is_array_v(index):
        return np.asarray(index, np.int64).astype(np.uint32)
    return dr.uint32_array_t(type(index))(dr.int32_array_t(type(index))(index))
