"""The sharpness of an image from one slanted edge: its position, its spread, and the transfer function.

`edge_sharpness` looks for the edge; `window_sharpness` and `square_sharpness` are told where it is.
"""

import math
import statistics
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter

from ..errors import refuse_if, refusing
from ..runtime import Doubles, Pair, as_array

_REACH = 16
"""Pixels on each side of an edge, at most, that are looked at."""

_LEAST_REACH = 5

_KNOTS = 4
"""Knots of the profile of a narrow edge in a pixel; of a wide one as many in its half width as at `_LEAST_REACH`."""

_TWO_EDGES = "image: it has two edges or more; cut out the one to measure"

_FREQUENCIES = np.linspace(0, 1, 129)
"""Frequencies in cycles per pixel."""


@dataclass(frozen=True)
class EdgeSharpness:
    """Sharpness of an edge: position, angle, width and modulation transfer function.

    Attributes
    ----------
    row, column : float
        Middle of the edge in pixels from the first pixel's centre.
    angle : float
        Angle in degrees from the columns, or from the rows of an edge that is nearer to these.
    upright : bool
        Whether the edge is nearer to the columns.
    length : int
        Number of rows used; of columns, for an edge that is nearer to the rows.
    width : float
        Distance in pixels from 10 to 90 per cent of the edge's height.
    frequency, transfer : ndarray
        Modulation transfer function across the edge, pixels included, at frequencies in cycles per pixel up to 1.
        Beyond one half, the sampling limit of the image, it rests on the slant of the edge.
    """

    row: float
    column: float
    angle: float
    upright: bool
    length: int
    width: float
    frequency: Doubles
    transfer: Doubles

    @property
    def mtf50(self) -> float:
        """Frequency in cycles per pixel at which the transfer function first falls to one half; infinity if nowhere."""
        return self.falls_to(0.5)

    def at(self, frequency: float) -> float:
        """Return the transfer function at a frequency in cycles per pixel."""
        return float(np.interp(frequency, self.frequency, self.transfer))

    def falls_to(self, level: float) -> float:
        """Return the frequency in cycles per pixel at which the transfer function first falls to a level."""
        below = np.flatnonzero(self.transfer < level)
        if not below.size:
            return math.inf
        pair = [int(below[0]), int(below[0]) - 1]
        return float(np.interp(level, self.transfer[pair], self.frequency[pair]))


def edge_sharpness(image: ArrayLike) -> EdgeSharpness:
    """Return the modulation transfer function from one slanted edge anywhere in an image.

    The edge's line is found first. All pixels near it sample one profile, as each has another distance from the line;
    the transfer function is the Fourier transform of the profile's derivative.

    Parameters
    ----------
    image : (rows, columns) or (rows, columns, channels) array
        Values proportional to light, of which channels are averaged, with one edge that is slanted by 1 to 20 degrees
        and not saturated. Borders that are NaN are left out.

    Returns
    -------
    EdgeSharpness
        Place and angle of the edge, its width, and the transfer function.

    Examples
    --------
    >>> import numpy as np
    >>> import mitsuba_plenoptic as mp
    >>> rows, columns = np.mgrid[:64, :64]
    >>> edge = mp.edge_sharpness(1 / (1 + np.exp(-(columns - 30 - 0.1 * rows))))
    >>> round(edge.angle, 1), edge.upright
    (5.7, True)
    """
    pixels = as_array("image", image)
    if pixels.ndim == 3:
        pixels = pixels.mean(axis=2)
    refuse_if(pixels.ndim != 2, f"image of shape {pixels.shape}: it must have rows and columns")
    finite = np.isfinite(pixels)
    rows, columns = (np.flatnonzero(finite.mean(axis=1 - axis) > 0.5) for axis in (0, 1))
    refuse_if(min(rows.size, columns.size) < 2 * _LEAST_REACH, "image: it has no edge: it is too small")
    inside = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    refuse_if(not finite[inside].all(), "image: it has unknown values (NaN) within; cut out the edge")
    cut = pixels[inside]
    down, across = _slopes(cut)
    upright = bool((across**4).sum() >= (down**4).sum())
    sharpness = _measure(cut if upright else cut.T)
    row, column = (sharpness.row, sharpness.column) if upright else (sharpness.column, sharpness.row)
    return replace(sharpness, row=row + float(rows[0]), column=column + float(columns[0]), upright=upright)


def _slopes(image: Doubles, smooth: float = 1.0) -> Pair:
    """Return the derivatives, downwards and across, of the slightly smoothed image."""
    down, across = (gaussian_filter(image, smooth, order=order, mode="nearest") for order in ((1, 0), (0, 1)))
    return down, across


def _measure(image: Doubles) -> EdgeSharpness:
    """Return the sharpness of an edge that is closer to vertical than to horizontal."""
    extent = float(_LEAST_REACH)
    # Again for a wide edge, with the smoothing that it bears.
    for _ in range(2):
        down, across = _slopes(image, extent / _LEAST_REACH)
        slope = np.hypot(down, across)
        tilt, start = _line(image, slope, down, across, extent)
        index = _rows_with_edge(image, slope, tilt, start)
        line = np.asarray(start + tilt * index, np.float64)
        extent = max(extent, _half_width(across[index], line))
    angle = math.degrees(math.atan(tilt))
    offset = np.abs(np.arange(image.shape[1]) - line[:, None]) / math.hypot(1, tilt)
    height = np.median(np.max(slope[index] * (offset < 3), axis=1))
    # What crosses the edge is in few rows.
    away = slope[index] * (offset >= extent + 1)
    beside = np.quantile(np.max(away * (offset <= _REACH), axis=1), 0.95)
    wide = np.median(np.max(away, axis=1))
    refuse_if(height <= 0, "image: it has no edge: all of it is alike")
    refuse_if(max(beside, wide) > 0.3 * height, _TWO_EDGES)
    # Between these angles the pixels sample an edge finely and evenly.
    refuse_if(
        not 1.0 <= abs(angle) <= 20.0,
        f"image: its edge is turned by {abs(angle):.1f} degrees from the pixels: it must be 1 to 20",
    )
    # Without a whole pixel of slant, some distances from the line have no pixel.
    refuse_if(
        index.size * abs(tilt) < 1,
        f"image: its edge is {index.size} pixels long: turned by {abs(angle):.2g} degrees it needs "
        f"{math.ceil(1 / abs(tilt))}",
    )
    reach = min(max(float(_REACH), 2 * extent), line.min(), image.shape[1] - 1 - line.max()) * math.cos(math.atan(tilt))
    least = _LEAST_REACH if extent == _LEAST_REACH else 1.3 * extent
    refuse_if(reach < least, f"image: its edge is nearer than {least:.3g} pixels to the border")
    return _across(image[index], line, tilt, int(index[0]), reach, _KNOTS * _LEAST_REACH / extent, 2 * extent)


def window_sharpness(image: Doubles) -> EdgeSharpness:
    """Return the sharpness of a nearly vertical edge that runs from top to bottom through the middle of an image.

    As the edge is known to be there, interference beside it is allowed, and a window of few pixels suffices.
    """
    image = as_array("image", image)
    rows, columns = image.shape
    _, across = _slopes(image)
    windows = np.array((1.0, 0.7, 0.5, 0.35, 0.25)) * columns / 2
    tilt, start = _closed_in(np.abs(across), 0.0, (columns - 1) / 2, windows)
    line = np.asarray(start + tilt * np.arange(rows), np.float64)
    reach = min(line.min(), columns - 1 - line.max()) * math.cos(math.atan(tilt))
    refuse_if(reach < 2, "image: it has no edge that runs from top to bottom")
    # Few rows hardly sample an edge finer than by pixels.
    return _across(image, line, tilt, 0, reach, _KNOTS * min(1.0, max(rows * abs(tilt), 1 / _KNOTS)))


def square_sharpness(image: Doubles, row: float, column: float, side: float) -> Pair:
    """Return width and mtf50 of a slightly turned bright square on dark ground: the medians of its four edges.

    The median is used because another object may lie near one of the edges.
    """
    # As far along an edge as its slant leaves the corners alone, and halfway to the square's middle across it.
    reach = round(0.3 * side)
    edges = []
    for turned, down, across in ((image, row, column), (image.T, column, row)):
        for sign in (-1, 1):
            top = round(down) - reach
            left = round(across + sign * side / 2) - reach
            refuse_if(
                min(top, left) < 0 or top + 2 * reach > turned.shape[0] or left + 2 * reach > turned.shape[1],
                "image: the edge of the square is not in view",
            )
            edges.append(window_sharpness(turned[top : top + 2 * reach, left : left + 2 * reach]))
    return statistics.median(edge.width for edge in edges), statistics.median(edge.mtf50 for edge in edges)


def _across(
    image: Doubles, line: Doubles, tilt: float, first: int, reach: float, knots: float, foot: float = math.inf
) -> EdgeSharpness:
    """Return the sharpness of an edge along a line with a column in each row, of which the first has an index."""
    distance = (np.arange(image.shape[1]) - line[:, None]) / math.hypot(1, tilt)
    width, transfer = _transfer(distance.ravel(), image.ravel(), reach, knots, foot)
    return EdgeSharpness(
        row=first + (len(line) - 1) / 2,
        column=float(line[0] + line[-1]) / 2,
        angle=math.degrees(math.atan(tilt)),
        upright=True,
        length=len(line),
        width=width,
        frequency=_FREQUENCIES,
        transfer=transfer,
    )


def _line(image: Doubles, slope: Doubles, down: Doubles, across: Doubles, extent: float) -> Pair:
    """Return slope and start of the line column = start + slope * row along the strongest edge."""
    rows, columns = np.indices(image.shape)
    down_over_across = np.divide(down, across, out=np.full_like(across, np.inf), where=across != 0)
    steep = slope**2 * (np.abs(down_over_across) < 0.7)
    refuse_if(
        not steep.sum() > 0 or np.ptp(image) <= 0.1 * np.abs(image).max(), "image: it has no edge: all of it is alike"
    )
    lines = []
    for tilt in np.linspace(-0.6, 0.6, 121):
        offset = columns - tilt * rows
        sums = np.bincount(np.round(offset - offset.min()).astype(int).ravel(), weights=steep.ravel())
        lines.append((sums.max(), tilt, sums.argmax() + offset.min()))
    _, tilt, start = max(lines, key=lambda line: line[0])
    return _closed_in(slope, tilt, start, np.array((6.0, 5.0, 4.0, 4.0)) * extent / _LEAST_REACH)


def _closed_in(slope: Doubles, tilt: float, start: float, reaches: Doubles) -> Pair:
    """Return the line fitted to the middle of the slope in each row, each time within a reach of the line before."""
    rows, columns = np.indices(slope.shape)
    for reach in reaches:
        offset = columns - (start + tilt * rows)
        weight = slope * np.cos(math.pi * np.clip(offset / (2 * reach), -0.5, 0.5)) ** 2
        total = weight.sum(axis=1)
        there = total > 0.3 * np.quantile(total, 0.95)
        refuse_if(there.sum() < _LEAST_REACH, "image: it has no edge that is straight")
        centres = (weight * columns).sum(axis=1)[there] / total[there]
        tilt, start = (float(coefficient) for coefficient in np.polyfit(np.flatnonzero(there), centres, 1))
    return tilt, start


def _rows_with_edge(image: Doubles, slope: Doubles, tilt: float, start: float) -> NDArray[np.intp]:
    """Return the longest run of rows in which the edge is as high as elsewhere, without its ends."""
    rows = np.arange(image.shape[0])
    line = start + tilt * rows
    inside = (line > 1) & (line < image.shape[1] - 2)
    columns = np.arange(image.shape[1])
    strength = (slope * (np.abs(columns - line[:, None]) < 3)).sum(axis=1) * inside
    good = strength > 0.7 * np.quantile(strength[inside], 0.8) if inside.any() else inside
    there = np.flatnonzero(good)
    longest = max(np.split(there, np.flatnonzero(np.diff(there) > 1) + 1), key=len)
    # Ends at the border of the image stay.
    longest = longest[2 * longest[:1].any() : longest.size - 2 * (longest[-1:] < rows[-1]).any()]
    refuse_if(longest.size < _LEAST_REACH, "image: it has no edge of more than a few pixels")
    return longest


def _half_width(across: Doubles, line: Doubles) -> float:
    """Return how far an edge reaches from its line, which has a column in each row; refuse two edges side by side."""
    offset = np.round(np.arange(across.shape[1]) - line[:, None]).astype(int).ravel()
    least = offset.min()
    count = np.bincount(offset - least)
    covered = count >= 0.5 * len(line)
    profile = np.abs(np.bincount(offset - least, across.ravel()) / count)[covered]
    middle = int(np.argmin(np.abs(np.flatnonzero(covered) + least)))
    first = max(middle - _LEAST_REACH, 0)
    peak = first + int(np.argmax(profile[first : middle + _LEAST_REACH + 1]))
    widest = 0
    for side in (profile[peak:], profile[peak::-1]):
        # The edge ends where its slope falls to a tenth of the largest.
        foot = int(np.argmax(side < 0.1 * side[0])) or len(side)
        rise = (side - np.minimum.accumulate(side))[:foot].max()
        refuse_if(rise > 0.15 * side[0], _TWO_EDGES)
        widest = max(widest, foot)
    return float(widest)


def _transfer(distance: Doubles, values: Doubles, reach: float, density: float, foot: float) -> tuple[float, Doubles]:
    """Return the width of an edge, and the transfer function, from pixels at distances from its line.

    The profile is a spline with a density of knots in a pixel. Diffraction spreads light with the inverse square of the
    distance, of which percents lie beyond the reach: its strength is fitted to pixels beyond the foot of the edge.
    """
    order = np.argsort(distance)
    distance = distance[order]
    values = values[order]
    tail = 0.0
    sides = (-distance, distance)
    low, high = (values[(side > 0.7 * reach) & (side <= reach)].mean() for side in sides)
    if min(-distance[0], distance[-1]) > 2.5 * foot:
        outer = [(side > foot) & (side < 5 * foot) for side in sides]
        # Of each side height, uneven light, and the tail, which both sides of an edge have.
        (left, _, rise), (right, _, fall) = (
            np.linalg.lstsq(np.power.outer(side[far], (0.0, 1.0, -1.0)), values[far])[0]
            for side, far in zip(sides, outer, strict=True)
        )
        tail = max(min(rise / (right - left), fall / (left - right)), 0.0)
        if tail:
            low, high = left, right
    near = np.abs(distance) <= reach
    distance = distance[near]
    values = values[near]
    refuse_if(
        not abs(high - low) > 0.1 * np.abs(values).max(), "image: it has no edge: both sides of its line are alike"
    )
    # It takes half a second to load, and most scenes have no edge.
    from scipy.interpolate import make_lsq_spline
    from scipy.special import sici

    step = (values - low) / (high - low)
    _refuse_saturated(step, values)
    inner = np.linspace(-reach, reach, round(2 * reach * density) + 1)
    knots = np.concatenate((np.repeat(inner[0], 3), inner, np.repeat(inner[-1], 3)))
    with refusing("image: its edge is sampled too sparsely:", ValueError, np.linalg.LinAlgError):
        profile = make_lsq_spline(distance, step, knots, k=3)
    fine = np.linspace(-reach, reach, round(2 * reach * 32) + 1)
    rising = profile(fine)
    # Outwards from the middle, as noise crosses these heights elsewhere.
    middle = len(fine) // 2
    width = fine[middle + np.argmax(rising[middle:] >= 0.9)] - fine[middle + 1 - np.argmax(rising[middle::-1] < 0.1)]
    # Flat over the middle, so that it does not widen the spread; noise far from the edge is faded out.
    fade = np.clip((reach - np.abs(fine)) / (0.4 * reach), 0, 1)
    fade = np.sin(0.5 * math.pi * fade) ** 2
    spread = profile.derivative()(fine) * fade + tail * (1 - fade) / np.maximum(fine**2, 1)
    turns = 2 * math.pi * _FREQUENCIES
    beyond = 2 * tail * (np.cos(turns * reach) / reach - turns * (0.5 * math.pi - sici(turns * reach)[0]))
    spectrum = np.abs(np.exp(-1j * turns[:, None] * fine) @ spread * (fine[1] - fine[0]) + beyond)
    return float(width), spectrum / spectrum[0]


def _refuse_saturated(step: Doubles, values: Doubles) -> None:
    """Refuse an edge with a saturated side: many equal values, and hardly any values close to them."""
    for limit in (values.min(), values.max()):
        plateau = step[values == limit]
        # No light at all is black, as beside a simulated lamp; and a few pixels tell nothing.
        if plateau.size < 0.2 * values.size or limit == 0:
            continue
        height = np.abs(step - plateau[0])
        approaching, leaving = (np.count_nonzero((away > 0.02) & (away < 0.1)) for away in (height, 1 - height))
        refuse_if(approaching + 2 < 0.5 * leaving, "image: its edge is saturated: one side is cut off")
