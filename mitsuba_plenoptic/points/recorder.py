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
    ) -> None:
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

    def _turned(self, low: Doubles, high: Doubles, degrees: float) -> tuple[Doubles, Doubles]:
        """Return the bounds of a rectangle, given from the detector's corner, after a turn about the axis."""
        if degrees == 0:
            return low, high
        x, y = (np.array([low[axis], low[axis], high[axis], high[axis]]) + self._grid.origin[axis] for axis in (0, 1))
        corners = np.stack(turn(x, y[[0, 2, 0, 2]], degrees), -1) - self._grid.origin
        return corners.min(0), corners.max(0)

    @property
    def count(self) -> int:
        """Number of recorded pixels."""
        return self._pixels.rows * self._pixels.columns

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
        upright = samples if self._upright is None else self._upright.forward(samples)
        return active_backend().to_host(self._pixels_of(move).forward(upright))

    def spread(self, image: Floats, move: str | None = None) -> Floats:
        """Return the adjoint of `record`: grid samples from an image."""
        arrays = active_backend().arrays
        channels = []
        for channel in np.moveaxis(image[self.window], -1, 0):
            samples = self._pixels_of(move).adjoint(arrays.asarray(np.ascontiguousarray(channel, np.float32)))
            channels.append(samples if self._upright is None else self._upright.adjoint(samples))
        return channels[0][None] if len(channels) == 1 else arrays.stack(channels)

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the pixels in the image."""
        left = self._pixels.left
        top = self._pixels.top
        left = left - self._camera.crop_offset[0]
        top = top - self._camera.crop_offset[1]
        return slice(top, top + self._pixels.rows), slice(left, left + self._pixels.columns)

    @property
    def _is_resampled(self) -> bool:
        return self._grid.rotation != 0 or self._regular is not None

    @property
    def _edge(self) -> tuple[float, float]:
        """X and y of the first pixel's corner, relative to the detector's corner."""
        p = self._camera.pixel_size
        return self._pixels.left * p, self._pixels.top * p

    @property
    def _origin(self) -> tuple[float, float]:
        """X and y of the first sample in the lattice's frame, relative to the detector's corner."""
        pitch = self._grid.pitch
        size = (self._camera.detector_width, self._camera.detector_height)
        x, y = np.array([self.box.left, self.box.top]) * pitch + (self._grid.origin + np.array(size) / 2)
        return float(x), float(y)

    def _pixels_of(self, move: str | None) -> PixelIntegrals:
        """Return the integrals over the pixels, or their changes as the pixels move."""
        if move is None:
            return self._integrals
        if move in STEPS:
            return self._integrals.shifted(STEPS.index(move))
        width = self._camera.detector_width
        axis = width / 2, self._camera.detector_height / 2
        if move == "mla_rotation":
            return self._integrals.turned(axis)
        if move == "wavelength":
            return self._integrals.shrunk(axis, self._grid.wavelength)
        return self._integrals.widened(axis, width)

    @cached_property
    def _integrals(self) -> PixelIntegrals:
        if self._whole is not None and not self._is_resampled:
            parent = self._whole
            return parent._integrals.cut(_slices(self._pixels, parent._pixels), _slices(self.box, parent.box))
        x, y = self._grid.pitch.tolist()
        pitch = (x, y)
        origin = self._origin
        samples = (self.box.rows, self.box.columns)
        if self._is_resampled:
            step = min(pitch)
            pitch = (step, step)
            origin = self._upright_origin
            samples = self._upright_shape
        shape = self._pixels.rows, self._pixels.columns
        return PixelIntegrals.of(samples, pitch, origin, self._camera.pixel_size, self._edge, shape, self._grid.means)

    @cached_property
    def _upright(self) -> TurnedSamples | None:
        """Resampling from regular lenses in the lattice frame to the camera frame; None if nothing is to be moved."""
        grid = self._grid
        if not self._is_resampled:
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
            self._regular,
        )

    @property
    def _upright_shape(self) -> tuple[int, int]:
        p = self._camera.pixel_size
        step = float(self._grid.pitch.min())
        rows, columns = (math.ceil(count * p / step) + 2 * _EDGE for count in (self._pixels.rows, self._pixels.columns))
        return rows, columns

    @property
    def _upright_origin(self) -> tuple[float, float]:
        step = float(self._grid.pitch.min())
        return self._edge[0] - _EDGE * step, self._edge[1] - _EDGE * step


def _slices(inner: Box, outer: Box) -> tuple[slice, slice]:
    """Return a rectangle's rows and columns within another rectangle."""
    top = inner.top - outer.top
    left = inner.left - outer.left
    return slice(top, top + inner.rows), slice(left, left + inner.columns)
