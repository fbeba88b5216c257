"""Columns of weights, one for each wavelength, and the channels of an image that record them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..optics.spectrum import Spectrum


@dataclass(frozen=True)
class SpectralSum:
    """The sum of point spreads at one wavelength, of which an image has some."""

    wavelength: float  # in nanometres
    before: NDArray[np.float64]  # (columns, k): what the columns of the weights are multiplied by
    after: NDArray[np.float32]  # (channels, k): from what the sum makes of them to the channels of the image

    def reduced(self, weights: NDArray[np.float64], errors: NDArray[np.float64]) -> SpectralSum:
        """Return it with as few columns as tell the weights of some points: one where all have the same spectrum.

        Spectra that change little between nodes give channels nearly the same weights but for a factor, and every
        column is added to the image copy by copy.

        In each of the channels of the image weights of the root sum square `errors` may be left out.
        """
        given = weights @ self.before
        # In a fixed order: what is kept half done in a checkpoint is of these very columns.
        powers, vectors = np.linalg.eigh(np.einsum("ni,nj->ij", given, given))
        left = np.cumsum(np.maximum(powers, 0) * (self.after.astype(np.float64) @ vectors) ** 2, axis=1)
        dropped = int(np.argmin(np.append(np.all(np.sqrt(left) <= errors[:, None], axis=0), False)))
        kept = vectors[:, min(dropped, len(vectors) - 1) :]
        if kept.shape[1] == len(vectors):
            return self
        return SpectralSum(self.wavelength, self.before @ kept, (self.after @ kept).astype(np.float32))


def spectral_sums(
    wavelengths: tuple[float, ...], matrix: NDArray[np.float32], spectrum: Spectrum | None
) -> Iterator[SpectralSum]:
    """Yield the sums of which the image is the sum: one for each distinct wavelength, or for each node.

    `matrix` leads from the columns of the weights, each of its wavelength, to the channels of the image.
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
