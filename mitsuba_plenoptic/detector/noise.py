"""Noise of captures: its estimate from samples, and its compensation.

The estimate uses the spread of at most sixteen passes, so the value of each pixel has a relative error of
1/sqrt(32) = 18 % or more. Means over many pixels are more accurate. Wave captures compensate negative pixels, to first
order by a factor for each pixel; it reduces the estimate as well.
"""

from dataclasses import replace

import numpy as np

from ..camera import PlenopticCamera
from ..runtime import Array, Doubles, Floats, SumTask
from .operator import DetectorOperator

PARTS = 16
"""Count of independent passes from which the noise of a pixel is estimated."""


class PassSpread:
    """The mean of several passes of a capture, and its standard deviation from the passes' spread.

    Mitsuba's own integrator ``moment`` gives the spread of single samples, which is not known behind every camera.
    """

    def __init__(self) -> None:
        self.image: Floats = np.zeros((), np.float32)
        self._squares: Floats = np.zeros((), np.float32)
        self._samples = self._passes = 0

    def add(self, image: Floats, samples: int) -> None:
        """Add a pass, the mean of `samples` per pixel (West 1979, "Updating mean and variance estimates")."""
        self._samples += samples
        self._passes += 1
        difference = image - self.image
        self.image = self.image + difference * np.float32(samples / self._samples)
        self._squares = self._squares + np.float32(samples) * difference * (image - self.image)

    def deviation(self) -> Floats:
        """Return the standard deviation of the mean of two or more passes, with the shape of the image."""
        variance = self._squares / np.float32((self._passes - 1) * self._samples)
        return np.sqrt(np.maximum(variance, 0))


def keep_spread(task: SumTask, camera: PlenopticCamera) -> SumTask:
    """Return a run's task, with added channels from which `with_spread` computes variances of what is recorded.

    The detector lets neighbouring pixels deviate together, so that its variances do not follow from those of the light.
    """
    detector = DetectorOperator.of(camera)

    def combine(sums: Floats) -> Floats:
        image = task.combine(sums)
        recorded = detector.forward(image)
        return np.concatenate([image, recorded, recorded**2], axis=-1)

    return replace(task, combine=combine)


def with_spread(image: Floats, runs: int) -> Floats:
    """Return a capture and its variances from the sum of the images of several runs made by `keep_spread`."""
    captured, sums, squares = np.split(image, 3, axis=-1)
    spread = (squares - sums**2 / runs) * np.float32(runs / max(1, runs - 1))
    return np.concatenate([captured, np.maximum(spread, 0)], axis=-1)


class NonNegative:
    """An image whose negative values, which are noise, are compensated by the light around them.

    Clipping negative values to zero would brighten the image, the more so the fewer samples there are. Instead, squares
    of 2 x 2 pixels, squares of 2 x 2 of these squares, and so on up to the whole image keep their sums. A square with a
    sum below zero becomes black, and the other squares of the next larger square make up for it in proportion to their
    light. The result therefore has the sum of the image, or is black if that sum is below zero.
    """

    def __init__(self, image: Array):
        # Zeros count as positive: black pixels may become brighter.
        self._positive, self._light = image >= 0, np.maximum(image, 0)
        self.image: Array = self._light
        """The image, nowhere below zero."""
        self._squares: NonNegative | None = None
        if image.size > 1:
            self._squares, self._sum = NonNegative(_sums(image)), _sums(self._light)
            # The part of the light of each square that remains.
            self._factors = np.divide(self._squares.image, self._sum, out=np.ones_like(self._sum), where=self._sum > 0)
            self.image = _times(self._light, self._factors)

    @property
    def remaining(self) -> Doubles:
        """The part of each value of the image that remains: 0 for negative values, at most 1 for the others."""
        positive = self._positive.astype(np.float64)
        return positive if self._squares is None else _times(positive, self._factors)

    def forward(self, change: Array) -> Array:
        """Return the change of the result for a change of the image."""
        light = np.where(self._positive, change, 0)
        if self._squares is None:
            return light
        shares = self._over_sum(self._squares.forward(_sums(change)) - self._factors * _sums(light))
        return _times(light, self._factors) + _times(self._light, shares)

    def backward(self, gradient: Array) -> Array:
        """Return the gradient with respect to the image: the transpose of `forward` applied to a gradient."""
        if self._squares is None:
            return np.where(self._positive, gradient, 0)
        squares = self._over_sum(_sums(gradient * self._light))
        even = np.ones_like(gradient)
        light = _times(gradient, self._factors) - _times(even, self._factors * squares)
        result = np.where(self._positive, light, 0) + _times(even, self._squares.backward(squares))
        return result.astype(gradient.dtype)

    def _over_sum(self, values: Array) -> Array:
        """Return values of squares divided by the light of the squares, 0 for squares without light."""
        return np.divide(values, self._sum, out=np.zeros_like(values), where=self._sum > 0)


def variance_left(projection: NonNegative, variance: Floats, camera: PlenopticCamera) -> Doubles:
    """Return the part of each pixel's variance that compensation leaves, for variances of what the detector records.

    The factors of compensation count as constants. Mixed pixels have the mean of their neighbours' parts, weighted by
    variance.
    """
    detector = DetectorOperator.of(camera)
    complete, left = (detector.forward(variance * factor) for factor in (np.float64(1), projection.remaining**2))
    return np.divide(left, complete, out=np.zeros_like(left), where=complete > 0).clip(0, 1)


def _times(image: Array, factors: Doubles) -> Array:
    """Return an image times the factors of its squares of 2 x 2 pixels."""
    rows, columns = image.shape
    wide = factors.repeat(2, 1)[:, :columns]
    result = np.empty_like(image)
    for first in range(2):
        factor = wide[: (rows + 1 - first) // 2]
        target = result[first::2]
        np.multiply(image[first::2], factor, out=target, casting="same_kind")
    return result


def _sums(image: Array) -> Doubles:
    """Return the sums over squares of 2 x 2 pixels; beyond odd edges missing pixels count as 0."""
    if any(size % 2 for size in image.shape):
        image = np.pad(image, [(0, size % 2) for size in image.shape])
    rows = np.add(image[::2], image[1::2], dtype=np.float64)
    return rows[:, ::2] + rows[:, 1::2]
