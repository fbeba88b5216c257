"""Pixels that chance has left below zero: what they lack is taken from the light around them, and its derivatives."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]


class Mended:
    """An image without what is below zero, by chance: it is taken from the light around.

    To set it to zero would brighten what is dark, the more the fewer samples there are.

    Parameters
    ----------
    image : float32 array (rows, columns)
        As it was computed.
    size : int
        Pixels, across, of the squares that share what they lack.
    """

    def __init__(self, image: Image, size: int) -> None:
        # What is black may become brighter.
        self._size, self._positive = size, image >= 0
        self._light = np.maximum(image, 0)
        self._around = self._blur(self._light)
        lack = self._blur(self._light - image)
        share = np.divide(lack, self._around, out=np.zeros_like(image), where=self._around > 0)
        self._shares, self._share = (self._around > 0) & (share < 1), np.minimum(share, 1)

    @property
    def image(self) -> Image:
        """The image, nowhere below zero."""
        return np.asarray(self._light * (1 - self._share), np.float32)

    def forward(self, change: Image) -> Image:
        """Return by how much it changes with the image."""
        light = np.where(self._positive, change, 0)
        share = self._over_around(self._blur(light - change) - self._share * self._blur(light))
        return np.asarray(light * (1 - self._share) - self._light * share, np.float32)

    def backward(self, gradient: Image) -> Image:
        """Apply the transpose of `forward`."""
        lack = -self._over_around(self._light * gradient)
        light = gradient * (1 - self._share) + self._blur(lack * (1 - self._share))
        return np.asarray(np.where(self._positive, light, 0) - self._blur(lack), np.float32)

    def _over_around(self, values: NDArray[Any]) -> NDArray[Any]:
        """Divide by the light around, where there is enough of it."""
        return np.divide(values, self._around, out=np.zeros_like(values), where=self._shares)

    def _blur(self, image: NDArray[Any]) -> Image:
        """Return the means of squares; at the edges, which reflect, this is its own transpose, too."""
        from scipy.ndimage import uniform_filter

        return np.asarray(uniform_filter(image, self._size), np.float32)
