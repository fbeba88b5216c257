"""Power over bins of an object plane, from a field over direction cosines, in Dr.Jit.

Bins are even in the slope X / g, fields in the cosine X / |X|. For a fixed cosine along x, the edges of bins along y
are known cosines; so the power is integrated along y for every sample in x as the samples come, and the sums then along
x for every row of bins, with the edges that the row's middle has. Between the samples the power goes as a cubic (Keys,
"Cubic convolution interpolation for digital image processing", 1981), whose integral is the sum of the samples between
two edges and a few near each.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..runtime.backend import backend
from ..runtime.fft import Field, as_words, quotient, unpack
from .grids import AxisDirections, Directions


def power_in_bins(
    spectrum: Iterable[tuple[slice, Field]], step: Directions, camera: PlenopticCamera, oversample: int
) -> np.ndarray:
    """Sum the power over bins.

    Parameters
    ----------
    spectrum : iterable of (slice, complex64 array)
        From `steps.to_directions`.
    step : Directions
        Its sampling.
    camera : PlenopticCamera
        The camera.
    oversample : int
        Bins per lens along each axis.

    Returns
    -------
    (rows, columns) float32 array
        In units of the power of the field at the main lens, integrated over the pupil.
    """
    libraries = backend()
    types = libraries.types
    width = camera.mla_pitch / (camera.mla_distance * oversample)
    columns, rows = (count * oversample for count in camera.bin_count)
    # Parseval, of transforms that were divided by their lengths.
    scale = math.prod(axis.padded * axis.pitch for axis in (step.x, step.y))
    along_y = libraries.arrays.empty((step.x.kept, rows), np.float32)
    for mine, part in spectrum:
        words = types.UInt64(as_words(part))
        index = dr.arange(types.UInt32, len(part) * rows)
        line = quotient(types, index, rows)
        place = types.Int32(line + dr.opaque(types.UInt32, mine.start))
        place = dr.select(
            place > dr.opaque(types.Int32, step.x.kept // 2), place - dr.opaque(types.Int32, step.x.kept), place
        )
        cosine = types.Float(place) * dr.opaque(types.Float, step.x.step)
        base = line * dr.opaque(types.UInt32, step.y.kept)

        def power(sample: Any, active: Any, base: Any = base, words: Any = words) -> Any:
            value = unpack(dr.gather(types.UInt64, words, base + sample, active))
            return value.real * value.real + value.imag * value.imag

        def edge(slope: Any, cosine: Any = cosine) -> Any:
            return slope * dr.sqrt(along_y_of(slope, cosine))

        number = index - line * dr.opaque(types.UInt32, rows)
        along_y[mine] = _integrals(types, number, rows, width, edge, power, step.y).reshape(len(part), rows)
    words = types.Float(along_y.reshape(-1))
    index = dr.arange(types.UInt32, rows * columns)
    row = quotient(types, index, columns)
    middle = slope_of(types.Float(row) + 0.5, dr.opaque(types.Float, rows), dr.opaque(types.Float, width))

    def sums(sample: Any, active: Any) -> Any:
        return dr.gather(types.Float, words, sample * dr.opaque(types.UInt32, rows) + row, active)

    def edge_at(slope: Any) -> Any:
        return slope / dr.sqrt(along_x_of(slope, middle))

    number = index - row * dr.opaque(types.UInt32, columns)
    total = _integrals(types, number, columns, width, edge_at, sums, step.x) * np.float32(scale)
    return total.reshape(rows, columns)


def _integrals(types: Any, number: Any, bins: int, width: float, edge: Any, sample: Any, axis: AxisDirections) -> Any:
    """Integrate samples over bins, in samples: over those with these numbers, between their edges as cosines."""
    low, high = (
        edge(slope_of(types.Float(number) + side, dr.opaque(types.Float, bins), dr.opaque(types.Float, width)))
        * dr.opaque(types.Float, 1 / axis.step)
        for side in (1, 0)
    )
    first, last = (types.Int32(dr.floor(end)) for end in (low, high))
    most, kept = dr.opaque(types.Int32, axis.kept // 2), dr.opaque(types.Int32, axis.kept)

    def at(place: Any) -> Any:
        return sample(types.UInt32(dr.select(place >= 0, place, place + kept)), dr.abs(place) <= most)

    def body(place: Any, total: Any) -> tuple[Any, Any]:
        return place + 1, total + at(place)

    _, total = dr.while_loop((first + 1, types.Float(0)), lambda place, total: place <= last, body)
    for sign, before, end in ((1, last, high), (-1, first, low)):
        near = (at(before + offset) for offset in NEAR)
        total += sign * beyond(end - types.Float(before), *near)
    # A cubic may go below zero beside a dark sample.
    total = dr.maximum(total, 0)
    dr.eval(total)
    return backend().from_drjit(total)


NEAR = (-1, 0, 1, 2)
"""Samples beside the one before an edge that the integral up to the edge depends on, apart from the sum before it."""


def beyond(f: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Return by how much the integral up to an edge exceeds the sum of the samples up to the one before it.

    Parameters
    ----------
    f : array or Dr.Jit array
        Distance of the edge from the sample before it, in samples.
    a, b, c, d : float or array
        The samples at `NEAR`.
    """
    inside = f * (b + f * ((c - a) / 4 + f * ((a - 2.5 * b + 2 * c - d / 2) / 3 + f * (3 * (b - c) + d - a) / 8)))
    return inside + (a - c) / 24 - b / 2


def slope_of(edge: Any, bins: Any, width: Any) -> Any:
    """Return the slope at an edge, counted in bins of some width from the first edge.

    The object is upside down in camera coordinates: bins grow with -X.
    """
    return (edge - bins / 2) * -width


def along_y_of(slope: Any, cosine: Any) -> Any:
    """Return the square of the cosine along y over its slope, where the cosine along x is given."""
    return (1 - cosine * cosine) / (1 + slope * slope)


def along_x_of(slope: Any, other: Any) -> Any:
    """Return the square of the slope along x over its cosine, where the slope along y is given."""
    return 1 + slope * slope + other * other


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
