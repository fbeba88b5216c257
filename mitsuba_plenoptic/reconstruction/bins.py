"""Power over bins of an object plane, from a field over direction cosines, and its derivatives.

Bins are even in the slope X / g, fields in the cosine X / |X|. For a fixed cosine along x, the edges of bins along y
are known cosines; so the power is integrated along y for every sample in x as the samples come, and the sums then along
x for every row of bins, with the edges that the row's middle has. Between the samples the power goes as a cubic (Keys,
"Cubic convolution interpolation for digital image processing", 1981), whose integral is the sum of the samples between
two edges and a few near each.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..optics.phase import in_millimetres
from ..runtime.backend import backend
from .planning import Step

_NEAR = (-1, 0, 1, 2)
"""Samples next to the one before an edge that the integral up to the edge depends on, apart from the sum before it."""

_MARGIN = 4
"""Dark samples on both sides, so that every edge has samples near."""


def _beyond(f: NDArray[np.float64], a: float, b: float, c: float, d: float) -> NDArray[np.float64]:
    """Return by how much the integral up to an edge, f samples beyond one, exceeds the sum of those up to that one.

    The values a to d are those of the samples `_NEAR`.
    """
    inside = f * (b + f * ((c - a) / 4 + f * ((a - 2.5 * b + 2 * c - d / 2) / 3 + f * (3 * (b - c) + d - a) / 8)))
    return inside + (a - c) / 24 - b / 2


class Integrals:
    """Integrals of lines of samples between neighbouring edges, the lower of which comes last.

    Edges, (lines, bins + 1), count samples from the middle one; of the `kept` samples of a line, an odd number, zero
    comes first and the negative ones last.
    """

    def __init__(self, edges: NDArray[np.float64], kept: int) -> None:
        self._half, self._size = kept // 2, kept + 2 * _MARGIN
        # Beyond the samples all is dark; an edge there is as good as one just outside.
        place = np.clip(edges, -self._half - 2, self._half + 2) + self._half + _MARGIN
        before = np.floor(place).astype(np.int64)
        arrays = backend().arrays
        self._before = arrays.asarray(before)
        self._weights = [arrays.asarray(_beyond(place - before, *unit)) for unit in np.eye(len(_NEAR))]

    def forward(self, values: Any, lines: slice = slice(None)) -> Any:
        """Integrate some of the lines of samples, (lines, kept), over bins, (lines, bins)."""
        arrays, before = backend().arrays, self._before[lines]
        padded = arrays.zeros((len(values), self._size))
        middle = _MARGIN + self._half
        padded[:, middle : middle + self._half + 1] = values[:, : self._half + 1]
        padded[:, _MARGIN:middle] = values[:, self._half + 1 :]
        row = arrays.arange(len(values))[:, None]
        total = arrays.cumsum(padded, axis=1)[row, before]
        for offset, weight in zip(_NEAR, self._weights, strict=True):
            total += weight[lines] * padded[row, before + offset]
        return total[:, :-1] - total[:, 1:]

    def vjp(self, bins: Any) -> Any:
        """Apply the transpose of `forward` to all lines, from (lines, bins) to (lines, kept)."""
        arrays = backend().arrays
        total = arrays.pad(bins, ((0, 0), (0, 1))) - arrays.pad(bins, ((0, 0), (1, 0)))
        lines = arrays.arange(len(bins))[:, None] * self._size

        def scattered(offset: int, values: Any) -> Any:
            places = (lines + self._before + offset).ravel()
            return arrays.bincount(places, values.ravel(), lines.size * self._size).reshape(-1, self._size)

        padded = arrays.cumsum(scattered(0, total)[:, ::-1], axis=1)[:, ::-1].copy()
        for offset, weight in zip(_NEAR, self._weights, strict=True):
            padded += scattered(offset, weight * total)
        return arrays.roll(padded[:, _MARGIN:-_MARGIN], -self._half, axis=1)


class BinSums:
    """Sums over the bins of one object plane, `oversample` of them to a lens, of the power at directions.

    Sums are in pixel values times pixels. Negative sums, which cubics may produce, are set to zero.
    """

    def __init__(self, step: Step, camera: PlenopticCamera, wavelength: float, oversample: int) -> None:
        width = camera.mla_pitch / (camera.mla_distance * oversample)
        columns, rows = (count * oversample for count in camera.bin_count)
        across, down = (in_millimetres(wavelength) / axis.window for axis in (step.x, step.y))
        # The object is upside down in camera coordinates: bins grow with -X.
        slope_x, slope_y = ((np.arange(count + 1) - count / 2) * -width for count in (columns, rows))
        middle = (slope_y[:-1, None] + slope_y[1:, None]) / 2
        cosine = (np.fft.fftfreq(step.x.kept, 1 / step.x.kept) * across)[:, None]
        along_y = slope_y * np.sqrt((1 - cosine * cosine) / (1 + slope_y * slope_y))
        along_x = slope_x / np.sqrt(1 + slope_x * slope_x + middle * middle)
        self._along_y, self._along_x = Integrals(along_y / down, step.y.kept), Integrals(along_x / across, step.x.kept)
        # Parseval, of transforms that were divided by their lengths, over the area of a pixel.
        self._scale = step.x.window * step.y.window / camera.pixel_size**2
        self._shape = step.x.kept, rows

    def forward(self, power: Iterable[tuple[slice, Any]]) -> Any:
        """Sum blocks of a power that is not negative, (directions along x, along y); note which sums are cut."""
        arrays = backend().arrays
        along_y = arrays.empty(self._shape)
        for lines, part in power:
            along_y[lines] = self._along_y.forward(part, lines)
        self._lit_y = along_y > 0
        sums = self._along_x.forward(arrays.maximum(along_y, 0).T)
        self._lit = sums > 0
        return arrays.maximum(sums, 0) * self._scale

    def jvp(self, change: Any) -> Any:
        """Return the change of the sums with one of all of the power, where `forward` has been asked for."""
        arrays = backend().arrays
        along_y = arrays.where(self._lit_y, self._along_y.forward(change), 0)
        return arrays.where(self._lit, self._along_x.forward(along_y.T), 0) * self._scale

    def vjp(self, bins: Any) -> Any:
        """Apply the transpose of `jvp`."""
        arrays = backend().arrays
        along_y = self._along_x.vjp(arrays.where(self._lit, bins, 0) * self._scale).T
        return self._along_y.vjp(arrays.where(self._lit_y, along_y, 0))
