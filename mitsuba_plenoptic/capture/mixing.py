"""Columns of weights, one for each wavelength, and the channels of an image that record them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..optics.spectrum import Spectrum


@dataclass(frozen=True)
class SpectralSum:
    """The sum of point spreads at one wavelength, of which an image has some.

    Attributes
    ----------
    wavelength : float
        In nanometres.
    before : float64 array (columns, k)
        What the columns of the weights are multiplied by.
    after : float32 array (channels, k)
        From what the sum makes of them to the channels of the image.
    """

    wavelength: float
    before: NDArray[np.float64]
    after: NDArray[np.float32]


def spectral_sums(
    wavelengths: tuple[float, ...], matrix: NDArray[np.float32], spectrum: Spectrum | None
) -> Iterator[SpectralSum]:
    """Yield the sums of which the image is the sum: one for each distinct wavelength, or for each node.

    Parameters
    ----------
    wavelengths : tuple of float
        Of each column of the weights.
    matrix : float32 array (channels, columns)
        From the columns to the image's channels.
    spectrum : Spectrum, optional
        Whose nodes count.
    """
    if spectrum is None or not spectrum.nodes:
        for wavelength, some in groups(wavelengths):
            yield SpectralSum(wavelength, np.eye(len(wavelengths))[:, some], matrix[:, some])
        return
    channels, columns = matrix.shape
    for node, share in zip(spectrum.nodes, spectrum.shares(), strict=True):
        if channels <= columns:
            yield SpectralSum(node, share[:, None] * matrix.T.astype(np.float64), np.eye(channels, dtype=np.float32))
        else:
            yield SpectralSum(node, np.diag(share), matrix)


def mix(image: NDArray[np.float32], matrix: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mix the channels of an image, (rows, columns, channels), by a matrix (new channels, channels)."""
    return image if np.array_equal(matrix, np.eye(len(matrix))) else np.asarray(image @ matrix.T)


def groups(wavelengths: tuple[float, ...]) -> Iterator[tuple[float, list[int]]]:
    """Yield each distinct wavelength and the columns that have it: they share their point spreads."""
    for wavelength in dict.fromkeys(wavelengths):
        yield wavelength, [column for column, other in enumerate(wavelengths) if other == wavelength]
