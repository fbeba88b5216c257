r"""From the images of what rays bring to the detector's pixels, and back: convolutions with the kernels of banks.

The images have samples beyond the recorded pixels on every side, from which light still arrives. They are cut into
overlapping squares (overlap-save), so that only one image and the spectra of squares are held.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...optics.sampling import fast_length
from ...runtime.batches import Box
from ...runtime.fft import resting_drjit, worker_count
from .lens_bank import LensBank

_TAIL = 8
"""Samples by which kernels grow when what collecting the rays has smoothed is sharpened again."""

_SQUARE = 768
"""Samples across a square, about."""


class Convolution:
    r"""Convolutions with the kernels of some banks of a camera, one after another.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera; the recorded pixels are what comes out.
    banks : sequence of LensBank
        One for each type of lenses, of the same pitch.
    order : int
        How rays were collected in the images: 1 in the sample in which they arrive, 4 shared by the nearest four
        along each axis, by a cubic B-spline. This smooths by :math:`\mathrm{sinc}^{order}` along each axis.

    Attributes
    ----------
    box : Box
        The samples of the images, counted from the full detector's corner.
    pitch : float
        Their distance in millimetres.
    ranks : int
        Images in all.
    """

    def __init__(self, camera: PlenopticCamera, banks: Sequence[LensBank], order: int) -> None:
        self.pitch = banks[0].pitch
        self._parts = round(camera.pixel_size / self.pitch)
        self._shape = camera.shape[0] * self._parts, camera.shape[1] * self._parts
        kernels = [kernel for bank in banks for kernel in bank.kernels]
        # banks of different types of lenses have kernels of different widths
        self._margin = max(kernel.shape[0] for kernel in kernels) // 2 + _TAIL
        self.ranks, m = len(kernels), self._margin
        left, top = (offset * self._parts - m for offset in camera.crop_offset)
        self.box = Box(left, top, self._shape[1] + 2 * m, self._shape[0] + 2 * m)
        support = 2 * m + 1
        self._valid = [min(max(_SQUARE - support, support), size) for size in self._shape]
        self._size = tuple(fast_length(valid + support - 1) for valid in self._valid)
        self._spectra = np.empty((self.ranks, self._size[0], self._size[1] // 2 + 1), np.complex64)
        sharp = [np.sinc(frequency(support)) ** -order for frequency in (scipy.fft.fftfreq, scipy.fft.rfftfreq)]
        for spectrum, kernel in zip(self._spectra, kernels, strict=True):
            wide = scipy.fft.rfft2(np.pad(kernel, m - kernel.shape[0] // 2)) * (sharp[0][:, None] * sharp[1])
            spectrum[...] = scipy.fft.rfft2(scipy.fft.irfft2(wide, (support, support)), self._size)

    @property
    def memory(self) -> float:
        """Bytes that a convolution takes, beside the images."""
        squares = math.prod(math.ceil(size / valid) for size, valid in zip(self._shape, self._valid, strict=True))
        return float((squares + self.ranks) * self._spectra[0].nbytes + 8 * math.prod(self._shape))

    def forward(self, images: Iterable[NDArray[np.float32]]) -> NDArray[np.float32]:
        """Convolve each image with its kernel, and add.

        Parameters
        ----------
        images : iterable of float32 arrays
            One for each kernel, of the samples of `box`: what rays bring of it.

        Returns
        -------
        float32 array (rows, columns)
            Integrals over the recorded pixels.
        """
        squares = list(self._squares())
        sums = np.zeros((len(squares), *self._spectra.shape[1:]), np.complex64)
        result = np.empty(self._shape, np.float32)
        with resting_drjit():
            for image, spectrum in zip(images, self._spectra, strict=True):
                for total, (rows, columns) in zip(sums, squares, strict=True):
                    part = self._transform(image[_wider(rows, self._margin), _wider(columns, self._margin)])
                    part *= spectrum
                    total += part
            for total, (rows, columns) in zip(sums, squares, strict=True):
                # the first samples are those that wrap
                square = self._back(total)[2 * self._margin :, 2 * self._margin :]
                result[rows, columns] = square[: rows.stop - rows.start, : columns.stop - columns.start]
        p = self._parts
        return result.reshape(self._shape[0] // p, p, self._shape[1] // p, p).sum((1, 3)) if p > 1 else result

    def adjoint(self, pixels: NDArray[np.float32]) -> Iterator[NDArray[np.float32]]:
        """Yield for each kernel the image whose product with any image is that of the pixels with its `forward`."""
        samples = pixels.repeat(self._parts, 0).repeat(self._parts, 1)
        for spectrum in self._spectra:
            image = np.zeros((self.box.rows, self.box.columns), np.float32)
            with resting_drjit():
                for rows, columns in self._squares():
                    part = self._transform(samples[rows, columns])
                    part *= spectrum.conj()
                    square = np.roll(self._back(part), (2 * self._margin,) * 2, (0, 1))
                    target = image[_wider(rows, self._margin), _wider(columns, self._margin)]
                    target += square[: target.shape[0], : target.shape[1]]
            yield image

    def _squares(self) -> Iterator[tuple[slice, slice]]:
        """Yield which pixels each square is for."""
        (height, width), (rows, columns) = self._shape, self._valid
        for top in range(0, height, rows):
            for left in range(0, width, columns):
                yield slice(top, min(top + rows, height)), slice(left, min(left + columns, width))

    def _transform(self, samples: NDArray[np.float32]) -> NDArray[np.complex64]:
        return scipy.fft.rfft2(samples, self._size, workers=worker_count())

    def _back(self, spectrum: NDArray[np.complex64]) -> NDArray[np.float32]:
        return scipy.fft.irfft2(spectrum, self._size, overwrite_x=True, workers=worker_count())


def _wider(pixels: slice, margin: int) -> slice:
    """Return which samples of the images, margins included, some pixels feel."""
    return slice(pixels.start, pixels.stop + 2 * margin)
