"""Columns of weights, one for each wavelength, and the channels of an image that record them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray


def mix(image: NDArray[np.float32], matrix: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mix the channels of an image, (rows, columns, channels), by a matrix (new channels, channels)."""
    return image if np.array_equal(matrix, np.eye(len(matrix))) else np.asarray(image @ matrix.T)


def groups(wavelengths: tuple[float, ...]) -> Iterator[tuple[float, list[int]]]:
    """Yield each distinct wavelength and the columns that have it: they share their point spreads."""
    for wavelength in dict.fromkeys(wavelengths):
        yield wavelength, [column for column, other in enumerate(wavelengths) if other == wavelength]
