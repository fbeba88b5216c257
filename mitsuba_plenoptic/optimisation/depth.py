"""What a capture tells of the depth of points."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import require_number
from .spreads import DESIGN_ACCURACY, Gradient, Spreads

_WAVES = 0.01
"""Waves by which a point is moved: the change of its path to the rim of the pupil, against that to the middle."""


@dataclass(frozen=True)
class _Move:
    """Two places of every point, (n, 3), and by what the difference of their spreads is a derivative, (n, 1, 1)."""

    there: NDArray[np.float64]
    back: NDArray[np.float64]
    factor: NDArray[np.float64]


class DepthInformation:
    r"""How precisely noisy captures tell the depths of points whose other numbers are unknown, too.

    Of each point the place (X, Y, g) and the brightness w are unknown. With the expected counts of photons I and the
    background B of each pixel Fisher's information is

    .. math:: F_{ab} = \sum_p \frac{\partial_a I_p \, \partial_b I_p}{I_p + B}, \qquad
              \sigma_g = \sqrt{(F^{-1})_{gg}},

    the least standard deviation of an estimate of the depth without bias (Kay, "Fundamentals of statistical signal
    processing: estimation theory", 1993, chapter 3). The figure is the mean of :math:`-\ln \sigma_g` over the points:
    0.69 more halves all deviations. Derivatives by the place are central differences, sideways and along the chief ray,
    there of the vergence 1/g, to both sides by a hundredth of a wave of path at the rim of the pupil.

    Parameters
    ----------
    points : array (n, 3)
        Scene points (X, Y, g) in the camera frame, in millimetres.
    photons : float
        Of each point that pass the pupil.
    background : float
        Variance of each pixel without light, in photons; it must not be zero, or dark pixels would tell all.
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
        wavelength: float = 633.0,
        accuracy: float = DESIGN_ACCURACY,
        method: str = "patch",
    ) -> None:
        self._spreads = Spreads(points, wavelength, accuracy, method)
        self._photons = require_number("photons", photons, positive=True)
        self._background = require_number("background", background, positive=True)

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
        for move in self._moves(camera):
            there, back = (self._spreads.images(camera, points) for points in (move.there, move.back))
            slopes.append(photons * move.factor * (there - back))
        for slope, tilt in zip(slopes[:2], self._tilts(camera), strict=True):
            slopes[2] = slopes[2] - tilt * slope
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
        for points, images in self._moved(camera, cotangents):
            found = self._spreads.gradient(camera, self._photons * images, names, points)
            total = {name: part + total.get(name, 0.0) for name, part in found.items()}
        return float(value), total

    def _moved(
        self, camera: PlenopticCamera, cotangents: list[NDArray[np.float64]]
    ) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Yield where points are, and the gradients by their spreads."""
        image, *along, depth = cotangents
        yield self._spreads.points, image
        tilts = self._tilts(camera)
        given = [*(part - tilt * depth for part, tilt in zip(along, tilts, strict=True)), depth]
        for move, part in zip(self._moves(camera), given, strict=True):
            yield move.there, move.factor * part
            yield move.back, -move.factor * part

    def _tilts(self, camera: PlenopticCamera) -> list[NDArray[np.float64]]:
        """Return X and Y of the chief rays for each g, (n, 1, 1); behind an objective these run along the axis."""
        x, y, g = self._spreads.points.T[..., None, None]
        return [x / g, y / g] if camera.lens_data.converges else [0 * x, 0 * y]

    def _moves(self, camera: PlenopticCamera) -> list[_Move]:
        """Return the moves along X, along Y and along the chief ray, by the vergence, whose differences are slopes."""
        points = self._spreads.points
        g, path = points[:, 2], _WAVES * self._spreads.wavelength * 1e-6
        objective = camera.objective
        if objective is None:
            sideways, step = path * np.abs(g) / camera.aperture_radius, 2 * path / camera.aperture_radius**2
            near, far = 1 / (1 / g + step), 1 / (1 / g - step)
            there, back = points * (near / g)[:, None], points * (far / g)[:, None]
            rate = -1 / (2 * step * g**2)
        else:
            aperture = objective.numerical_aperture
            sideways, step = np.full(len(g), path / aperture), 2 * path * objective.immersion / aperture**2
            there, back = (points + np.array([0, 0, side * step]) for side in (1, -1))
            rate = np.full(len(g), 1 / (2 * step))
        moves = []
        for axis in (0, 1):
            along = sideways[:, None] * (np.arange(3) == axis)
            moves.append(_Move(points + along, points - along, (1 / (2 * sideways))[:, None, None]))
        return [*moves, _Move(there, back, rate[:, None, None])]

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
