"""Textures and surroundings, as functions of the place (u, v) in the picture."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from .images import Colour
from .mesh import Array, Point


def ramp(dark: Colour, light: Colour) -> list[Colour]:
    """Sixteen colours from dark to light."""
    return [tuple(round(a + (b - a) * i / 15) for a, b in zip(dark, light, strict=True)) for i in range(16)]


def average(shade: Callable[[Array, Array], Array], rows: int, columns: int) -> Array:
    """Average a function of (u, v) in [0, 1) over each pixel; the first row is at v = 0, as Mitsuba reads bitmaps."""
    v, u = (np.indices((4 * rows, 4 * columns)) + 0.5) / np.array([4 * rows, 4 * columns])[:, None, None]
    image = shade(u, v)
    return image.reshape(rows, 4, columns, 4, *image.shape[2:]).mean(axis=(1, 3))


def levels(shade: Callable[[Array, Array], Array], rows: int, columns: int) -> NDArray[np.uint8]:
    """Return the averages as 4-bit levels."""
    # The small offset keeps exact halves from rounding differently.
    return np.floor(np.clip(average(shade, rows, columns), 0, 1) * 15 + 0.500001).astype(np.uint8)


def waves(u: Array, v: Array) -> Array:
    """One period of the Japanese wave pattern: overlapping discs of concentric rings, in rows."""
    # Discs of radius 1/2, one apart; rows 1/4 apart, every other one shifted by 1/2.
    value = np.zeros_like(u)
    # Rows from the top down: each disc hides those of the row above it.
    for row, column in itertools.product(range(5, -3, -1), range(-1, 3)):
        r = np.hypot(u - (column + 0.5 * (row % 2)), v - 0.25 * row)
        value = np.where(r < 0.5, np.where((r * 10) % 2 < 1, 0.0, 1.0), value)
    return value


def wood(u: Array, v: Array) -> Array:
    """Planks along v, with grain made of a few sines, each plank its own."""
    plank = np.floor(u * 6)
    across = u * 6 - plank
    phase = 2.399 * plank + 0.7 * plank**2
    bend = 0.35 * np.sin(2 * math.pi * v * 2 + phase) + 0.18 * np.sin(2 * math.pi * v * 5 + 2.3 * phase)
    grain = across * 5 + bend + 1.5 * np.sin(phase)
    rings = 0.5 + 0.5 * np.sin(2 * math.pi * grain + 1.2 * np.sin(2 * math.pi * grain * 0.37 + phase))
    fine = 0.5 + 0.5 * np.sin(2 * math.pi * (grain * 4.3 + 3 * np.sin(2 * math.pi * v * 3 + phase)))
    tone = 0.55 + 0.2 * np.sin(1.9 * plank + 0.4)
    gap = (across < 0.018) | (across > 0.982)
    return np.where(gap, 0.0, tone + 0.28 * (rings - 0.5) + 0.1 * (fine - 0.5))


def die(u: Array, v: Array) -> Array:
    """Return the six faces of a die, 3 x 2; opposite faces add up to seven."""
    near, far, middle = 0.27, 0.73, 0.5
    centre, diagonal = [(middle, middle)], [(near, far), (far, near)]
    corners = [*diagonal, (near, near), (far, far)]
    faces = (
        [*corners, *centre],
        diagonal,
        [*corners, (near, middle), (far, middle)],
        centre,
        [*diagonal, *centre],
        corners,
    )
    value = np.ones_like(u)
    for k, face in enumerate(faces):
        for x, y in face:
            value[np.hypot(u * 3 - k % 3 - x, v * 2 - k // 3 - y) < 0.105] = 0.0
    return value


def stripes(u: Array, v: Array) -> Array:
    """Twisted stripes and two plain caps, for a glazed ball (u around, v from pole to pole)."""
    swirl = u * 8 + 1.4 * np.sin(2 * math.pi * (v - 0.5))
    return np.where((swirl % 1 < 0.5) | (v < 0.1) | (v > 0.9), 1.0, 0.0)


def tiles(u: Array, v: Array) -> Array:
    """Four stone tiles, two dark and two light, with veins and dark joints."""
    dark = (np.floor(2 * u) + np.floor(2 * v)) % 2
    x, y = 2 * math.pi * u, 2 * math.pi * v
    bend = np.sin(x + 1.7 * np.sin(2 * y) + 0.8 * np.sin(3 * x + y))
    veins = np.exp(-((bend + 0.6 * np.sin(2 * y - x + 1.1 * np.sin(2 * x))) ** 2) / 0.01)
    cloud = 0.06 * np.sin(3 * x + 2 * y + np.sin(4 * y)) + 0.04 * np.sin(5 * y - 4 * x)
    value = np.where(dark == 1, 0.24 + cloud + 0.3 * veins, 0.86 + cloud - 0.3 * veins)
    return np.where(np.minimum((2 * u) % 1, (2 * v) % 1) < 0.02, 0.05, value)


def _leaf(u: Array, v: Array) -> tuple[Array, Array]:
    """Return how far points are inside a leaf's outline, over its half-width, and how far from its veins."""
    side = np.abs(u - 0.5 - 0.04 * np.sin(5 * v))
    width = 0.47 * np.sin(math.pi * np.clip((v - 0.14) / 0.84, 0, 1) ** 0.72) ** 0.85
    width = width * (1 - 0.07 * ((11 * v - 2.5 * side) % 1))
    inside = np.where(v < 0.18, 0.016 - side, width - side)
    twigs = np.abs((9 * (v - 0.9 * side)) % 1 - 0.5) / 9
    return inside, np.minimum(side / 0.6, np.where(side < 0.9 * width, twigs, 1))


def leaf(u: Array, v: Array) -> Array:
    """Return a leaf with light veins."""
    _, vein = _leaf(u, 1 - v)
    return 0.3 + 0.12 * np.sin(9 * u + 7 * v) + 0.6 * np.exp(-((vein / 0.012) ** 2))


def leaf_mask(u: Array, v: Array) -> Array:
    """Return where the leaf is opaque: within its outline, but for two holes."""
    inside, _ = _leaf(u, 1 - v)
    holes = (np.hypot(u - 0.34, v - 0.42) > 0.055) & (np.hypot(u - 0.62, 0.8 * (v - 0.6)) > 0.04)
    return np.where((inside > 0) & holes, 1.0, 0.0)


def surroundings(u: Array, v: Array) -> Array:
    """Return radiances from all directions: a sky over dark hills, a window, a strip of light.

    Rows run from the zenith down and columns around, as Mitsuba's ``envmap`` reads them; what a camera that looks
    along +z sees is in the middle.
    """
    x = np.sin(2 * math.pi * u) * np.sin(math.pi * v)
    y, z = np.cos(math.pi * v), -np.cos(2 * math.pi * u) * np.sin(math.pi * v)

    def mix(a: Sequence[float], b: Sequence[float], t: Array) -> Array:
        return np.array(a) + (np.array(b) - np.array(a)) * np.clip(t, 0, 1)[..., None]

    image = mix((0.66, 0.7, 0.76), (0.2, 0.34, 0.62), 2 * y)
    around = 2 * math.pi * u
    # None straight ahead, where the sky is seen above the ground.
    hills = (0.14 + 0.05 * np.sin(5 * around) + 0.03 * np.sin(13 * around + 1)) * np.clip(0.8 - z, 0, 1)
    image = np.where((y < hills)[..., None], mix((0.1, 0.14, 0.06), (0.2, 0.26, 0.12), 7 * y), image)
    image = np.where((y < 0)[..., None], mix((0.3, 0.25, 0.2), (0.12, 0.1, 0.09), -3 * y), image)

    def panel(towards: Sequence[float], half: Point, panes: tuple[int, int], radiance: Sequence[float]) -> None:
        """Put a bright rectangle with bars between its panes before what is there."""
        middle = np.array(towards) / np.linalg.norm(towards)
        right = np.cross(middle, [0, 1, 0])
        right /= np.linalg.norm(right)
        up = np.cross(right, middle)
        depth = x * middle[0] + y * middle[1] + z * middle[2]
        a, b = (
            (x * axis[0] + y * axis[1] + z * axis[2]) / np.maximum(depth, 1e-3) / size
            for axis, size in ((right, half[0]), (up, half[1]))
        )
        inside = (depth > 0) & (np.abs(a) < 1) & (np.abs(b) < 1)
        for place, count in ((a, panes[0]), (b, panes[1])):
            part = ((place + 1) / 2 * count) % 1
            inside &= (part > 0.06) & (part < 0.94)
        image[inside] = radiance

    panel((0.75, 0.75, -0.6), (0.42, 0.55), (2, 3), (5.2, 5.4, 5.8))
    panel((-0.7, 0.8, 0.3), (0.12, 0.6), (1, 1), (6.0, 4.8, 3.4))
    return image
