"""From the images of what rays bring to the detector's pixels, and back: convolutions with the kernels of a bank.

The images have a few samples beyond the recorded pixels on every side, `margin`, from which light still arrives. They
are cut into overlapping squares (overlap-save), so that only one image and the spectra of squares are held.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import scipy
from numpy.typing import NDArray

from ...optics.sampling import fast_length
from ...runtime.fft import resting_drjit, worker_count

_TAIL = 8
"""Samples by which kernels grow when what collecting the rays has smoothed is sharpened again."""

_SQUARE = 512
"""Samples across a square, about."""


class Convolution:
    r"""Convolutions of images of one size.

    Parameters
    ----------
    kernels : float32 array (ranks, k, k)
        The kernels, k odd: fractions of the power on each sample.
    shape : (int, int)
        Rows and columns of what comes out.
    order : int
        How rays were collected in the images: 1 in the sample in which they arrive, 2 shared linearly by the
        nearest two along each axis. This smooths by :math:`\mathrm{sinc}^{order}` along each axis.
    """

    def __init__(self, kernels: NDArray[np.float32], shape: tuple[int, int], order: int) -> None:
        self._shape = shape
        self.margin = self.margin_of(kernels)
        support = 2 * self.margin + 1
        self._valid = [min(max(_SQUARE - support, support), size) for size in shape]
        self._size = tuple(fast_length(valid + support - 1) for valid in self._valid)
        self._spectra = np.empty((len(kernels), self._size[0], self._size[1] // 2 + 1), np.complex64)
        sharp = [np.sinc(scipy.fft.fftfreq(support)) ** -order, np.sinc(scipy.fft.rfftfreq(support)) ** -order]
        for spectrum, kernel in zip(self._spectra, kernels, strict=True):
            wide = scipy.fft.rfft2(np.pad(kernel, _TAIL)) * (sharp[0][:, None] * sharp[1])
            spectrum[...] = scipy.fft.rfft2(scipy.fft.irfft2(wide, (support, support)), self._size)

    @staticmethod
    def margin_of(kernels: NDArray[np.float32]) -> int:
        """Return the samples beyond the recorded ones from which some kernels bring light."""
        return kernels.shape[-1] // 2 + _TAIL

    @property
    def image_shape(self) -> tuple[int, int]:
        """Rows and columns of the images, margins included."""
        rows, columns = (size + 2 * self.margin for size in self._shape)
        return rows, columns

    def forward(self, images: Iterable[NDArray[np.float32]]) -> NDArray[np.float32]:
        """Convolve each image with its kernel, and add.

        Parameters
        ----------
        images : iterable of float32 arrays
            One for each kernel, of `image_shape`.

        Returns
        -------
        float32 array (rows, columns)
        """
        squares = list(self._squares())
        sums = np.zeros((len(squares), *self._spectra.shape[1:]), np.complex64)
        result = np.empty(self._shape, np.float32)
        with resting_drjit():
            for image, spectrum in zip(images, self._spectra, strict=True):
                for total, (rows, columns) in zip(sums, squares, strict=True):
                    part = self._transform(image[_wider(rows, self.margin), _wider(columns, self.margin)])
                    part *= spectrum
                    total += part
            for total, (rows, columns) in zip(sums, squares, strict=True):
                # the first samples are those that wrap
                square = self._back(total)[2 * self.margin :, 2 * self.margin :]
                result[rows, columns] = square[: rows.stop - rows.start, : columns.stop - columns.start]
        return result

    def adjoint(self, pixels: NDArray[np.float32]) -> Iterator[NDArray[np.float32]]:
        """Yield for each kernel the image whose product with any image is that of the pixels with its `forward`."""
        for spectrum in self._spectra:
            image = np.zeros(self.image_shape, np.float32)
            with resting_drjit():
                for rows, columns in self._squares():
                    part = self._transform(pixels[rows, columns])
                    part *= spectrum.conj()
                    square = np.roll(self._back(part), (2 * self.margin,) * 2, (0, 1))
                    target = image[_wider(rows, self.margin), _wider(columns, self.margin)]
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
