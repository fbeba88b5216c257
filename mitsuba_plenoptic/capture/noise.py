"""The noise of a capture's pixels: their standard deviation, estimated from the samples that made them.

The estimate uses the spread of at most sixteen passes, so the value of each pixel has a relative error of
1/sqrt(32) = 18 % or more. Means over many pixels are more accurate.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import refuse_if
from ..runtime.jobs import SumTask

PARTS = 16
"""Count of independent passes from which the noise of a pixel is estimated."""


def require_samples(spp: int) -> None:
    """Refuse fewer than two samples, which have no spread."""
    refuse_if(spp < 2, f"spp = {spp}: it must be at least 2 for an estimate of the noise")


class PassSpread:
    """The mean of passes, and its standard deviation from their spread.

    Mitsuba's own integrator ``moment`` gives the spread of single samples, but omits the weights of rays, which a
    plenoptic sensor needs.
    """

    def __init__(self) -> None:
        self.image: NDArray[np.float32] = np.zeros((), np.float32)
        self._squares: NDArray[np.float32] = np.zeros((), np.float32)
        self._samples = self._passes = 0

    def add(self, image: NDArray[np.float32], samples: int) -> None:
        """Add a pass, the mean of `samples` per pixel (West 1979, "Updating mean and variance estimates")."""
        self._samples += samples
        self._passes += 1
        difference = image - self.image
        self.image = self.image + difference * np.float32(samples / self._samples)
        self._squares = self._squares + np.float32(samples) * difference * (image - self.image)

    def deviation(self) -> NDArray[np.float32]:
        """Return the standard deviation of the mean of two or more passes, with the shape of the image."""
        variance = self._squares / np.float32((self._passes - 1) * self._samples)
        return np.asarray(np.sqrt(np.maximum(variance, 0)))


def keep_spread(task: SumTask) -> SumTask:
    """Add to the image of one of several independent runs the channels from which `with_spread` computes variances."""

    def combine(sums: NDArray[np.float32]) -> NDArray[np.float32]:
        image = task.combine(sums)
        return np.concatenate([image, image, image**2], axis=-1)

    return replace(task, combine=combine)


def with_spread(image: NDArray[np.float32], runs: int) -> NDArray[np.float32]:
    """Return a capture and its variances from the sum of the images of runs by `keep_spread`."""
    whole, sums, squares = np.split(image, 3, axis=-1)
    spread = (squares - sums**2 / runs) * np.float32(runs / max(1, runs - 1))
    return np.concatenate([whole, np.maximum(spread, 0)], axis=-1)


Image = NDArray[np.float32]


class Mended:
    """An image whose negative values, which are due to noise, are compensated by the light around them.

    Clipping them to zero would brighten dark regions, and the more so the fewer samples there are.
    """

    def __init__(self, image: Image, size: int) -> None:
        # Zeros count as positive: black pixels may become brighter.
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
        """Return the change of the result for a change of the image."""
        light = np.where(self._positive, change, 0)
        share = self._over_around(self._blur(light - change) - self._share * self._blur(light))
        return np.asarray(light * (1 - self._share) - self._light * share, np.float32)

    def backward(self, gradient: Image) -> Image:
        """Apply the transpose of `forward`."""
        lack = -self._over_around(self._light * gradient)
        light = gradient * (1 - self._share) + self._blur(lack * (1 - self._share))
        return np.asarray(np.where(self._positive, light, 0) - self._blur(lack), np.float32)

    def _over_around(self, values: NDArray[Any]) -> NDArray[Any]:
        """Divide by the light around, or return 0 where it does not suffice."""
        return np.divide(values, self._around, out=np.zeros_like(values), where=self._shares)

    def _blur(self, image: NDArray[Any]) -> Image:
        """Return the means over square windows; with reflecting edges the operation is its own transpose."""
        from scipy.ndimage import uniform_filter

        return np.asarray(uniform_filter(image, self._size), np.float32)
