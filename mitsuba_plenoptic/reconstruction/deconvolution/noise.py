"""What is known of the noise of a capture: how much of it no reconstruction should explain."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...detector import Detector
from ...errors import InputError, require_number

_DARKEST = 0.01
"""Variance, over the mean one, that is added to every pixel's where residuals are weighted."""


@dataclass(frozen=True)
class Noise:
    r"""Variance of a pixel of value v: :math:`v / n + \sigma^2`.

    Attributes
    ----------
    electrons : float
        Electrons n in a pixel of value 1; infinite where there is no photon noise.
    dark : float
        Variance :math:`\sigma^2` of a dark pixel, in units of the capture squared.
    """

    electrons: float
    dark: float

    @classmethod
    def of(cls, exposure: Any, photons: float | None) -> Noise | None:
        """Take the noise of a capture from what is told, else from what `expose` has kept with it.

        Parameters
        ----------
        exposure : dict, optional
            What `expose` has kept with the capture: photons, and the detector's numbers.
        photons : float, optional
            Photons that a pixel of value 1 has counted, all of them, without any other noise.

        Returns
        -------
        Noise or None
            None where nothing is known.

        Raises
        ------
        InputError
            If the number of photons is not one, or what is kept with the capture is not what `expose` writes.
        """
        if photons is not None:
            return cls(require_number("photons", photons, positive=True), 0.0)
        return None if exposure is None else cls._exposed(exposure)

    @classmethod
    def _exposed(cls, exposure: Any) -> Noise:
        """Take it from the detector's numbers: EMVA 1288, Release 4.0 Linear, equation for the digital number."""
        try:
            photons = exposure["photons"]
            detector = Detector(**{field.name: exposure[field.name] for field in fields(Detector)})
        except (KeyError, TypeError) as error:
            raise InputError(f"exposure of the capture: it is not one that 'expose' writes: {error}") from None
        assert detector.gain is not None
        electrons = detector.quantum_efficiency * require_number("photons", photons, positive=True)
        dark = detector.dark_electrons + detector.read_noise**2 + 1 / (12 * detector.gain**2)
        return cls(electrons, dark / electrons**2)

    @property
    def shift(self) -> float:
        """Variance of a dark pixel over the value that counts one electron."""
        return self.dark * self.electrons

    def misfit(self, image: NDArray[np.float32], model: NDArray[np.float32]) -> float:
        """Return the squared residual over what noise alone would make of it, pixels weighted by their variances.

        Pearson's statistic, of expectation 1; pixels that should be all but dark count less than it would have them,
        since a single photon of light that the model does not know would outweigh all else.

        Parameters
        ----------
        image : float32 array
            The pixels.
        model : float32 array
            What they should be.

        Returns
        -------
        float
        """
        variance = np.maximum(model, 0) / np.float32(self.electrons) + np.float32(self.dark)
        weight = 1 / (variance + np.float32(_DARKEST * float(variance.mean()) + 1e-30))
        residual = float(((image - model) ** 2 * weight).sum(dtype=np.float64))
        return residual / max(float((variance * weight).sum(dtype=np.float64)), 1e-30)
