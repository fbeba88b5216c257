"""The wavelengths of a capture, and how strongly each channel of the detector answers to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..bounds import require_wavelength
from ..errors import InputError


@dataclass(frozen=True)
class Spectrum:
    """Some wavelengths, and the channels that record them.

    Parameters
    ----------
    wavelengths : tuple of float
        Nanometres.
    responses : tuple of tuples of float
        For each channel its response to each wavelength.

    Raises
    ------
    InputError
        If there is no wavelength, one is not from 1 to 1e6, or a channel does not have one finite response to each.
    """

    wavelengths: tuple[float, ...]
    responses: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        if not self.wavelengths:
            raise InputError("spectrum: it must have a wavelength")
        object.__setattr__(self, "wavelengths", tuple(require_wavelength(value) for value in self.wavelengths))
        try:
            matrix = np.array(self.responses, np.float64)
        except (TypeError, ValueError):
            raise InputError("spectrum: responses must be numbers, as many for every channel") from None
        if matrix.ndim != 2 or matrix.shape[1] != len(self.wavelengths) or not np.isfinite(matrix).all():
            raise InputError(
                f"spectrum: responses of shape {matrix.shape}: every channel must have a finite one to each of "
                f"{len(self.wavelengths)} wavelengths"
            )

    @classmethod
    def lines(cls, *wavelengths: float) -> Spectrum:
        """Make a spectrum of single wavelengths, each with a channel of its own.

        Parameters
        ----------
        *wavelengths : float
            Nanometres.
        """
        return cls(tuple(wavelengths), tuple(map(tuple, np.eye(len(wavelengths)).tolist())))

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.responses)

    def matrix(self) -> NDArray[np.float32]:
        """Return the responses as an array (channels, wavelengths)."""
        return np.array(self.responses, np.float32)
