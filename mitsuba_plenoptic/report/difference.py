r"""How far two captures are apart, and how much of that is the noise of their samples.

Of two captures a and b of expectations A and B, with independent noise of the standard deviations
:math:`\sigma_a, \sigma_b` in each pixel,

.. math:: E \sum (a - b)^2 = \sum (A - B)^2 + \sum (\sigma_a^2 + \sigma_b^2)

so that what is left of the squared difference, less both captures' variances, does not depend on how many samples were
taken.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from ..camera import PlenopticCamera
from ..io.captures import Capture
from ..lightfield.white import white_image

_MIDDLE = 0.8
"""Radius of a micro-image's middle, seen through which nothing of the pupil's edge is near, over the whole radius."""

_DEVIATIONS = 3.0
"""Standard deviations beyond which a difference is more than noise."""

_ESTIMATE = 0.03
"""Part of the variances by which they may be wrong themselves: their estimates rest on sixteen numbers a pixel."""


@dataclass(frozen=True)
class Difference:
    """A difference of captures over some pixels; root mean squares over that of the second capture, all pixels.

    Attributes
    ----------
    measured : float
        What is measured, noise and all.
    noise : float or None
        What noise alone would give; None if one of the captures does not know its noise.
    true : float or None
        The difference without noise.
    noise_alone : bool or None
        Whether noise is enough to explain what is measured.
    """

    measured: float
    noise: float | None
    true: float | None
    noise_alone: bool | None

    def to_dict(self) -> dict[str, float | bool | None]:
        """Return the numbers by name, rounded to what they mean."""
        return {name: round(value, 5) if isinstance(value, float) else value for name, value in asdict(self).items()}


def capture_difference(a: Capture, b: Capture, pixels: np.ndarray | None = None) -> Difference:
    """Compare two captures of one camera, over some pixels or over all."""
    where = np.ones(b.image.shape, bool) if pixels is None else pixels
    reference = float(np.sum(np.square(b.image, dtype=np.float64)))
    squares = float(np.sum(np.square(a.image.astype(np.float64) - b.image)[where]))
    measured = _root(squares, reference)
    if a.noise is None or b.noise is None:
        return Difference(measured, None, None, None)
    variances = (np.square(a.noise, dtype=np.float64) + np.square(b.noise, dtype=np.float64))[where]
    expected = float(variances.sum())
    # A squared normal deviate has twice the square of its variance for a variance.
    uncertain = math.sqrt(2 * float(np.sum(variances**2)))
    excess = squares - expected
    alone = excess <= max(_DEVIATIONS * uncertain, _ESTIMATE * expected)
    return Difference(measured, _root(expected, reference), _root(excess, reference), alone)


def middle_of_micro_images(camera: PlenopticCamera) -> np.ndarray:
    """Mark the pixels that see the main lens's middle, within four fifths of its radius; (rows, columns) bool array."""
    return np.asarray(white_image(camera.replace(aperture_radius=_MIDDLE * camera.aperture_radius)) > 0.5)


def _root(squares: float, reference: float) -> float:
    return math.sqrt(max(squares, 0.0) / reference) if reference > 0 else 0.0
