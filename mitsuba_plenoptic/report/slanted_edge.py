"""Sharpness from the picture of a slanted edge, after ISO 12233."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass

import numpy as np

# Samples of the edge's profile per pixel, as in the standard.
_OVERSAMPLING = 4

# Widths of the windows in which the edge's line is looked for, one after the other, over that of the image.
_WINDOWS = (1.0, 0.7, 0.5, 0.35, 0.25)


@dataclass(frozen=True)
class EdgeSharpness:
    """How sharp edges are.

    Attributes
    ----------
    width : float
        Distance in pixels from 10 to 90 per cent of the edge's height.
    mtf50 : float
        Frequency in cycles per pixel at which the modulation transfer function falls to one half.
    """

    width: float
    mtf50: float


def edge_sharpness(image: np.ndarray) -> EdgeSharpness:
    """Measure an edge that runs from top to bottom through the image, a few degrees off the vertical.

    Parameters
    ----------
    image : (rows, columns) array
        A window with dark on one side and bright on the other.

    Raises
    ------
    ValueError
        If it holds no such edge.
    """
    image = np.asarray(image, np.float64)
    position, profile = _profile(image)
    low, high = np.mean(profile[:_OVERSAMPLING]), np.mean(profile[-_OVERSAMPLING:])
    if not abs(high - low) > 0.1 * np.abs(profile).max():
        raise ValueError("no edge: both sides are alike")
    step = (profile - low) / (high - low)
    width = _first_crossing(position, step, 0.9) - _first_crossing(position, step, 0.1)

    spread = np.gradient(step) * np.hamming(step.size)
    transfer = np.abs(np.fft.rfft(spread, 16 * spread.size))
    frequency = np.fft.rfftfreq(16 * spread.size, 1 / _OVERSAMPLING)
    # The central difference's own transfer function.
    transfer[1:] /= np.sinc(2 * frequency[1:] / _OVERSAMPLING).clip(min=0.1)
    mtf50 = _first_crossing(frequency, 1 - transfer / transfer[0], 0.5)
    return EdgeSharpness(width=float(width), mtf50=float(mtf50))


def square_sharpness(image: np.ndarray, row: float, column: float, side: float) -> EdgeSharpness:
    """Measure a bright square on dark ground, turned by a few degrees: the median of its four edges.

    The median, because something else may lie near one of them.

    Parameters
    ----------
    image : (rows, columns) array
        The image.
    row, column : float
        The square's centre in pixels from the image's corner.
    side : float
        Its side in pixels.

    Raises
    ------
    ValueError
        If an edge is not in the image.
    """
    # As far along an edge as its slant leaves the corners alone, and halfway to the square's middle across it.
    reach = round(0.3 * side)
    found = []
    for view, r, c in ((image, row, column), (image.T, column, row)):
        for sign in (-1, 1):
            middle = round(c + sign * side / 2)
            first, left = round(r) - reach, middle - reach
            if min(first, left) < 0 or first + 2 * reach > view.shape[0] or left + 2 * reach > view.shape[1]:
                raise ValueError("no edge: it is not in view")
            found.append(edge_sharpness(view[first : first + 2 * reach, left : left + 2 * reach]))
    return EdgeSharpness(
        width=statistics.median(edge.width for edge in found), mtf50=statistics.median(edge.mtf50 for edge in found)
    )


def _profile(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project the pixels along the edge: distances from it and the mean values there."""
    rows, columns = image.shape
    slope = np.abs(np.gradient(image, axis=1))
    tilt, start = 0.0, (columns - 1) / 2
    # Noise beside the edge has slopes, too: the window closes in on the line that was found before.
    for part in _WINDOWS:
        offset = np.arange(columns) - (start + tilt * np.arange(rows))[:, None]
        weight = slope * np.cos(math.pi * np.clip(offset / (part * columns), -0.5, 0.5)) ** 2
        centres = (weight * np.arange(columns)).sum(axis=1) / weight.sum(axis=1).clip(min=1e-30)
        tilt, start = np.polyfit(np.arange(rows), centres, 1)
    distance = (np.arange(columns) - (start + tilt * np.arange(rows))[:, None]) / math.hypot(1, tilt)
    # Only distances that every row has.
    reach = math.floor(min(-distance[:, 0].max(), distance[:, -1].min()) * _OVERSAMPLING)
    if reach < 2 * _OVERSAMPLING:
        raise ValueError("no edge: it does not run from top to bottom")
    index = np.round(distance * _OVERSAMPLING).astype(int) + reach
    inside = (index >= 0) & (index <= 2 * reach)
    count = np.bincount(index[inside], minlength=2 * reach + 1)
    total = np.bincount(index[inside], weights=image[inside], minlength=2 * reach + 1)
    position = (np.arange(2 * reach + 1) - reach) / _OVERSAMPLING
    filled = count > 0
    return position, np.interp(position, position[filled], total[filled] / count[filled])


def _first_crossing(position: np.ndarray, rising: np.ndarray, level: float) -> float:
    """Where a curve first reaches a level, by linear interpolation; infinity if nowhere."""
    above = np.flatnonzero(rising >= level)
    if above.size == 0:
        return math.inf
    i = int(above[0])
    if i == 0:
        return float(position[0])
    part = (level - rising[i - 1]) / (rising[i] - rising[i - 1])
    return float(position[i - 1] + part * (position[i] - position[i - 1]))
