"""Integrals over pixels of an intensity that is sampled on a different grid, and their derivatives as pixels move.

Between samples the intensity is a sum of sinc functions with a Kaiser window (Kaiser and Schafer 1980), each integrated
over each pixel by Gauss-Legendre quadrature; outside the samples it is zero. An integral is a product of weights along
x and y, and so is its derivative as pixels move, which is the intensity along their edges.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ..runtime.backend import backend_of

HALF_WIDTH = 6
"""Samples on each side of a position from which the intensity there is interpolated."""

_KAISER = 7.0
_NODES = 8


@dataclass(frozen=True)
class PixelAxis:
    """Pixels and intensity samples along one axis, with the weights (pixels, samples) of the integrals."""

    count: int  # number of pixels
    pixel_size: float
    start: float  # start of the first pixel relative to the first sample, in millimetres
    edge: float  # the same in the coordinate system of the caller
    pitch: float  # distance between samples
    samples: int

    @cached_property
    def weights(self) -> scipy.sparse.csr_array:
        """Weights of the integrals over the pixels."""
        return self._integrals(moment=False)

    def moments(self, origin: float) -> scipy.sparse.csr_array:
        """Return the weights of integrals over the pixels of the intensity times the distance from an origin."""
        return self._integrals(moment=True) - self.weights * np.float32(origin)

    def _integrals(self, moment: bool) -> scipy.sparse.csr_array:
        width, start = self.pixel_size / self.pitch, self.start / self.pitch
        pieces = max(1, math.ceil(width))
        nodes, node_weights = np.polynomial.legendre.leggauss(_NODES)
        inside = ((np.arange(pieces)[:, None] + (nodes + 1) / 2) * (width / pieces)).ravel()
        node_weights = np.tile(node_weights / 2 * (self.pixel_size / pieces), pieces)
        place = start + np.arange(self.count)[:, None] * width + inside
        if moment:
            node_weights = node_weights * (self.edge - self.start + place * self.pitch)
        return _interpolation(place, node_weights, self.samples)

    def at_edges(self, speed: NDArray[np.float64]) -> scipy.sparse.csr_array:
        """Return the weights of the intensity at each pixel's last edge less that at its first, times edge speeds."""
        place = (self.start + np.arange(self.count + 1) * self.pixel_size) / self.pitch
        both = np.stack([place[:-1], place[1:]], -1)
        return _interpolation(both, np.stack([-speed[:-1], speed[1:]], -1), self.samples)

    def edges_from(self, origin: float) -> NDArray[np.float64]:
        """Return the distances of all pixel edges from an origin, (count + 1,)."""
        return np.asarray(self.edge + np.arange(self.count + 1) * self.pixel_size - origin, np.float64)


def _interpolation(place: NDArray[np.float64], factors: NDArray[np.float64], samples: int) -> scipy.sparse.csr_array:
    """Return the weights (rows, samples) of sums along rows of interpolated values at positions, times factors."""
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
    """Return the weight of a sample at a distance in samples: a sinc under a Kaiser window."""
    window = np.i0(_KAISER * np.sqrt(np.maximum(0, 1 - (distance / HALF_WIDTH) ** 2))) / np.i0(_KAISER)
    return np.asarray(np.sinc(distance) * window)


class PixelIntegrals:
    """A sum of products of weights along y and x: integrals over pixels, or their derivatives as the pixels move."""

    def __init__(self, along_x: PixelAxis, along_y: PixelAxis, terms: list[tuple[Any, Any]] | None = None) -> None:
        self._axes = along_x, along_y
        self._terms = terms or [(along_y.weights, along_x.weights)]

    @classmethod
    def of(
        cls,
        samples: tuple[int, int],
        pitch: tuple[float, float],
        origin: tuple[float, float],
        pixel_size: float,
        first_edge: tuple[float, float],
        shape: tuple[int, int],
    ) -> PixelIntegrals:
        """Return the integrals over square pixels; `samples` and `shape` are (rows, columns) of samples and of pixels.

        `origin` is the first sample and `first_edge` the outer corner of the first pixel, both (x, y), as is `pitch`.
        """
        along_x, along_y = (
            PixelAxis(pixels, pixel_size, first_edge[axis] - origin[axis], first_edge[axis], pitch[axis], count)
            for axis, pixels, count in ((0, shape[1], samples[1]), (1, shape[0], samples[0]))
        )
        return cls(along_x, along_y)

    def shifted(self, axis: int) -> PixelIntegrals:
        """Return the derivatives by a motion of all pixels along x (axis 0) or y."""
        along_x, along_y = self._axes
        speed = np.ones(self._axes[axis].count + 1)
        moved = (along_y.weights, along_x.at_edges(speed)) if axis == 0 else (along_y.at_edges(speed), along_x.weights)
        return PixelIntegrals(*self._axes, [moved])

    def widened(self, middle: tuple[float, float], width: float) -> PixelIntegrals:
        """Return the derivatives by the width of the detector, which grows about its middle."""
        along_x, along_y = self._axes
        edges_x, edges_y = (
            axis.at_edges(axis.edges_from(centre) / width) for axis, centre in zip(self._axes, middle, strict=True)
        )
        return PixelIntegrals(*self._axes, [(along_y.weights, edges_x), (edges_y, along_x.weights)])

    def shrunk(self, middle: tuple[float, float], scale: float) -> PixelIntegrals:
        """Return the derivatives by `scale`, by which sample distances from the middle grow, at fixed values."""
        along_x, along_y = self._axes
        growth = along_y.weights, along_x.weights * np.float32(2 / scale)
        return PixelIntegrals(*self._axes, [*self.widened(middle, -scale)._terms, growth])

    def turned(self, middle: tuple[float, float]) -> PixelIntegrals:
        """Return the derivatives by a clockwise rotation of the detector in degrees, against that of the lattice."""
        moment_x, moment_y = (axis.moments(centre) for axis, centre in zip(self._axes, middle, strict=True))
        edges_x, edges_y = (axis.at_edges(np.full(axis.count + 1, math.pi / 180)) for axis in self._axes)
        return PixelIntegrals(*self._axes, [(moment_y, edges_x), (edges_y, -moment_x)])

    def forward(self, intensity: NDArray[np.float32]) -> NDArray[np.float32]:
        """Integrate samples (rows, columns) per square millimetre over the pixels, on the device of the samples."""
        return _sum_of_products(self._terms, intensity)

    def adjoint(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return for each sample the sum of the pixels, weighted by its contribution to each of them."""
        return _sum_of_products([(along_y.T.tocsr(), along_x.T.tocsr()) for along_y, along_x in self._terms], pixels)


def _sum_of_products(terms: list[tuple[Any, Any]], values: Any) -> Any:
    """Multiply values (rows, columns) by sparse weights along y and x, and sum the products of all terms."""
    libraries, total = backend_of(values), None
    for along_y, along_x in terms:
        if libraries.is_cuda:
            along_y, along_x = (libraries.sparse.csr_matrix(weights) for weights in (along_y, along_x))
        product = libraries.arrays.ascontiguousarray((along_x @ (along_y @ values).T).T)
        total = product if total is None else total + product
    return total
