"""Apertures of ordinary cameras, as parameters and as functions of the pupil that are written here again."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

Mask = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Power that passes at coordinates over the pupil's radius."""


def picture(values: np.ndarray) -> tuple[dict[str, Any], Mask]:
    """Return an aperture of square cells, in rows of rising y and columns of rising x."""
    count = len(values)

    def power(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        column, row = (np.clip(((place + 1) / 2 * count).astype(int), 0, count - 1) for place in (x, y))
        return np.asarray(values[row, column] * (np.hypot(x, y) <= 1))

    return {"aperture_image": values}, power


def polygon(count: int, angle: float = 15.0) -> tuple[dict[str, Any], Mask]:
    """Return an aperture of blades, by the distances of its sides from the centre."""
    normals = math.radians(angle) + (np.arange(count) + 0.5) * 2 * math.pi / count

    def power(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        inside = [x * math.cos(each) + y * math.sin(each) <= math.cos(math.pi / count) for each in normals]
        return np.all(inside, axis=0).astype(float)

    return {"aperture_blades": (count, angle)}, power


def _within(count: int, limit: float = 1.0) -> np.ndarray:
    """Return which cells have their centres within a part of the circle."""
    centres = (2 * np.arange(count) + 1) / count - 1
    return np.asarray(np.hypot(centres, centres[:, None]) <= limit)


def _random(count: int, chance: float, seed: int) -> np.ndarray:
    """Return cells that are open at random."""
    return (np.random.default_rng(seed).random((count, count)) < chance) * _within(count) * 1.0


def _some(count: int, number: int, seed: int) -> np.ndarray:
    """Return a number of open cells at random places."""
    values = np.zeros(count * count)
    values[np.random.default_rng(seed).permutation(np.flatnonzero(_within(count)))[:number]] = 1
    return values.reshape(count, count)


def _grey(count: int, seed: int) -> np.ndarray:
    """Return cells of random values, which files keep to four decimals."""
    return np.asarray(np.random.default_rng(seed).random((count, count)).round(4) * _within(count))


def _at(count: int, *cells: tuple[int, int]) -> np.ndarray:
    """Return cells of which some, by row and column, are open."""
    values = np.zeros((count, count))
    values[tuple(np.transpose(cells))] = 1
    return values


def _hole(count: int, x: float, y: float, radius: float) -> np.ndarray:
    """Return a round hole of small cells."""
    centres = (2 * np.arange(count) + 1) / count - 1
    return (np.hypot(centres - x, centres[:, None] - y) < radius) * 1.0


APERTURES = {
    "5 blades": polygon(5),
    "6 blades": polygon(6),
    "9 blades": polygon(9),
    "7 x 7": picture(_random(7, 0.5, 2)),
    "11 x 11": picture(_random(11, 0.5, 3)),
    "11 x 11 with 33 open": picture(_some(11, 33, 5)),
    "33 x 33 with 33 open": picture(_some(33, 33, 7)),
    "two holes": picture(_at(9, (4, 1), (4, 7))),
    "slit": picture(_at(9, *((row, 4) for row in range(1, 8)))),
    "annulus": picture((_within(63) & ~_within(63, 0.7)) * 1.0),
    "hole off centre": picture(_hole(63, 0.5, 0.3, 0.3)),
    "grey": picture(_grey(9, 4)),
}
"""Parameters of the camera, and the same as a function, by name."""
