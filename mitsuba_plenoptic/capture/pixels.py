"""Integrals over pixels of an intensity that is sampled on a grid of its own, and the adjoint."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ..runtime.backend import backend_of

HALF_WIDTH = 6
"""Samples on each side of a place of which the intensity there is interpolated."""

_KAISER = 7.0
_NODES = 8


class PixelIntegrals:
    """Integrals of a band-limited intensity over square pixels.

    Between its samples the intensity is a sum of sinc functions under a Kaiser window (Kaiser and Schafer 1980), each
    integrated over each pixel by Gauss's rule; outside the samples it is zero.

    Parameters
    ----------
    samples : (int, int)
        Rows and columns of samples.
    pitch : (float, float)
        Distance between samples along x and y in millimetres.
    origin : (float, float)
        x and y of the first sample.
    pixel_size : float
        Width of a pixel in millimetres.
    first_edge : (float, float)
        x and y of the outer corner of the first pixel.
    shape : (int, int)
        Rows and columns of pixels.
    """

    def __init__(
        self,
        samples: tuple[int, int],
        pitch: tuple[float, float],
        origin: tuple[float, float],
        pixel_size: float,
        first_edge: tuple[float, float],
        shape: tuple[int, int],
    ) -> None:
        self.axes = tuple(
            PixelAxis(pixels, pixel_size, first_edge[axis] - origin[axis], first_edge[axis], pitch[axis], count)
            for axis, pixels, count in ((0, shape[1], samples[1]), (1, shape[0], samples[0]))
        )
        self._along_x, self._along_y = (weights(axis) for axis in self.axes)

    def forward(self, intensity: NDArray[np.float32]) -> NDArray[np.float32]:
        """Integrate samples per square millimetre, (rows, columns), over the pixels, where the samples lie."""
        return product(self._along_y, intensity, self._along_x)

    def adjoint(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return for each sample the pixels weighted by what the sample gives to each of them."""
        return product(self._along_y.T.tocsr(), pixels, self._along_x.T.tocsr())


@dataclass(frozen=True)
class PixelAxis:
    """Pixels and samples along one axis.

    Attributes
    ----------
    count : int
        Pixels.
    pixel_size : float
        Their width.
    start : float
        Where the first pixel begins, from the first sample, in millimetres.
    edge : float
        Where it begins, in the coordinate of the caller.
    pitch : float
        Distance of samples.
    samples : int
        Their number.
    """

    count: int
    pixel_size: float
    start: float
    edge: float
    pitch: float
    samples: int

    @property
    def edges(self) -> NDArray[np.float64]:
        """Where pixels begin and the last one ends, (count + 1,), in the coordinate of the caller."""
        return np.asarray(self.edge + np.arange(self.count + 1) * self.pixel_size, np.float64)


def product(along_y: Any, values: Any, along_x: Any) -> Any:
    """Multiply values, (rows, columns), by sparse weights along both axes, where the values lie."""
    libraries = backend_of(values)
    if libraries.is_cuda:
        along_y, along_x = (libraries.sparse.csr_matrix(weights) for weights in (along_y, along_x))
    return libraries.arrays.ascontiguousarray((along_x @ (along_y @ values).T).T)


def weights(axis: PixelAxis, moment: bool = False) -> scipy.sparse.csr_array:
    """Return weights (pixels, samples) along one axis; for the moment, those of the coordinate's integral."""
    count, pitch, samples = axis.count, axis.pitch, axis.samples
    width, start = axis.pixel_size / pitch, axis.start / pitch
    pieces = max(1, math.ceil(width))
    nodes, node_weights = np.polynomial.legendre.leggauss(_NODES)
    inside = ((np.arange(pieces)[:, None] + (nodes + 1) / 2) * (width / pieces)).ravel()
    node_weights = np.tile(node_weights / 2 * (axis.pixel_size / pieces), pieces)
    place = start + np.arange(count)[:, None] * width + inside
    if moment:
        node_weights = node_weights * (axis.edge - axis.start + place * pitch)
    return interpolation(place, node_weights, samples)


def interpolation(place: NDArray[np.float64], factors: NDArray[np.float64], samples: int) -> scipy.sparse.csr_array:
    """Return the weights, (rows, samples), of what is interpolated at some places, summed over each row with factors.

    Parameters
    ----------
    place : float64 array (rows, k)
        In samples.
    factors : float64 array
        Broadcast against it.
    samples : int
        Their number.
    """
    below = np.floor(place).astype(np.int64)
    pixel = np.broadcast_to(np.arange(len(place))[:, None], place.shape)
    entries = []
    for offset in range(1 - HALF_WIDTH, 1 + HALF_WIDTH):
        entries.append((windowed_sinc(place - (below + offset)) * factors, pixel, below + offset))
    values, rows, columns = (np.concatenate([entry[k].ravel() for entry in entries]) for k in range(3))
    held = (columns >= 0) & (columns < samples)
    matrix = scipy.sparse.coo_array((values[held], (rows[held], columns[held])), shape=(len(place), samples))
    return matrix.tocsr().astype(np.float32)


def windowed_sinc(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the part of a sample at a distance in samples: a sinc under a Kaiser window."""
    window = np.i0(_KAISER * np.sqrt(np.maximum(0, 1 - (distance / HALF_WIDTH) ** 2))) / np.i0(_KAISER)
    return np.asarray(np.sinc(distance) * window)
