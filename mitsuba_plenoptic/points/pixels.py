"""Integrals over pixels of an intensity that is sampled on a different grid, and their derivatives as pixels move.

Between samples the intensity is a sum of sinc functions with a Kaiser window (Kaiser and Schafer 1980), each integrated
over each pixel by Gauss-Legendre quadrature; outside the samples it is zero. An integral is a product of weights along
x and y, and so is its derivative as pixels move, which is the intensity along their edges. Samples on a rotated grid
are interpolated by the same functions.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np
import scipy

from ..runtime import (
    Backend,
    Doubles,
    Floats,
    Integers,
    Pair,
    Shape,
    backend_of,
    drjit_array,
    fft,
    single_threaded_blas,
    turn,
)

HALF_WIDTH = 6
"""Samples on each side of a position from which the intensity there is interpolated."""

_KAISER = 7.0
_BORDERS = 6
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
    means: bool = False  # whether samples are means over their cells, not values in the middle

    @cached_property
    def weights(self) -> scipy.sparse.csr_array:
        """Weights of the integrals over the pixels."""
        if not self.means:
            return self._integrals(moment=False)
        # Integrals up to edges are interpolated from integrals up to the borders of samples, by a polynomial between
        # six borders.
        edges = (self.start + np.arange(self.count + 1) * self.pixel_size) / self.pitch + 0.5
        first = np.floor(edges).astype(np.int64) - (_BORDERS // 2 - 1)
        at = edges - first
        places = np.arange(_BORDERS)
        others = [np.delete(places, edge_place) for edge_place in places]
        share = np.stack(
            [np.prod((at[:, None] - o) / (p - o), axis=1) for p, o in zip(places, others, strict=True)], -1
        )
        # A sample counts up to all borders beyond it.
        beyond = np.cumsum(share[:, ::-1], axis=1)[:, ::-1]
        reach = np.arange(math.ceil(self.pixel_size / self.pitch) + _BORDERS + 1)
        pixel = np.arange(self.count)[:, None]
        sample = first[:-1, None] - 1 + reach

        def up_to(edge: Integers) -> Doubles:
            index = sample + 1 - first[edge]
            return np.where(index < _BORDERS, beyond[edge, np.clip(index, 0, _BORDERS - 1)], 0.0)

        values = (up_to(pixel + 1) - up_to(pixel)) * self.pitch
        return _matrix(values, np.broadcast_to(pixel, values.shape), sample, (self.count, self.samples))

    def moments(self, origin: float) -> scipy.sparse.csr_array:
        """Return the weights of integrals over the pixels of the intensity times the distance from an origin."""
        return self._integrals(moment=True) - self.weights * np.float32(origin)

    def _integrals(self, moment: bool) -> scipy.sparse.csr_array:
        width = self.pixel_size / self.pitch
        start = self.start / self.pitch
        pieces = max(1, math.ceil(width))
        nodes, node_weights = np.polynomial.legendre.leggauss(_NODES)
        inside = ((np.arange(pieces)[:, None] + (nodes + 1) / 2) * (width / pieces)).ravel()
        node_weights = np.tile(node_weights / 2 * (self.pixel_size / pieces), pieces)
        position = start + np.arange(self.count)[:, None] * width + inside
        if moment:
            node_weights = node_weights * (self.edge - self.start + position * self.pitch)
        return _interpolation(position, node_weights, self.samples)

    def at_edges(self, speed: Any) -> scipy.sparse.csr_array:
        """Return the weights of the intensity at each pixel's two edges, last minus first, times the edges' speeds."""
        position = (self.start + np.arange(self.count + 1) * self.pixel_size) / self.pitch
        both = np.stack([position[:-1], position[1:]], -1)
        return _interpolation(both, np.stack([-speed[:-1], speed[1:]], -1), self.samples)


def _interpolation(position: Doubles, factors: Doubles, samples: int) -> scipy.sparse.csr_array:
    """Return the weights (rows, samples) of sums along rows: interpolated values at positions, times factors."""
    below = np.floor(position).astype(np.int64)
    pixel = np.broadcast_to(np.arange(len(position))[:, None], position.shape)
    entries = []
    for offset in range(1 - HALF_WIDTH, 1 + HALF_WIDTH):
        entries.append((windowed_sinc(position - (below + offset)) * factors, pixel, below + offset))
    values, rows, columns = (np.concatenate([entry[k].ravel() for entry in entries]) for k in range(3))
    return _matrix(values, rows, columns, (len(position), samples))


def _matrix(values: Doubles, rows: Integers, columns: Integers, shape: Shape) -> scipy.sparse.csr_array:
    """Return a sparse matrix of values; values at the same place are added."""
    inside = (columns >= 0) & (columns < shape[1])
    matrix = scipy.sparse.coo_array((values[inside], (rows[inside], columns[inside])), shape=shape)
    return matrix.tocsr().astype(np.float32)


def windowed_sinc(distance: Doubles) -> Doubles:
    """Return the weight of a sample at a distance in samples: a sinc under a Kaiser window."""
    inside = np.sqrt(np.maximum(0, 1 - (distance / HALF_WIDTH) ** 2))
    window = scipy.special.i0(_KAISER * inside) / scipy.special.i0(_KAISER)
    return np.sinc(distance) * window


class PixelIntegrals:
    """A sum of products of weights along y and x: integrals over pixels, or derivatives as pixels move."""

    def __init__(self, along_x: PixelAxis, along_y: PixelAxis, terms: list[Pair] | None = None):
        self._axes = along_x, along_y
        self._terms = terms or [(along_y.weights, along_x.weights)]
        # Made when they are first needed, those of the adjoint too.
        self._matrices: dict[bool, list] = {}

    @classmethod
    def of(
        cls,
        samples: Shape,
        pitch: Doubles,
        origin: Doubles,
        pixel_size: float,
        first_edge: Doubles,
        shape: Shape,
        means: bool = False,
    ) -> PixelIntegrals:
        """Return the integrals over square pixels; `samples` and `shape` are (rows, columns) of samples and of pixels.

        `origin` is the first sample and `first_edge` the outer corner of the first pixel, both (x, y), like `pitch`.
        With `means` the samples are means over their cells.
        """
        along_x, along_y = (
            PixelAxis(pixels, pixel_size, first_edge[axis] - origin[axis], first_edge[axis], pitch[axis], count, means)
            for axis, pixels, count in ((0, shape[1], samples[1]), (1, shape[0], samples[0]))
        )
        return cls(along_x, along_y)

    def shifted(self, axis: int) -> PixelIntegrals:
        """Return the derivatives with respect to a motion of all pixels along x (axis 0) or y."""
        along_x, along_y = self._axes
        speed = np.ones(self._axes[axis].count + 1)
        moved = (along_y.weights, along_x.at_edges(speed)) if axis == 0 else (along_y.at_edges(speed), along_x.weights)
        return PixelIntegrals(*self._axes, [moved])

    def widened(self, middle: Pair, width: float) -> PixelIntegrals:
        """Return the derivatives with respect to the width of the detector, which grows about its middle."""
        along_x, along_y = self._axes
        edges_x, edges_y = (
            axis.at_edges((axis.edge + np.arange(axis.count + 1) * axis.pixel_size - centre) / width)
            for axis, centre in zip(self._axes, middle, strict=True)
        )
        return PixelIntegrals(*self._axes, [(along_y.weights, edges_x), (edges_y, along_x.weights)])

    def shrunk(self, middle: Pair, scale: float) -> PixelIntegrals:
        """Return the derivatives with respect to `scale`, a factor on sample distances, at fixed sample values."""
        along_x, along_y = self._axes
        growth = along_y.weights, along_x.weights * np.float32(2 / scale)
        return PixelIntegrals(*self._axes, [*self.widened(middle, -scale)._terms, growth])

    def turned(self, middle: Pair) -> PixelIntegrals:
        """Return the derivatives of the integrals by a clockwise rotation of the detector against the lattice."""
        moment_x, moment_y = (axis.moments(centre) for axis, centre in zip(self._axes, middle, strict=True))
        edges_x, edges_y = (axis.at_edges(np.full(axis.count + 1, math.pi / 180)) for axis in self._axes)
        return PixelIntegrals(*self._axes, [(moment_y, edges_x), (edges_y, -moment_x)])

    def cut(self, pixels: tuple[slice, slice], samples: tuple[slice, slice]) -> PixelIntegrals:
        """Return the integrals over some rows and columns of the pixels, from some rows and columns of the samples."""
        rows, columns = pixels
        down, across = samples
        terms = [(along_y[rows, down], along_x[columns, across]) for along_y, along_x in self._terms]
        return PixelIntegrals(*self._axes, terms)

    def forward(self, intensity: Floats) -> Floats:
        """Return the integrals over the pixels of samples (rows, columns) per mm², on the samples' device."""
        return self._sum(intensity, False)

    def adjoint(self, pixels: Floats) -> Floats:
        """Return the adjoint of the integrals: for each sample, the pixels weighted by the sample's contributions."""
        return self._sum(pixels, True)

    def _sum(self, values: Any, transposed: bool) -> Any:
        """Return the sum over terms of values (rows, columns) multiplied by weights along y and x, or their transposes.

        Where samples are made from pixels, x comes first, as there are fewest rows then.
        """
        libraries = backend_of(values)
        made = libraries.sparse.csr_matrix if libraries.is_cuda else _Bands
        if transposed not in self._matrices:
            self._matrices[transposed] = [
                [made(weights.T.tocsr() if transposed else weights) for weights in pair] for pair in self._terms
            ]
        with single_threaded_blas():
            first, *others = (
                down @ (across @ values.T).T if transposed else (across @ (down @ values).T).T
                for down, across in self._matrices[transposed]
            )
        return libraries.arrays.ascontiguousarray(sum(others, first))


class _Bands:
    """A sparse matrix as dense ones of 32 rows each, from their first to their last entry, which multiply faster."""

    def __init__(self, weights: scipy.sparse.csr_array):
        self._count, width = weights.shape
        self._parts = []
        for start in range(0, self._count, 32):
            rows = slice(start, start + 32)
            index = weights[rows].indices
            columns = slice(index.min(initial=width), index.max(initial=-1) + 1)
            self._parts.append((rows, columns, weights[rows, columns].toarray()))

    def __matmul__(self, values: Floats) -> Floats:
        """Return the product with values, in their order in memory."""
        result = np.empty_like(values, shape=(self._count, values.shape[1]))
        for rows, columns, weights in self._parts:
            result[rows] = weights @ values[columns]
        return result


_PARTS = 4096
"""Number of positions between two samples for which interpolation weights are tabulated."""

_TAPS = 2 * HALF_WIDTH
_BLOCK = 2**22


class TurnedSamples:
    """Samples of an intensity on a new grid; the intensity's grid is turned counter-clockwise relative to it.

    `samples` and `shape` are the rows and columns of the intensity's samples and of the new ones; `pitch` and `origin`
    (x, y) are those of the intensity's samples, in their frame. Outside its samples the intensity is zero. `regular`
    brings the places of new samples to those where the intensity has what they show.
    """

    def __init__(
        self,
        samples: Shape,
        pitch: Doubles,
        origin: Doubles,
        degrees: float,
        new_pitch: float,
        new_origin: Doubles,
        shape: Shape,
        regular: Callable[[Any, Any], Pair] | None,
    ):
        self._samples = samples
        self._regular = regular
        self._pitch = pitch
        self._origin = origin
        self._degrees = degrees
        self._new_pitch = new_pitch
        self._new_origin = new_origin
        self._shape = shape
        self._padded = samples[0] + 2 * HALF_WIDTH, samples[1] + 2 * HALF_WIDTH
        # Lines of the new grid that are made together.
        together = max(1, _BLOCK // shape[1])
        self._blocks = [slice(top, min(shape[0], top + together)) for top in range(0, shape[0], together)]
        parts = (np.arange(_PARTS) + 0.5) / _PARTS
        self._weights = windowed_sinc(parts[:, None] - np.arange(1 - HALF_WIDTH, 1 + HALF_WIDTH)).astype(np.float32)

    def forward(self, intensity: Floats) -> Floats:
        """Return the intensity (rows, columns) interpolated at the new samples."""
        libraries = backend_of(intensity)
        types = libraries.types
        values = drjit_array(types.Float, libraries.arrays.pad(intensity, HALF_WIDTH))
        result = libraries.arrays.empty(self._shape, np.float32)

        def add(row: Any, weight: Any, total: Any, active: Any, across: list) -> Any:
            line = types.Float(0)
            for k in range(_TAPS):
                line = dr.fma(dr.gather(types.Float, values, row + k, active), across[k], line)
            return dr.fma(line, weight, total)

        for lines in self._blocks:
            part = result[lines]
            total = self._visit(libraries, lines, dr.zeros(types.Float, part.size), add)
            dr.eval(total)
            part[...] = libraries.from_drjit(total).reshape(part.shape)
        return result

    def adjoint(self, samples: Floats) -> Floats:
        """Return the adjoint: for each sample of the intensity, the new samples weighted by the sample's contributions.

        The rounding of the result depends on the order in which threads add.
        """
        libraries = backend_of(samples)
        types = libraries.types
        sums = dr.zeros(types.Float, math.prod(self._padded))

        def spread(row: Any, weight: Any, line_samples: Any, active: Any, across: list) -> Any:
            for k in range(_TAPS):
                dr.scatter_add(sums, line_samples * weight * across[k], row + k, active)
            return line_samples

        for lines in self._blocks:
            dr.eval(self._visit(libraries, lines, drjit_array(types.Float, samples[lines]), spread), sums)
        inner = slice(HALF_WIDTH, -HALF_WIDTH)
        return libraries.arrays.ascontiguousarray(libraries.from_drjit(sums).reshape(self._padded)[inner, inner])

    def _visit(self, libraries: Backend, lines: slice, total: Any, step: Callable) -> Any:
        """Return `total` after a step for each neighbouring row of lines of the new grid, with weights across."""
        types = libraries.types
        table = drjit_array(types.Float, self._weights)
        rows, columns = self._samples
        # Opaque, so that other cameras do not compile kernels of their own.
        pitch, degrees = (dr.opaque(types.Float64, float(value)) for value in (self._new_pitch, -self._degrees))
        ends = [dr.opaque(types.Float64, float(HALF_WIDTH + size)) for size in (columns, rows)]
        row, column = fft.rows_and_columns(types, lines.stop - lines.start, self._shape[1])
        x = types.Float64(column) * pitch + dr.opaque(types.Float64, self._new_origin[0])
        y = types.Float64(row) * pitch + dr.opaque(types.Float64, self._new_origin[1] + lines.start * self._new_pitch)
        if self._regular is not None:
            x, y = self._regular(x, y)
        first = []
        entry = []
        active = dr.full(types.Bool, True, dr.width(row))
        for axis, (position, end) in enumerate(zip(turn(x, y, degrees), ends, strict=True)):
            position = (position - dr.opaque(types.Float64, self._origin[axis])) * dr.opaque(
                types.Float64, 1 / self._pitch[axis]
            ) + HALF_WIDTH
            below = dr.floor(position)
            active &= (below >= HALF_WIDTH - 1) & (below < end)
            entry.append(types.UInt32(dr.clip((position - below) * _PARTS, 0, _PARTS - 1)) * _TAPS)
            first.append(types.UInt32(dr.clip(below, HALF_WIDTH - 1, end - 1)) - (HALF_WIDTH - 1))
        across = [dr.gather(types.Float, table, entry[0] + k) for k in range(_TAPS)]
        width = dr.opaque(types.UInt32, self._padded[1])
        start = first[1] * width + first[0]

        def body(line: Any, total: Any) -> Pair:
            weight = dr.gather(types.Float, table, entry[1] + line, active)
            return line + 1, step(start + line * width, weight, total, active, across)

        line = dr.zeros(types.UInt32, dr.width(active))
        return dr.while_loop((line, total), lambda line, total: line < _TAPS, body)[1]
