"""Integrals over pixels of an intensity that is sampled on a grid of its own, and the adjoint."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np
import scipy
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..lattice import turn
from ..runtime.backend import Backend, backend, backend_of
from ..runtime.batches import Box
from ..runtime.fft import split
from .grid import Grid

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


class MovedPixels:
    """A sum of products of weights along y and along x, as `PixelIntegrals` is one.

    Parameters
    ----------
    terms : list of pairs of sparse arrays
        Weights (pixels, samples) along y and along x.
    """

    def __init__(self, terms: list[tuple[Any, Any]]) -> None:
        self._terms = terms

    @classmethod
    def shifted(cls, pixels: PixelIntegrals, axis: int) -> MovedPixels:
        """Let all pixels move by 1 along x (axis 0) or y."""
        along_x, along_y = pixels.axes
        speed = np.ones(pixels.axes[axis].count + 1)
        if axis == 0:
            return cls([(weights(along_y), _at_edges(along_x, speed))])
        return cls([(_at_edges(along_y, speed), weights(along_x))])

    @classmethod
    def widened(cls, pixels: PixelIntegrals, middle: tuple[float, float], width: float) -> MovedPixels:
        """Let the detector grow about its middle, by 1 for its width."""
        along_x, along_y = pixels.axes
        speed_x, speed_y = ((axis.edges - centre) / width for axis, centre in zip(pixels.axes, middle, strict=True))
        return cls([(weights(along_y), _at_edges(along_x, speed_x)), (_at_edges(along_y, speed_y), weights(along_x))])

    @classmethod
    def shrunk(cls, pixels: PixelIntegrals, middle: tuple[float, float], scale: float) -> MovedPixels:
        """Let samples lie farther apart from the middle on, by one part in `scale`, their values held."""
        (along_x, along_y), narrower = pixels.axes, cls.widened(pixels, middle, -scale)
        return cls([*narrower._terms, (weights(along_y), weights(along_x) * np.float32(2 / scale))])

    @classmethod
    def turned(cls, pixels: PixelIntegrals, middle: tuple[float, float]) -> MovedPixels:
        """Turn the detector clockwise by one degree: as a lattice, that turns the other way, sees it."""
        degree = math.pi / 180
        moments = [
            weights(axis, moment=True) - weights(axis) * np.float32(centre)
            for axis, centre in zip(pixels.axes, middle, strict=True)
        ]
        edges = [_at_edges(axis, np.full(axis.count + 1, degree)) for axis in pixels.axes]
        return cls([(moments[1], edges[0]), (edges[1], -moments[0])])

    def forward(self, intensity: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the change of each pixel's integral, from samples per square millimetre, (rows, columns)."""
        return sum(product(along_y, intensity, along_x) for along_y, along_x in self._terms)

    def adjoint(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return for each sample the pixels weighted by what the sample gives to each of them."""
        return MovedPixels([(along_y.T.tocsr(), along_x.T.tocsr()) for along_y, along_x in self._terms]).forward(pixels)


def _at_edges(axis: PixelAxis, speed: NDArray[np.float64]) -> Any:
    """Return weights (pixels, samples) of the intensity at each pixel's last edge less that at its first, by speeds."""
    place = (axis.start + np.arange(axis.count + 1) * axis.pixel_size) / axis.pitch
    both = np.stack([place[:-1], place[1:]], -1)
    return interpolation(both, np.stack([-speed[:-1], speed[1:]], -1), axis.samples)


_PARTS = 4096
"""Places between two samples for which the weights of those around are held."""

_TAPS = 2 * HALF_WIDTH
_BLOCK = 2**22


class TurnedSamples:
    """Samples of an intensity on a grid against which its own is turned.

    Parameters
    ----------
    samples : (int, int)
        Rows and columns of the intensity's own samples; outside of them it is zero.
    pitch, origin : (float, float)
        Their distances along x and y, and where the first one is, in the frame of the intensity.
    degrees : float
        Angle, counter-clockwise about the axis, by which that frame is turned against that of the new grid.
    new_pitch : float
        Distance between the new samples.
    new_origin : (float, float)
        Where the first of them is.
    shape : (int, int)
        Rows and columns of the new grid.
    """

    def __init__(
        self,
        samples: tuple[int, int],
        pitch: tuple[float, float],
        origin: tuple[float, float],
        degrees: float,
        new_pitch: float,
        new_origin: tuple[float, float],
        shape: tuple[int, int],
    ) -> None:
        self._samples, self._pitch, self._origin, self._degrees = samples, pitch, origin, degrees
        self._new_pitch, self._new_origin, self._shape = new_pitch, new_origin, shape
        self._padded = samples[0] + 2 * HALF_WIDTH, samples[1] + 2 * HALF_WIDTH
        parts = (np.arange(_PARTS) + 0.5) / _PARTS
        self._weights = windowed_sinc(parts[:, None] - np.arange(1 - HALF_WIDTH, 1 + HALF_WIDTH)).astype(np.float32)

    def forward(self, intensity: NDArray[np.float32]) -> NDArray[np.float32]:
        """Interpolate the intensity, (rows, columns), at the new samples."""
        libraries = backend_of(intensity)
        types, arrays = libraries.types, libraries.arrays
        values = types.Float(arrays.pad(intensity, HALF_WIDTH).reshape(-1))
        result = arrays.empty(self._shape, np.float32)
        for lines, active, across, visit in self._places(libraries):

            def add(row: Any, weight: Any, total: Any, active: Any = active, across: Any = across) -> Any:
                line = types.Float(0)
                for k in range(_TAPS):
                    line = dr.fma(dr.gather(types.Float, values, row + k, active), across[k], line)
                return dr.fma(line, weight, total)

            total = visit(add, dr.zeros(types.Float, dr.width(active)))
            dr.eval(total)
            result[lines] = libraries.from_drjit(total).reshape(lines.stop - lines.start, -1)
        return result

    def adjoint(self, samples: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return for each of the intensity's own samples the new ones weighted by its part in each of them.

        Their last bits depend on the order in which threads add them.
        """
        libraries = backend_of(samples)
        types = libraries.types
        sums = dr.zeros(types.Float, self._padded[0] * self._padded[1])
        for lines, active, across, visit in self._places(libraries):
            given = types.Float(samples[lines].reshape(-1))

            def spread(
                row: Any, weight: Any, total: Any, active: Any = active, across: Any = across, given: Any = given
            ) -> Any:
                for k in range(_TAPS):
                    dr.scatter_add(sums, given * weight * across[k], row + k, active)
                return total

            dr.eval(visit(spread, types.Float(0)), sums)
        dr.eval(sums)
        inner = slice(HALF_WIDTH, -HALF_WIDTH)
        return libraries.arrays.ascontiguousarray(libraries.from_drjit(sums).reshape(self._padded)[inner, inner])

    def _places(
        self, libraries: Backend
    ) -> Iterator[tuple[slice, Any, list[Any], Callable[[Callable[[Any, Any, Any], Any], Any], Any]]]:
        """Yield lines of the new grid, which of their samples count, weights across, and a loop over rows around."""
        types = libraries.types
        table = types.Float(self._weights.reshape(-1))
        rows, columns = self._samples
        height, width = self._shape
        together = max(1, _BLOCK // width)
        for top in range(0, height, together):
            lines = slice(top, min(height, top + together))
            count = (lines.stop - top) * width
            _, row, column = split(types, dr.arange(types.UInt32, count), lines.stop - top, width)
            x = types.Float64(column) * self._new_pitch + dr.opaque(types.Float64, self._new_origin[0])
            y = types.Float64(row) * self._new_pitch + dr.opaque(
                types.Float64, self._new_origin[1] + top * self._new_pitch
            )
            first, entry = [], []
            active = dr.full(types.Bool, True, count)
            for axis, (place, size) in enumerate(zip(turn(x, y, -self._degrees), (columns, rows), strict=True)):
                place = (place - dr.opaque(types.Float64, self._origin[axis])) * dr.opaque(
                    types.Float64, 1 / self._pitch[axis]
                ) + HALF_WIDTH
                below = dr.floor(place)
                active &= (below >= HALF_WIDTH - 1) & (below < HALF_WIDTH + size)
                entry.append(types.UInt32(dr.clip((place - below) * _PARTS, 0, _PARTS - 1)) * _TAPS)
                first.append(types.UInt32(dr.clip(below, HALF_WIDTH - 1, size + HALF_WIDTH - 1)) - (HALF_WIDTH - 1))
            across = [dr.gather(types.Float, table, entry[0] + k) for k in range(_TAPS)]
            start = first[1] * dr.opaque(types.UInt32, self._padded[1]) + first[0]

            def visit(
                step: Callable[[Any, Any, Any], Any],
                total: Any,
                start: Any = start,
                entry: Any = entry[1],
                active: Any = active,
            ) -> Any:
                def body(line: Any, total: Any) -> tuple[Any, Any]:
                    row = start + line * dr.opaque(types.UInt32, self._padded[1])
                    weight = dr.gather(types.Float, table, entry + line, active)
                    return line + 1, step(row, weight, total)

                line = dr.zeros(types.UInt32, dr.width(active))
                return dr.while_loop((line, total), lambda line, total: line < _TAPS, body)[1]

            yield lines, active, across, visit


STEPS = ("x", "y")
"""Moves of all pixels by a millimetre along x, and along y."""

_EDGE = 8
"""Samples around a window that its pixels' integrals feel."""


class Recorder:
    """The recorded pixels that some patches reach, and the samples that these pixels feel.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera, whose recorded window may be a crop.
    grid : Grid
        The grid of the samples.
    low, high : int64 arrays (n, 2)
        First sample of each patch along x and y, and the one after its last.

    Attributes
    ----------
    box : Box
        The samples.
    """

    def __init__(self, camera: PlenopticCamera, grid: Grid, low: NDArray[np.int64], high: NDArray[np.int64]) -> None:
        self._camera, self._grid = camera, grid
        pitch, p = grid.pitch, camera.pixel_size
        start = np.array(camera.crop_offset)
        stop = start + np.array(camera.crop_size)
        if len(low):
            reached = self._turned(low.min(0) * pitch, high.max(0) * pitch, grid.rotation)
            start = np.clip(np.floor(reached[0] / p).astype(np.int64) - _EDGE, start, stop)
            stop = np.clip(np.ceil(reached[1] / p).astype(np.int64) + _EDGE, start, stop)
        felt = self._turned(start * p, stop * p, -grid.rotation)
        first = np.floor(felt[0] / pitch).astype(np.int64) - _EDGE
        last = np.ceil(felt[1] / pitch).astype(np.int64) + _EDGE
        self._pixels, self.box = Box.between(start, stop), Box.between(first, last)

    def _turned(
        self, low: NDArray[np.float64], high: NDArray[np.float64], degrees: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Bound a rectangle, given from the detector's corner, after a turn about the axis."""
        if degrees == 0:
            return low, high
        x, y = (np.array([low[axis], low[axis], high[axis], high[axis]]) + self._grid.origin[axis] for axis in (0, 1))
        corners = np.stack(turn(x, y[[0, 2, 0, 2]], degrees), -1) - self._grid.origin
        return corners.min(0), corners.max(0)

    @property
    def memory(self) -> float:
        """Bytes that a channel takes while it is recorded."""
        image = 4.0 * (self.box.rows * self.box.columns + 2 * math.prod(self._camera.shape))
        return image + (12.0 * self.box.rows * self.box.columns if self._grid.rotation != 0 else 0)

    def record(self, sums: NDArray[np.float32], move: str | None = None) -> NDArray[np.float32]:
        """Integrate samples over the pixels, or find how the integrals change where the pixels move.

        Parameters
        ----------
        sums : float32 array (channels, rows, columns)
            Intensity per square millimetre on the samples of `box`.
        move : {"detector_width", "mla_rotation", "wavelength", "x", "y"}, optional
            What changes by 1 while the samples stay as they are: the detector's width, its angle against the lattice,
            the wavelength with which their distances grow, or the place of the detector along x or y.

        Returns
        -------
        float32 array (rows, columns, channels)
            Of all recorded pixels.
        """
        image = np.zeros((*self._camera.shape, len(sums)), np.float32)
        target = image[self._window]
        for channel, samples in enumerate(sums):
            upright = samples if self._upright is None else self._upright.forward(samples)
            target[..., channel] = backend().to_host(self._pixels_of(move).forward(upright))
        return image

    def spread(self, image: NDArray[np.float32], move: str | None = None) -> NDArray[np.float32]:
        """Apply the adjoint of `record`.

        Parameters
        ----------
        image : float32 array (rows, columns, channels)
            Of all recorded pixels.
        move : str, optional
            As of `record`.

        Returns
        -------
        float32 array (channels, rows, columns)
            On the samples of `box`.
        """
        arrays = backend().arrays
        channels = []
        for channel in np.moveaxis(image[self._window], -1, 0):
            samples = self._pixels_of(move).adjoint(arrays.asarray(np.ascontiguousarray(channel, np.float32)))
            channels.append(samples if self._upright is None else self._upright.adjoint(samples))
        return arrays.stack(channels)

    @property
    def _window(self) -> tuple[slice, slice]:
        """Where the pixels lie in the image."""
        left, top = (self._pixels.left, self._pixels.top)
        left, top = left - self._camera.crop_offset[0], top - self._camera.crop_offset[1]
        return slice(top, top + self._pixels.rows), slice(left, left + self._pixels.columns)

    @property
    def _edge(self) -> tuple[float, float]:
        """X and y of the first pixel's corner, from the detector's."""
        p = self._camera.pixel_size
        return self._pixels.left * p, self._pixels.top * p

    @property
    def _origin(self) -> tuple[float, float]:
        """X and y of the first sample, in the frame of the lattice, from the detector's corner."""
        return self.box.left * float(self._grid.pitch[0]), self.box.top * float(self._grid.pitch[1])

    def _pixels_of(self, move: str | None) -> PixelIntegrals | MovedPixels:
        """Return the integrals over the pixels, or over the lines by which these grow where they move."""
        if move is None:
            return self._integrals
        if move in STEPS:
            return MovedPixels.shifted(self._integrals, STEPS.index(move))
        width = self._camera.detector_width
        axis = width / 2, self._camera.detector_height / 2
        if move == "mla_rotation":
            return MovedPixels.turned(self._integrals, axis)
        if move == "wavelength":
            return MovedPixels.shrunk(self._integrals, axis, self._grid.wavelength)
        return MovedPixels.widened(self._integrals, axis, width)

    @cached_property
    def _integrals(self) -> PixelIntegrals:
        x, y = self._grid.pitch.tolist()
        pitch, origin, samples = (x, y), self._origin, (self.box.rows, self.box.columns)
        if self._grid.rotation != 0:
            step = min(pitch)
            pitch, origin, samples = (step, step), self._upright_origin, self._upright_shape
        shape = self._pixels.rows, self._pixels.columns
        return PixelIntegrals(samples, pitch, origin, self._camera.pixel_size, self._edge, shape)

    @cached_property
    def _upright(self) -> TurnedSamples | None:
        """From the lattice's frame to samples in the camera's; None if the two are one."""
        grid = self._grid
        if grid.rotation == 0:
            return None
        x, y = grid.pitch.tolist()
        # The turn is about the axis.
        corner = grid.origin.tolist()
        return TurnedSamples(
            (self.box.rows, self.box.columns),
            (x, y),
            (self._origin[0] + corner[0], self._origin[1] + corner[1]),
            grid.rotation,
            min(x, y),
            (self._upright_origin[0] + corner[0], self._upright_origin[1] + corner[1]),
            self._upright_shape,
        )

    @property
    def _upright_shape(self) -> tuple[int, int]:
        p, step = self._camera.pixel_size, float(self._grid.pitch.min())
        rows, columns = (math.ceil(count * p / step) + 2 * _EDGE for count in (self._pixels.rows, self._pixels.columns))
        return rows, columns

    @property
    def _upright_origin(self) -> tuple[float, float]:
        step = float(self._grid.pitch.min())
        return self._edge[0] - _EDGE * step, self._edge[1] - _EDGE * step
