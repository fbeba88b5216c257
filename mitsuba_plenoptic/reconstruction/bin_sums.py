"""Power over bins of an object plane as a linear function of the power at directions, with its transpose.

The sums are those of `direction_bins`, by its formulas, in double precision: from the sums before each edge of a bin.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from .direction_bins import NEAR, along_x_of, along_y_of, beyond, slope_of
from .grids import AxisDirections, Directions

_MARGIN = 4
"""Dark samples on both sides, so that every edge has samples near."""


class Integrals:
    """Integrals of lines of samples between neighbouring edges, the lower of which comes last.

    Parameters
    ----------
    edges : float64 array (lines, bins + 1)
        In samples, from the middle one.
    kept : int
        Samples of a line, zero first and negative ones last, an odd number.
    """

    def __init__(self, edges: NDArray[np.float64], kept: int) -> None:
        self._half, self._size = kept // 2, kept + 2 * _MARGIN
        # Beyond the samples all is dark; an edge there is as good as one just outside.
        place = np.clip(edges, -self._half - 2, self._half + 2) + self._half + _MARGIN
        before = np.floor(place).astype(np.int64)
        units = np.eye(len(NEAR))
        self._weights = np.stack([np.asarray(beyond(place - before, *unit)) for unit in units], -1)
        self._before = before

    def forward(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Integrate samples (lines, kept) over bins, (lines, bins)."""
        padded = np.pad(np.roll(values, self._half, axis=1), ((0, 0), (_MARGIN, _MARGIN)))
        total = np.take_along_axis(np.cumsum(padded, axis=1), self._before, axis=1)
        for offset, weight in zip(NEAR, np.moveaxis(self._weights, -1, 0), strict=True):
            total += weight * np.take_along_axis(padded, self._before + offset, axis=1)
        return total[:, :-1] - total[:, 1:]

    def adjoint(self, bins: NDArray[np.float64]) -> NDArray[np.float64]:
        """Apply the transpose of `forward`, from (lines, bins) to (lines, kept)."""
        total = np.pad(bins, ((0, 0), (0, 1))) - np.pad(bins, ((0, 0), (1, 0)))
        lines = np.arange(len(bins))[:, None] * self._size

        def scattered(offset: int, values: NDArray[np.float64]) -> NDArray[np.float64]:
            places = (lines + self._before + offset).ravel()
            sums = np.bincount(places, values.ravel(), lines.size * self._size)
            return np.asarray(sums, np.float64).reshape(-1, self._size)

        padded = np.cumsum(scattered(0, total)[:, ::-1], axis=1)[:, ::-1].copy()
        for offset, weight in zip(NEAR, np.moveaxis(self._weights, -1, 0), strict=True):
            padded += scattered(offset, weight * total)
        return np.roll(padded[:, _MARGIN:-_MARGIN], -self._half, axis=1)


class BinSums:
    """Sums over the bins of one object plane.

    Parameters
    ----------
    step : Directions
        Sampling of the directions.
    camera : PlenopticCamera
        The camera.
    oversample : int
        Bins per lens along each axis.
    """

    def __init__(self, step: Directions, camera: PlenopticCamera, oversample: int) -> None:
        width = camera.mla_pitch / (camera.mla_distance * oversample)
        columns, rows = (count * oversample for count in camera.bin_count)
        slope_x, slope_y = (slope_of(np.arange(count + 1), count, width) for count in (columns, rows))
        cosine = _cosines(step.x)[:, None]
        middle = slope_of(np.arange(rows) + 0.5, rows, width)[:, None]
        self._along_y = Integrals(slope_y * np.sqrt(along_y_of(slope_y, cosine)) / step.y.step, step.y.kept)
        self._along_x = Integrals(slope_x / np.sqrt(along_x_of(slope_x, middle)) / step.x.step, step.x.kept)
        # Parseval, of transforms that were divided by their lengths, over the area of a pixel.
        self._scale = math.prod(axis.padded * axis.pitch for axis in (step.x, step.y)) / camera.pixel_size**2

    def at(self, power: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum a power that is not negative, (directions along x, along y), and note which of the sums are cut at zero.

        Returns
        -------
        float64 array (rows, columns)
        """
        along_y = self._along_y.forward(power)
        self._lit_y = along_y > 0
        sums = self._along_x.forward(np.where(self._lit_y, along_y, 0).T)
        self._lit = sums > 0
        return np.where(self._lit, sums, 0) * self._scale

    def tangent(self, change: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the change of the sums with one of the power, where `at` has been asked for."""
        along_y = np.where(self._lit_y, self._along_y.forward(change), 0)
        return np.where(self._lit, self._along_x.forward(along_y.T), 0) * self._scale

    def back(self, bins: NDArray[np.float64]) -> NDArray[np.float64]:
        """Apply the transpose of `tangent`."""
        along_y = self._along_x.adjoint(np.where(self._lit, bins, 0) * self._scale).T
        return self._along_y.adjoint(np.where(self._lit_y, along_y, 0))


def _cosines(axis: AxisDirections) -> NDArray[np.float64]:
    """Return the direction cosines of samples, zero first and negative ones last."""
    place = np.arange(axis.kept)
    return np.where(place > axis.kept // 2, place - axis.kept, place) * axis.step
