"""The noise of a capture's pixels: their standard deviation, estimated from the samples that made them.

By rays it comes from the spread of passes, by waves from the spread of the light paths of each radiator. Both estimates
rest on sixteen independent numbers a pixel, so that each pixel's figure has itself a relative error of
1/sqrt(32) = 18 %; means over many pixels are that much better known.
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


def with_halves(deviations: NDArray[np.float64], generator: np.random.Generator) -> NDArray[np.float64]:
    r"""Return weights of radiators by whose sums `variance_of` finds the variance of the sum of all.

    A pixel is the sum of :math:`a_r w_r` over radiators, whose weights have the standard deviations :math:`\sigma_r`;
    its variance is :math:`\sum_r a_r^2 \sigma_r^2`, the mean square of :math:`\sum_r \pm a_r \sigma_r` over random
    signs. So that no weight is negative, that sum is taken as twice a random half less the whole.

    Parameters
    ----------
    deviations : array (n,)
        Standard deviation of each weight.
    generator : numpy.random.Generator
        Source of the signs.

    Returns
    -------
    float64 array (n, 1 + PARTS)
        All deviations, and random halves of them.
    """
    halves = generator.integers(0, 2, (len(deviations), PARTS))
    return np.hstack([deviations[:, None], halves * deviations[:, None]])


def variance_of(sums: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the variance of each pixel, (rows, columns), from the sums (rows, columns, 1 + PARTS) by `with_halves`."""
    variance = np.zeros(sums.shape[:2], np.float32)
    for half in range(1, 1 + PARTS):
        variance += (2 * sums[..., half] - sums[..., 0]) ** 2
    return np.asarray(variance / np.float32(PARTS))


def keep_variances(task: Task, channels: list[int], count: int, total: int) -> Task:
    """Let a sum whose weights are those of some channels, and then of `with_halves` for each, give image and variance.

    Parameters
    ----------
    task : Task
        The sum.
    channels : list of int
        The channels of the capture that it brings.
    count : int
        How many there are in all.
    total : int
        Channels of the image, `count` of the capture and as many of their variances first; the others are zero.

    Returns
    -------
    Task
    """

    def combine(sums: NDArray[np.float32]) -> NDArray[np.float32]:
        image = np.zeros((*sums.shape[:2], total), np.float32)
        for index, channel in enumerate(channels):
            first = len(channels) + index * (1 + PARTS)
            image[..., channel] = sums[..., index]
            image[..., count + channel] = variance_of(sums[..., first : first + 1 + PARTS])
        return image

    return replace(task, combine=combine)


def keep_spread(task: Task) -> Task:
    """Let one of several independent runs, whose images are to be added, bring what `with_spread` needs of it."""

    def combine(sums: NDArray[np.float32]) -> NDArray[np.float32]:
        image = task.combine(sums)
        return np.concatenate([image, np.zeros_like(image), image, image**2], axis=-1)

    return replace(task, combine=combine)


def with_spread(image: NDArray[np.float32], runs: int) -> NDArray[np.float32]:
    """Return capture and variances, with that from the spread of some runs by `keep_spread`."""
    whole, variance, sums, squares = np.split(image, 4, axis=-1)
    spread = (squares - sums**2 / runs) * np.float32(runs / max(1, runs - 1))
    return np.concatenate([whole, variance + np.maximum(spread, 0)], axis=-1)
