"""Conversion of intensity samples on a grid to the recorded pixels, and back."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from ..runtime import Box, Doubles, Floats, Integers, Pair, active_backend, turn
from .field_grid import Grid
from .pixels import PixelIntegrals, TurnedSamples

STEPS = ("x", "y")
"""Moves of all pixels by a millimetre along x, and along y."""

_EDGE = 8
"""Samples around a window that its pixels' integrals feel."""


class Recorder:
    """The recorded pixels that some patches reach, and the `box` of grid samples on which these pixels depend.

    `low` and `high`, (n, 2), are the first sample of each patch along x and y, and the one after its last. `parent` is
    a recorder for these and other patches, whose data are reused. `regular` brings places on the detector, in mm, to
    those of the samples, at most `aside` away.
    """

    def __init__(
        self,
        camera: PlenopticCamera,
        grid: Grid,
        low: Integers,
        high: Integers,
        parent: Recorder | None = None,
        regular: Callable[[Any, Any], Pair] | None = None,
        aside: float = 0.0,
    ):
        self._camera = camera
        self._grid = grid
        self._whole = parent
        self._regular = regular
        pitch = grid.pitch
        p = camera.pixel_size
        start = np.array(camera.crop_offset)
        stop = start + np.array(camera.crop_size)
        if len(low):
            reached = self._turned(low.min(0) * pitch, high.max(0) * pitch, grid.rotation)
            start = np.clip(np.floor(reached[0] / p).astype(np.int64) - _EDGE, start, stop)
            stop = np.clip(np.ceil(reached[1] / p).astype(np.int64) + _EDGE, start, stop)
        reach = self._turned(start * p, stop * p, -grid.rotation)
        first = np.floor((reach[0] - aside) / pitch).astype(np.int64) - _EDGE
        last = np.ceil((reach[1] + aside) / pitch).astype(np.int64) + _EDGE
        self._pixels, self.box = Box.between(start, stop), Box.between(first, last)
        rows = self._pixels.rows
        columns = self._pixels.columns
        # Number of the pixels, and their rows and columns in the image.
        self.count = rows * columns
        left, top = (start - camera.crop_offset).tolist()
        self.window = slice(top, top + rows), slice(left, left + columns)
        self._is_resampled = grid.rotation != 0 or regular is not None
        # Samples are recorded all at once where others are made of them before, and on a CUDA device.
        self.by_samples = self._is_resampled or active_backend().is_cuda

    def _turned(self, low: Doubles, high: Doubles, degrees: float) -> Pair:
        """Return the bounds of a rectangle, given from the detector's corner, after a turn about the axis."""
        if degrees == 0:
            return low, high
        x, y = (np.array([low[axis], low[axis], high[axis], high[axis]]) + self._grid.origin[axis] for axis in (0, 1))
        corners = np.stack(turn(x, y[[0, 2, 0, 2]], degrees), -1) - self._grid.origin
        return corners.min(0), corners.max(0)

    @property
    def memory(self) -> float:
        """Number of bytes that a channel takes while it is recorded."""
        image = 4.0 * (self.box.rows * self.box.columns + 2 * math.prod(self._camera.shape))
        return image + (12.0 * self.box.rows * self.box.columns if self._is_resampled else 0)

    def record(self, sums: Floats, move: str | None = None) -> Floats:
        """Return the box's samples integrated over pixels, or the change of these integrals as the pixels move.

        `sums` (channels, rows, columns) are per square millimetre; the result (rows, columns, channels) has all
        recorded pixels. `move` names a quantity that grows by 1 while the samples are fixed: "detector_width",
        "mla_rotation" (the detector's angle against the lattice), "wavelength" (with which the samples' distances
        grow), or "x" or "y" (the detector's position).
        """
        image = np.zeros((*self._camera.shape, len(sums)), np.float32)
        target = image[self.window]
        for channel, samples in enumerate(sums):
            target[..., channel] = self.integrate(samples, move)
        return image

    def integrate(self, samples: Floats, move: str | None = None) -> Floats:
        """Return the integrals of one channel over the pixels in `window`, as `record` does."""
        integrals, upright = self._made
        if upright is not None:
            samples = upright.forward(samples)
        return active_backend().to_host(self._moved(integrals, move).forward(samples))

    def spread(self, image: Floats, move: str | None = None) -> Floats:
        """Return the adjoint of `record`: grid samples from an image."""
        arrays = active_backend().arrays
        integrals, upright = self._made
        channels = []
        for channel in np.moveaxis(image[self.window], -1, 0):
            samples = self._moved(integrals, move).adjoint(arrays.asarray(np.ascontiguousarray(channel, np.float32)))
            channels.append(samples if upright is None else upright.adjoint(samples))
        return channels[0][None] if len(channels) == 1 else arrays.stack(channels)

    def within(self, low: Integers, high: Integers) -> Recorder:
        """Return the recorder of some of the box's samples alone, from places x and y in the box to others."""
        corner = np.array([[self.box.left, self.box.top]])
        part = Recorder(self._camera, self._grid, corner + low, corner + high, self)
        part.box = Box.between(corner[0] + low, corner[0] + high)
        return part

    def _moved(self, integrals: PixelIntegrals, move: str | None) -> PixelIntegrals:
        """Return the integrals over the pixels, or their changes as the pixels move."""
        if move is None:
            return integrals
        if move in STEPS:
            return integrals.shifted(STEPS.index(move))
        width = self._camera.detector_width
        axis = width / 2, self._camera.detector_height / 2
        if move == "mla_rotation":
            return integrals.turned(axis)
        if move == "wavelength":
            return integrals.shrunk(axis, self._grid.wavelength)
        return integrals.widened(axis, width)

    @cached_property
    def _made(self) -> tuple[PixelIntegrals, TurnedSamples | None]:
        """The integrals over the pixels, and the resampling before them from regular lenses in the lattice frame."""
        grid = self._grid
        camera = self._camera
        pixels = self._pixels
        box = self.box
        if self._whole is not None and not self._is_resampled:
            parent = self._whole
            return parent._made[0].cut(_slices(pixels, parent._pixels), _slices(box, parent.box)), None
        # X and y of the first pixel's corner and of the first sample, relative to the detector's corner.
        p = camera.pixel_size
        edge = np.array([pixels.left, pixels.top]) * p
        size = np.array([camera.detector_width, camera.detector_height])
        origin = np.array([box.left, box.top]) * grid.pitch + (grid.origin + size / 2)
        pitch = grid.pitch
        samples = box.rows, box.columns
        upright = None
        if self._is_resampled:
            step = float(min(pitch))
            rows, columns = (math.ceil(count * p / step) + 2 * _EDGE for count in (pixels.rows, pixels.columns))
            corner = edge - _EDGE * step
            # The turn is about the axis.
            places = origin + grid.origin, grid.rotation, step, corner + grid.origin
            upright = TurnedSamples(samples, pitch, *places, (rows, columns), self._regular)
            samples, pitch, origin = (rows, columns), np.full(2, step), corner
        shape = pixels.rows, pixels.columns
        return PixelIntegrals.of(samples, pitch, origin, p, edge, shape, grid.means), upright


def _slices(inner: Box, outer: Box) -> tuple[slice, slice]:
    """Return a rectangle's rows and columns within another rectangle."""
    top = inner.top - outer.top
    left = inner.left - outer.left
    return slice(top, top + inner.rows), slice(left, left + inner.columns)
