"""What a capture tells of the depth of points."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import require_number
from .spreads import DESIGN_ACCURACY, Gradient, Spreads

Step = tuple[float, float, float]


class DepthInformation:
    r"""How precisely noisy captures tell the depths of points whose other numbers are unknown, too.

    Of each point the place (X, Y, g) and the brightness w are unknown. With the expected counts of photons I and the
    background B of each pixel Fisher's information is

    .. math:: F_{ab} = \sum_p \frac{\partial_a I_p \, \partial_b I_p}{I_p + B}, \qquad
              \sigma_g = \sqrt{(F^{-1})_{gg}},

    the least standard deviation of an estimate of the depth without bias (Kay, "Fundamentals of statistical signal
    processing: estimation theory", 1993, chapter 3). The figure is the mean of :math:`-\ln \sigma_g` over the points:
    0.69 more halves all deviations. Derivatives by the place are central differences.

    Parameters
    ----------
    points : array (n, 3)
        Scene points (X, Y, g) in the camera frame, in millimetres.
    photons : float
        Of each point that pass the pupil.
    background : float
        Variance of each pixel without light, in photons; it must not be zero, or dark pixels would tell all.
    step : (float, float)
        Of the differences, sideways and in depth, in millimetres.
    wavelength, accuracy, method
        As of `CaptureOperator`.

    Raises
    ------
    InputError
        If an input has a wrong value.
    """

    def __init__(
        self,
        points: Any,
        photons: float,
        *,
        background: float = 1.0,
        step: tuple[float, float] = (0.005, 0.5),
        wavelength: float = 633.0,
        accuracy: float = DESIGN_ACCURACY,
        method: str = "patch",
    ) -> None:
        self._spreads = Spreads(points, wavelength, accuracy, method)
        self._photons = require_number("photons", photons, positive=True)
        self._background = require_number("background", background, positive=True)
        sideways, along = (require_number("step", part, positive=True) for part in step)
        self._steps: list[Step] = [(sideways, 0.0, 0.0), (0.0, sideways, 0.0), (0.0, 0.0, along)]

    def value(self, camera: PlenopticCamera) -> float:
        """Return the mean of -ln of the deviations of a camera."""
        return float(-np.log(self.deviations(camera)).mean())

    def deviations(self, camera: PlenopticCamera) -> NDArray[np.float64]:
        """Return the standard deviations of the depths of all points, in millimetres."""
        middle, *slopes = self.expected(camera)
        return np.array([np.sqrt(self._covariance(*parts)[2, 2]) for parts in zip(middle, *slopes, strict=True)])

    def expected(self, camera: PlenopticCamera) -> list[NDArray[np.float64]]:
        """Return the photons that are expected, (n, rows, columns), and their derivatives by X, Y and g."""
        photons = self._photons
        slopes = []
        for step in self._steps:
            there, back = (self._spreads.images(camera, _times(step, side)) for side in (1, -1))
            slopes.append(photons * (there - back) / (2 * sum(step)))
        return [photons * self._spreads.images(camera), *slopes]

    def gradient(self, camera: PlenopticCamera, names: Iterable[str]) -> tuple[float, Gradient]:
        """Return the figure, and its derivatives by numbers of the camera, by name."""
        names, expected = tuple(names), self.expected(camera)
        count = len(expected[0])
        cotangents = [np.zeros_like(part) for part in expected]
        value = 0.0
        for number, parts in enumerate(zip(*expected, strict=True)):
            covariance = self._covariance(*parts)
            variance, column = covariance[2, 2], covariance[2]
            value -= np.log(variance) / 2 / count
            # d ln(1 / sigma) = c' dF c / 2 sigma^2, with c the depth's column of the covariance.
            noise, columns = self._noise(parts[0]), _columns(*parts)
            along = np.tensordot(column, columns, 1)
            for back, part in zip(cotangents, [column[3], *column[:3]], strict=True):
                back[number] = part * along / noise / variance / count
            # The brightness w is relative: its derivative is the image itself.
            cotangents[0][number] -= along**2 / noise**2 / 2 / variance / count
        total: Gradient = {}
        for images, moved in self._moves(cotangents):
            found = self._spreads.gradient(camera, self._photons * images, names, moved)
            total = {name: part + total.get(name, 0.0) for name, part in found.items()}
        return float(value), total

    def _moves(self, cotangents: list[NDArray[np.float64]]) -> Iterator[tuple[NDArray[np.float64], Step]]:
        """Yield the gradients by all the spreads, and where their points are."""
        yield cotangents[0], (0.0, 0.0, 0.0)
        for step, given in zip(self._steps, cotangents[1:], strict=True):
            for side in (1, -1):
                yield side * given / (2 * sum(step)), _times(step, side)

    def _noise(self, expected: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the variances of the pixels."""
        return np.maximum(expected, 0) + self._background

    def _covariance(self, expected: NDArray[np.float64], *slopes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the least covariance of X, Y, g and the brightness of one point."""
        rows = _columns(expected, *slopes) / np.sqrt(self._noise(expected))
        flat = rows.reshape(len(rows), -1)
        return np.asarray(np.linalg.inv(flat @ flat.T))


def _columns(expected: NDArray[np.float64], *slopes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the derivatives by X, Y, g and the logarithm of the brightness."""
    return np.stack([*slopes, expected])


def _times(step: Step, factor: float) -> Step:
    x, y, g = step
    return factor * x, factor * y, factor * g
