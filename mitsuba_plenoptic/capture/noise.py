"""The noise of a capture's pixels: their standard deviation, estimated from the samples that made them.

It comes from the spread of sixteen passes at most, so that each pixel's figure has itself a relative error of
1/sqrt(32) = 18 % or more; means over many pixels are that much better known.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..runtime.jobs import Task

PARTS = 16
"""Independent numbers from which the noise of a pixel is estimated."""


def require_samples(spp: int) -> None:
    """Refuse a number of samples that tells nothing of their spread.

    Raises
    ------
    InputError
        If it is below 2.
    """
    if spp < 2:
        raise InputError(f"spp = {spp}: it must be at least 2 for an estimate of the noise")


class PassSpread:
    """The mean of passes, and its standard deviation from their spread.

    Mitsuba's own integrator ``moment`` would tell the spread of single samples, but leaves out the weight of each ray,
    which a plenoptic sensor needs.
    """

    def __init__(self) -> None:
        self.image: NDArray[np.float32] = np.zeros((), np.float32)
        self._squares: NDArray[np.float32] = np.zeros((), np.float32)
        self._samples = self._passes = 0

    def add(self, image: NDArray[np.float32], samples: int) -> None:
        """Add a pass, the mean of so many samples per pixel (West 1979, "Updating mean and variance estimates")."""
        self._samples += samples
        self._passes += 1
        difference = image - self.image
        self.image = self.image + difference * np.float32(samples / self._samples)
        self._squares = self._squares + np.float32(samples) * difference * (image - self.image)

    def deviation(self) -> NDArray[np.float32]:
        """Return the standard deviation of the mean of two passes or more, as large as the image."""
        variance = self._squares / np.float32((self._passes - 1) * self._samples)
        return np.asarray(np.sqrt(np.maximum(variance, 0)))


def keep_spread(task: Task) -> Task:
    """Let one of several independent runs, whose images are to be added, bring what `with_spread` needs of it."""

    def combine(sums: NDArray[np.float32]) -> NDArray[np.float32]:
        image = task.combine(sums)
        return np.concatenate([image, image, image**2], axis=-1)

    return replace(task, combine=combine)


def with_spread(image: NDArray[np.float32], runs: int) -> NDArray[np.float32]:
    """Return a capture and its variances from the spread of some runs by `keep_spread`."""
    whole, sums, squares = np.split(image, 3, axis=-1)
    spread = (squares - sums**2 / runs) * np.float32(runs / max(1, runs - 1))
    return np.concatenate([whole, np.maximum(spread, 0)], axis=-1)
