"""Estimates of the time and memory that reconstructions take."""

from collections.abc import Sequence
from typing import Any

from ..io import CaptureLike
from ..runtime import Cost, cost_of
from .api import reconstruct


def estimate_reconstruction(capture: CaptureLike, distance: float | Sequence[float], **options: Any) -> Cost:
    """Return the estimated time and memory of `reconstruct` with the same arguments.

    The reconstruction is begun, and abandoned as soon as its speed is known: some five seconds after the first results,
    or at its end.

    Parameters
    ----------
    capture, distance, **options
        As in `reconstruct`, without `progress` and `checkpoint`.

    Returns
    -------
    Cost
        Seconds, and bytes beside those of the program, the capture and the images.
        With ``deconvolved`` the time is that of as many iterations as there may be.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> cost = mp.estimate_reconstruction(mp.example("letters-ray"), 210, method="coherent", wavelength=633)
    >>> cost.seconds < 60, cost.memory < 2**30
    (True, True)
    """
    return cost_of(reconstruct, capture, distance, **options)
