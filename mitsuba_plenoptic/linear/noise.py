"""The noise of pixels that count electrons."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from ..errors import put_checked, refuse_if, require_number
from ..io import response_of
from ..runtime import Floats, Named


def dark_variance(read_noise: float, gain: float, dark_electrons: float = 0.0) -> float:
    """Return the variance of a dark pixel in squared electrons: of dark current, reading and rounding.

    EMVA Standard 1288, Release 4.0 Linear, equation for the digital number: rounding adds a twelfth of its square.
    """
    return dark_electrons + read_noise**2 + 1 / (12 * gain**2)


@dataclass(frozen=True)
class PixelNoise:
    r"""Noise of a detector's pixels: photon noise, and the variance of dark pixels.

    The variance of a pixel whose expected value is :math:`v` is :math:`(E v + d) / E^2`.

    Parameters
    ----------
    electrons : float
        Electrons that are counted in a pixel of value 1, E: photons times quantum efficiency.
    dark_variance : float
        Variance without light, d, in squared electrons: of dark current, reading and rounding.
    """

    electrons: float
    dark_variance: float = 0.0

    def __post_init__(self) -> None:
        put_checked(
            self, electrons=partial(require_number, positive=True), dark_variance=partial(require_number, minimum=0)
        )

    @classmethod
    def of_exposure(cls, exposure: Named) -> PixelNoise:
        """Return the noise of a capture from the record that `expose` makes; refuse one that is damaged."""
        refuse_if(not isinstance(exposure, dict), "exposure of the capture: it is not one that 'expose' writes")
        gain, _, dark, electrons = response_of(exposure)
        reading = require_number("read_noise", exposure.get("read_noise"), minimum=0)
        return cls(electrons, dark_variance(reading, gain, dark))

    @property
    def shift(self) -> float:
        """Variance of a dark pixel divided by the value of one electron."""
        return self.dark_variance / self.electrons


def misfit(noise: PixelNoise, image: Floats, model: Floats) -> float:
    """Return the squared residual, weighted by the pixels' variances, divided by its expectation for noise alone.

    This is Pearson's statistic, of expectation 1. Pixels that should be nearly dark get a lower weight than
    Pearson's, since otherwise one photon of light unknown to the model would outweigh all pixels.
    """
    dark = np.float32(noise.dark_variance / noise.electrons**2)
    variance = np.maximum(model, 0) / np.float32(noise.electrons) + dark
    # Variance, over the mean one, that is added to every pixel's where residuals are weighted.
    weight = 1 / (variance + np.float32(0.01 * float(variance.mean()) + 1e-30))
    residual = float(((image - model) ** 2 * weight).sum(dtype=np.float64))
    return residual / max(float((variance * weight).sum(dtype=np.float64)), 1e-30)
