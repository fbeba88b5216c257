"""How bright a picture is: which value it shows white, so that one lamp does not make all else black."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import InputError, require_number

_MOST_STOPS = 100.0

_DEFAULT_PERCENTILE = 99.5


@dataclass(frozen=True)
class Brightness:
    """A rule for the value that becomes white; what is brighter is white, too.

    Parameters
    ----------
    exposure : float, optional
        In stops, the same for every picture: the value 2^-exposure becomes white, 1 at 0.
    percentile : float, optional
        Instead, a value that so many percent of the bins or pixels do not surpass, above 0 and up to 100. Default: 99.5
        where there is no exposure. If it is black, the brightest becomes white.

    Raises
    ------
    InputError
        If both are given, or one is out of range.
    """

    exposure: float | None = None
    percentile: float | None = None

    def __post_init__(self) -> None:
        if self.exposure is not None and self.percentile is not None:
            raise InputError(f"exposure = {self.exposure:g}, percentile = {self.percentile:g}: give one of the two")
        if self.exposure is not None:
            require_number("exposure", self.exposure, minimum=-_MOST_STOPS, maximum=_MOST_STOPS)
        if self.percentile is not None:
            require_number("percentile", self.percentile, positive=True, maximum=100)

    def white(self, images: Sequence[np.ndarray]) -> float:
        """Return the value that becomes white in pictures that are looked at together; NaN counts as nothing."""
        if self.exposure is not None:
            return float(2.0**-self.exposure)
        values = np.concatenate([image[np.isfinite(image)] for image in images])
        if not values.size:
            return 1.0
        percentile = _DEFAULT_PERCENTILE if self.percentile is None else self.percentile
        for value in (np.percentile(values, percentile), values.max()):
            if value > 0:
                return float(value)
        return 1.0
