r"""Total variation of planes of bins, by which an iteration prefers uniform areas with sharp borders.

.. math:: \mathrm{TV}(x) = \sum \sqrt{(\Delta_1 x)^2 + (\Delta_2 x)^2 + \epsilon^2}

(Rudin, Osher and Fatemi 1992, Physica D 60, 259), with the differences to the next bin along rows and columns. Its
gradient is :math:`-\mathrm{div}(\nabla x / |\nabla x|)`, at most :math:`2 + \sqrt 2`, by which Richardson's and Lucy's
step is divided (Dey et al. 2006, Microscopy Research and Technique 69, 260).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...detector.record import Detector
from ...errors import refusing, require_number

_DARKEST = 0.01
"""Variance, over the mean one, that is added to every pixel's where residuals are weighted."""


@dataclass(frozen=True)
class Noise:
    r"""Variance of a pixel of value v: :math:`v / n + \sigma^2`."""

    electrons: float
    dark: float

    @classmethod
    def of(cls, exposure: Any, photons: float | None) -> Noise | None:
        """Return the noise for `photons`, if given, otherwise for the exposure that `expose` recorded."""
        if photons is not None:
            return cls(require_number("photons", photons, positive=True), 0.0)
        if exposure is None:
            return None
        # EMVA 1288, Release 4.0 Linear, equation for the digital number.
        with refusing("exposure of the capture: it is not one that 'expose' writes:", KeyError, TypeError):
            photons = exposure["photons"]
            detector = Detector(**{field.name: exposure[field.name] for field in fields(Detector)})
        assert detector.gain is not None
        electrons = detector.quantum_efficiency * require_number("photons", photons, positive=True)
        dark = detector.dark_electrons + detector.read_noise**2 + 1 / (12 * detector.gain**2)
        return cls(electrons, dark / electrons**2)

    @property
    def shift(self) -> float:
        """Variance of a dark pixel divided by the value of one electron."""
        return self.dark * self.electrons

    def misfit(self, image: NDArray[np.float32], model: NDArray[np.float32]) -> float:
        """Return the squared residual, weighted by the pixels' variances, divided by its expectation for noise alone.

        This is Pearson's statistic, of expectation 1. Pixels that should be nearly dark get a lower weight than
        Pearson's, since otherwise one photon of light unknown to the model would outweigh all pixels.
        """
        variance = np.maximum(model, 0) / np.float32(self.electrons) + np.float32(self.dark)
        weight = 1 / (variance + np.float32(_DARKEST * float(variance.mean()) + 1e-30))
        residual = float(((image - model) ** 2 * weight).sum(dtype=np.float64))
        return residual / max(float((variance * weight).sum(dtype=np.float64)), 1e-30)


_SMOOTH = 1e-3
"""Largest step between bins, over their mean, that counts as even."""


class TotalVariation:
    """Total variation of planes of upright square bins, as a penalty."""

    def gradient(
        self, values: Sequence[NDArray[np.float32]], inside: Sequence[NDArray[np.bool_]]
    ) -> list[NDArray[np.float32]]:
        """Return the dimensionless gradient, one value for each bin."""
        slopes = []
        for part, mask in zip(values, inside, strict=True):
            # Steps to bins that are not inside do not count.
            known = [mask[:, 1:] & mask[:, :-1], mask[1:] & mask[:-1]]
            right, below = np.zeros_like(part), np.zeros_like(part)
            right[:, :-1], below[:-1] = (np.diff(part, axis=1 - axis) * known[axis] for axis in (0, 1))
            even = _SMOOTH * float(part[mask].mean()) if mask.any() else 0.0
            length = np.sqrt(right**2 + below**2 + np.float32(even**2 + 1e-30))
            right, below = right / length, below / length
            slope = -right - below
            slope[:, 1:] += right[:, :-1]
            slope[1:] += below[:-1]
            slopes.append(slope)
        return slopes
