"""Convolution of real images by SciPy's Fourier transforms.

`scipy.signal` gives the same; to import it takes longer than most reconstructions. So it is asked for large images
only, which it convolves part by part, in little memory.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

_LARGE = 2**24
"""Samples of an image from which on it is convolved part by part."""


def convolve(image: NDArray[Any], kernel: NDArray[Any]) -> NDArray[np.float64]:
    """Return all of the convolution of two images, n + k - 1 samples along each axis.

    Parameters
    ----------
    image, kernel : array (rows, columns)
        Of real numbers.
    """
    if image.size > _LARGE:
        from scipy.signal import oaconvolve

        return np.asarray(oaconvolve(image, kernel))
    size = [n + k - 1 for n, k in zip(image.shape, kernel.shape, strict=True)]
    quick = [scipy.fft.next_fast_len(n, real=True) for n in size]
    spectrum = scipy.fft.rfft2(np.asarray(image, np.float64), quick)
    spectrum *= scipy.fft.rfft2(np.asarray(kernel, np.float64), quick)
    return np.asarray(scipy.fft.irfft2(spectrum, quick, overwrite_x=True))[: size[0], : size[1]]


def blur(image: NDArray[Any], kernel: NDArray[Any]) -> NDArray[np.float64]:
    """Return the part of the convolution that lies on the image, with the kernel's middle on each sample."""
    rows, columns = ((k - 1) // 2 for k in kernel.shape)
    return convolve(image, kernel)[rows : rows + image.shape[0], columns : columns + image.shape[1]]
