"""Mirror images of patterns: a lens that is its own mirror image needs only some of the directions of the rim."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_ALIKE = 1e-2
"""Relative difference up to which two windows are the same: their samples cut edges differently."""


@dataclass(frozen=True)
class Mirror:
    """A change of axes: first x and y are exchanged, then each is turned round; sample 0 of an even number stays."""

    exchange: bool
    turn_x: bool
    turn_y: bool

    def angle(self, angle: float) -> float:
        """Return where a direction goes."""
        x, y = math.cos(angle), math.sin(angle)
        if self.exchange:
            x, y = y, x
        return math.atan2(-y if self.turn_y else y, -x if self.turn_x else x)

    def apply(self, patterns: NDArray[Any], *, inverse: bool = False) -> NDArray[Any]:
        """Change patterns, (..., rows, columns)."""
        if self.exchange and not inverse:
            patterns = patterns.swapaxes(-1, -2)
        for axis, turned in ((-1, self.turn_x), (-2, self.turn_y)):
            if turned:
                patterns = np.roll(np.flip(patterns, axis), 1, axis)
        return patterns.swapaxes(-1, -2) if self.exchange and inverse else patterns


def mirrors_of(windows: NDArray[np.complex64]) -> list[Mirror]:
    """Find the changes of axes that leave windows, (..., rows, columns), as they are; the first changes nothing."""
    limit = _ALIKE * float(np.linalg.norm(windows))
    every = (Mirror(*signs) for signs in itertools.product((False, True), repeat=3))
    return [mirror for mirror in every if np.linalg.norm(mirror.apply(windows) - windows) <= limit]


def orbits(angles: int, mirrors: list[Mirror]) -> dict[int, list[tuple[int, Mirror]]]:
    """Return for some of equally spaced directions which others, each once, they become by which mirrors."""
    found: dict[int, list[tuple[int, Mirror]]] = {}
    left = set(range(angles))
    for first in range(angles):
        if first in left:
            found[first] = []
            for mirror in mirrors:
                place = mirror.angle(2 * math.pi * first / angles) * angles / (2 * math.pi)
                other = round(place) % angles
                if other in left and abs(place - round(place)) < 1e-6:
                    found[first].append((other, mirror))
                    left.discard(other)
    return found
