r"""Convolutions of coefficient images with kernels, which give the detector's pixels, and their adjoint.

The images extend beyond the recorded pixels on every side, as far as light can still reach these. They are cut into
tiles whose convolutions are added where they overlap (overlap-add: Oppenheim and Schafer, "Discrete-Time Signal
Processing", section 8.7), so that memory holds only part of an image and the spectra of its tiles.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..runtime import (
    Box,
    Floats,
    Part,
    Shape,
    active_backend,
    add,
    backend_of,
    fft,
    on_all_cores,
    on_cuda,
    single_threaded_blas,
)

TILE = 1536
"""Approximate width of the convolution of a tile in samples. Narrower ones repeat more of the kernels' borders."""


class Convolution:
    """Convolutions of images with kernels, computed one after another where the active variant's arrays lie."""

    def __init__(
        self,
        # The camera, whose recorded pixels are the result.
        camera: PlenopticCamera,
        # The kernels, arrays (k, k) of any odd sizes k.
        kernels: Sequence[Floats],
        # Largest rows and columns of samples that are convolved together; by default those of `box`.
        size: Shape | None = None,
    ):
        self._window = box_of(camera, 0)
        self._margin = margin_of(kernels)
        self.ranks, self.box = len(kernels), self._window.within(self._margin)
        support = 2 * self._margin + 1
        most = max(TILE - support, support)
        rows, columns = (
            # Equal parts, as few as possible.
            math.ceil(count / math.ceil(count / most))
            for count in size or (self.box.rows, self.box.columns)
        )
        self.tile = rows, columns
        self._size = tuple(fft.fast_length(tile + support - 1) for tile in self.tile)
        self._kernels = kernels
        # Memory of the spectra.
        self.bytes = 4 * self.ranks * math.prod(self._size)
        self._may_be_direct = camera.lens_data.images_stop and not on_cuda()
        # Elsewhere spectra are computed now, not by each of the threads that convolve.
        _ = self._may_be_direct or self.spectra

    @cached_property
    def spectra(self) -> list:
        """Spectra of the kernels, where the active variant's arrays lie."""
        libraries = active_backend()

        def transform(kernel: Floats) -> Any:
            wide = np.pad(kernel, self._margin - len(kernel) // 2)
            return libraries.transforms.rfft2(libraries.arrays.asarray(wide, np.float32), self._size)

        return on_all_cores(transform, self._kernels)

    def reached(self, box: Box) -> Box:
        """Return the recorded pixels, counted from the first, that light of the samples in a box can reach."""
        grown = box.within(self._margin)
        window = self._window
        low = np.maximum((grown.left - window.left, grown.top - window.top), 0)
        high = (grown.left + grown.columns - window.left, grown.top + grown.rows - window.top)
        return Box.between(low, np.minimum(high, (window.columns, window.rows)))

    def forward(self, images: Floats, box: Box | None = None, pixels: Box | None = None) -> Floats:
        """Return the sum (rows, columns) of all images (ranks, rows, columns), each convolved with its kernel."""
        box = box or self.box
        m = self._margin
        pixels = pixels or self.reached(self.box)
        recorded = Box(self._window.left + pixels.left, self._window.top + pixels.top, pixels.columns, pixels.rows)
        # Other processes import the libraries of the images' arrays themselves.
        libraries = backend_of(images)
        arrays = libraries.arrays
        transforms = libraries.transforms
        result = arrays.zeros((1, recorded.rows, recorded.columns), np.float32)

        def convolved(tile: tuple[slice, slice]) -> Part:
            rows, columns = tile
            size = rows.stop - rows.start, columns.stop - columns.start
            total = arrays.zeros(self.spectra[0].shape, np.complex64)
            for image, spectrum in zip(images, self.spectra, strict=True):
                samples = image[rows, columns]
                # Microlenses of this kind may be elsewhere; to ask a device takes longer than to go on.
                if libraries.is_cuda or samples.any():
                    transform = transforms.rfft2(samples, self._size)
                    transform *= spectrum
                    total += transform
            square = transforms.irfft2(total, self._size, overwrite_x=True)[: size[0] + 2 * m, : size[1] + 2 * m]
            return Part(Box(box.left + columns.start, box.top + rows.start, size[1], size[0]).within(m), square[None])

        with fft.resting_drjit():
            parts = self._direct(images, box) if self._may_be_direct else []
            for part in parts or on_all_cores(convolved, self._tiles(box)):
                add(part, recorded, result)
        return result[0]

    @single_threaded_blas()
    def _direct(self, images: Floats, box: Box) -> list[Part]:
        """Return the sum of images with few lit samples without transforms; nothing for others."""
        row, column = np.nonzero(images.any(0))
        width = 2 * self._margin + 1
        # 32: Samples of kernels, over those of a transform, whose sum takes less time than transforms.
        if len(row) * width**2 > 32 * math.prod(self._size):
            return []
        reached = box.within(self._margin)
        total = np.zeros((1, reached.rows, reached.columns), np.float32)
        light = np.tensordot(images[:, row, column], self._kernels, (0, 0))
        for top, left, square in zip(row, column, light, strict=True):
            total[0, top : top + width, left : left + width] += square
        return [Part(reached, total)]

    def adjoint(self, pixels: Floats, box: Box | None = None) -> list[Floats]:
        """Return one image per kernel by the adjoint of `forward`, from `pixels` (rows, columns)."""
        box = box or self.box
        m = self._margin
        reached = box.within(m)
        tiles = list(self._tiles(box))
        libraries = backend_of(self.spectra[0])
        arrays = libraries.arrays
        transforms = libraries.transforms
        samples = arrays.zeros((1, reached.rows, reached.columns), np.float32)
        add(Part(self._window, arrays.asarray(pixels)[None]), reached, samples)

        # The transform is circular: samples after these wrap around, and are cut off below.
        def transformed(tile: tuple[slice, slice]) -> NDArray[np.complex64]:
            rows, columns = tile
            surroundings = samples[0, rows.start : rows.stop + 2 * m, columns.start : columns.stop + 2 * m]
            return arrays.asarray(transforms.rfft2(surroundings, self._size))

        def correlated(spectrum: NDArray[np.complex64]) -> Floats:
            image = arrays.empty((box.rows, box.columns), np.float32)
            for transform, (rows, columns) in zip(parts, tiles, strict=True):
                square = transforms.irfft2(transform * spectrum.conj(), self._size, overwrite_x=True)
                image[rows, columns] = square[: rows.stop - rows.start, : columns.stop - columns.start]
            return image

        with fft.resting_drjit():
            parts = on_all_cores(transformed, tiles)
            return on_all_cores(correlated, self.spectra)

    def _tiles(self, box: Box) -> Iterator[tuple[slice, slice]]:
        """Yield the slices of rows and columns of each tile of a box."""
        rows, columns = self.tile
        for top in range(0, box.rows, rows):
            for left in range(0, box.columns, columns):
                yield slice(top, min(top + rows, box.rows)), slice(left, min(left + columns, box.columns))


def box_of(camera: PlenopticCamera, margin: int) -> Box:
    """Return the recorded pixels and a margin of pixels, counted from the full detector's corner."""
    left, top = camera.crop_offset
    return Box(left, top, camera.shape[1], camera.shape[0]).within(margin)


def margin_of(kernels: Sequence[Floats]) -> int:
    """Return the distance in samples from which light can still reach the recorded pixels."""
    # Kernels of different lens types have different widths.
    return max(len(kernel) for kernel in kernels) // 2


@dataclass(frozen=True)
class Block:
    """The images of a block of bins, to be convolved with the kernels."""

    bins: Box
    # For each convolution the images of the rays' coefficients, an array (ranks, rows, columns).
    images: list[Floats]
    convolutions: list[Convolution]
    # The channel to which each convolution is added; together they cover all channels from 0 on.
    channels: Sequence[int]

    @property
    def samples(self) -> int:
        """Number of samples in all images together."""
        return sum(image.size for image in self.images)

    def prepare(self) -> Callable[[], Part]:
        """Return the function that convolves the images."""
        return self._convolved

    def _convolved(self) -> Part:
        # Kernels of longer wavelengths reach farther.
        reached = (convolution.reached(self.bins) for convolution in self.convolutions)
        pixels = max(reached, key=lambda box: box.rows * box.columns)
        sums = active_backend().arrays.zeros((max(self.channels) + 1, pixels.rows, pixels.columns), np.float32)
        for channel, convolution, images in zip(self.channels, self.convolutions, self.images, strict=True):
            sums[channel] += convolution.forward(images, self.bins, pixels)
        return Part(pixels, sums)


def blocks_of(box: Box, most: int) -> list[Box]:
    """Return nearly square parts of a box with about `most` samples each, the largest first."""
    rows = math.ceil(box.rows / math.ceil(box.rows / math.sqrt(max(most, 1))))
    columns = math.ceil(box.columns / math.ceil(box.columns * rows / max(most, rows)))
    return [
        Box(box.left + left, box.top + top, min(columns, box.columns - left), min(rows, box.rows - top))
        for top in range(0, box.rows, rows)
        for left in range(0, box.columns, columns)
    ]
