"""How integrals over pixels change where the pixels move, and the adjoint.

A pixel whose edges move gains what lies there: the intensity times the speed, over each edge.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .pixels import PixelAxis, PixelIntegrals, interpolation, product, weights


class MovedPixels:
    """A sum of products of weights along y and along x, as `PixelIntegrals` is one.

    Parameters
    ----------
    terms : list of pairs of sparse arrays
        Weights (pixels, samples) along y and along x.
    """

    def __init__(self, terms: list[tuple[Any, Any]]) -> None:
        self._terms = terms

    @classmethod
    def shifted(cls, pixels: PixelIntegrals, axis: int) -> MovedPixels:
        """Let all pixels move by 1 along x (axis 0) or y."""
        along_x, along_y = pixels.axes
        speed = np.ones(pixels.axes[axis].count + 1)
        if axis == 0:
            return cls([(weights(along_y), _at_edges(along_x, speed))])
        return cls([(_at_edges(along_y, speed), weights(along_x))])

    @classmethod
    def widened(cls, pixels: PixelIntegrals, middle: tuple[float, float], width: float) -> MovedPixels:
        """Let the detector grow about its middle, by 1 for its width."""
        along_x, along_y = pixels.axes
        speed_x, speed_y = ((axis.edges - centre) / width for axis, centre in zip(pixels.axes, middle, strict=True))
        return cls([(weights(along_y), _at_edges(along_x, speed_x)), (_at_edges(along_y, speed_y), weights(along_x))])

    @classmethod
    def shrunk(cls, pixels: PixelIntegrals, middle: tuple[float, float], scale: float) -> MovedPixels:
        """Let samples lie farther apart from the middle on, by one part in `scale`, their values held."""
        (along_x, along_y), narrower = pixels.axes, cls.widened(pixels, middle, -scale)
        return cls([*narrower._terms, (weights(along_y), weights(along_x) * np.float32(2 / scale))])

    @classmethod
    def turned(cls, pixels: PixelIntegrals, middle: tuple[float, float]) -> MovedPixels:
        """Turn the detector clockwise by one degree: as a lattice, that turns the other way, sees it."""
        degree = math.pi / 180
        moments = [
            weights(axis, moment=True) - weights(axis) * np.float32(centre)
            for axis, centre in zip(pixels.axes, middle, strict=True)
        ]
        edges = [_at_edges(axis, np.full(axis.count + 1, degree)) for axis in pixels.axes]
        return cls([(moments[1], edges[0]), (edges[1], -moments[0])])

    def forward(self, intensity: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the change of each pixel's integral, from samples per square millimetre, (rows, columns)."""
        return sum(product(along_y, intensity, along_x) for along_y, along_x in self._terms)

    def adjoint(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return for each sample the pixels weighted by what the sample gives to each of them."""
        return MovedPixels([(along_y.T.tocsr(), along_x.T.tocsr()) for along_y, along_x in self._terms]).forward(pixels)


def _at_edges(axis: PixelAxis, speed: NDArray[np.float64]) -> Any:
    """Return weights (pixels, samples) of the intensity at each pixel's last edge less that at its first, by speeds."""
    place = (axis.start + np.arange(axis.count + 1) * axis.pixel_size) / axis.pitch
    both = np.stack([place[:-1], place[1:]], -1)
    return interpolation(both, np.stack([-speed[:-1], speed[1:]], -1), axis.samples)
