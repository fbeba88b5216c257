"""Samples of a pupil's transmission on the square around it."""

import functools
import math

import numpy as np

from ..camera import Opening
from ..errors import WAVEFRONT_UNIT
from ..lenses import Wavefront
from ..optics import in_millimetres
from ..runtime import Array, Doubles, Numbers, Pair
from .accuracy import USUAL


class PupilSamples:
    """Transmission of a pupil, sampled over a square whose coordinates are divided by the pupil's radius."""

    def __init__(self, aperture: Opening, waves: Numbers = ()):
        """Take an opening, and coefficients of Noll's polynomials in waves of the light."""
        self.aperture = aperture
        # Power that passes at points of a grid that divides the samples, its means, and its integral over the square.
        x = along(USUAL.pupil_samples * USUAL.sample_points)
        fine = aperture.power(x + 0 * x[:, None], x[:, None] + 0 * x)
        self.power = means(fine, USUAL.pupil_samples)
        self.whole = float(self.power.mean()) * 4
        # Mean transmission of the samples, rows of rising y, with the aberrations as its phase.
        x = along(USUAL.pupil_samples)
        path = Wavefront(waves, 1.0).path(x + 0 * x[:, None], x[:, None] + 0 * x) if any(waves) else 0.0
        phasors = np.exp(2j * np.pi / in_millimetres(WAVEFRONT_UNIT) * path)
        self.transmission = means(np.sqrt(fine), USUAL.pupil_samples) * phasors


samples_of = functools.lru_cache(maxsize=4)(PupilSamples)
"""Return samples of a pupil, cached for further wavelengths and captures."""


def along(count: int) -> Doubles:
    """Return the middles of `count` samples across the pupil, over its radius."""
    return np.linspace(1 / count - 1, 1 - 1 / count, count)


def means(values: Array, count: int) -> Array:
    """Return the means over `count` x `count` samples of values on a grid that divides these."""
    finer = len(values) // count
    return values.reshape(count, finer, count, finer).mean((1, 3))


def spread_points(density: Doubles) -> Pair:
    """Return coordinates over the pupil's radius of points that have a density, given on samples of the square."""
    # As many as there are samples of the largest density, some of them several times.
    upto = np.cumsum(density) / density.max()
    index = np.searchsorted(upto, np.arange(math.floor(upto[-1])) + 0.5)
    row, column = np.divmod(index, len(density))
    return along(len(density))[column], along(len(density))[row]
