"""What is known of the noise of a capture: the power of what no reconstruction should explain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...detector import Detector
from ...errors import InputError, require_number


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
            photons, values = exposure["photons"], {name: exposure[name] for name in exposure}
            del values["photons"], values["seed"]
            detector = Detector(**values)
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

    def power(self, image: NDArray[np.float32]) -> float:
        """Return the sum of all pixels' variances; the noisy values stand for their mean."""
        return max(0.0, float(image.sum(dtype=np.float64)) / self.electrons) + image.size * self.dark
