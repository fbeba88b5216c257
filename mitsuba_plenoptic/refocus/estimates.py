"""Estimates of the time and memory that reconstructions take."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from ..errors import InputError, argument
from ..io import CaptureLike
from ..runtime import Cost, Forecast, memory_asked
from .api import reconstruct


class _KnownError(Exception):
    """Ends a reconstruction whose time is known by now."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds


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
        Seconds, and bytes beside those of the program, the capture and the images; points and point spreads are 0.
        With ``deconvolved`` the time is that of as many iterations as there may be.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> cost = mp.estimate_reconstruction(mp.example("letters-wave"), 210, method="coherent")
    >>> cost.seconds < 60, cost.memory < 2**30
    (True, True)
    """
    for name in ("progress", "checkpoint"):
        if options.get(name) is not None:
            raise InputError(f"{argument(name)}: an estimate does not take it; leave it out")

    def leave(seconds: float) -> None:
        raise _KnownError(seconds)

    start = time.perf_counter()
    with memory_asked() as sizes:
        try:
            reconstruct(capture, distance, **options | {"progress": Forecast(leave)})
            seconds = time.perf_counter() - start
        except _KnownError as known:
            seconds = known.seconds
    return Cost(0, 0, seconds, max(sizes))
