"""The search for the parameters of a camera by which a figure is best."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError, refuse_if, require_count, short_repr
from ..fitting.model import Number, changed, numbers_of, values
from .figures import Gradient

_TOLERANCE = 1e-6
"""Relative change of the figure that ends a search."""


class Figure(Protocol):
    """The figure of merit, to be as large as possible."""

    def value(self, camera: PlenopticCamera) -> float:
        """Return it for a camera."""

    def gradient(self, camera: PlenopticCamera, names: Iterable[str]) -> tuple[float, Gradient]:
        """Return it, and its derivatives by parameters of the camera, as `CaptureOperator.gradient` has them."""


@dataclass(frozen=True)
class Design:
    """The result of a search.

    Attributes
    ----------
    camera : PlenopticCamera
        The best of all cameras that were tried.
    figure : float
        Its figure.
    values : dict
        By name the parameters that varied.
    tried : int
        Cameras that were tried.
    reason : str
        Why the search ended, in SciPy's words.
    """

    camera: PlenopticCamera
    figure: float
    values: dict[str, float]
    tried: int
    reason: str


def maximise(
    figure: Figure,
    camera: PlenopticCamera,
    bounds: Mapping[str, tuple[float, float]],
    *,
    steps: int = 30,
    progress: Callable[[int, float, PlenopticCamera], None] | None = None,
) -> Design:
    """Find parameters of a camera by which a figure is best, near where they start.

    By SciPy's L-BFGS-B with the figure's own gradient: a local search, several starts of which show whether there are
    other optima.

    Parameters
    ----------
    figure : Figure
        What is maximised, such as `RefocusedContrast` or `DepthInformation`.
    camera : PlenopticCamera
        Where to start; the parameters that are not named are held.
    bounds : mapping
        By name the lowest and the highest value of what varies: names of `CaptureOperator.derivative`, with
        an index from 1 where there are several, as ``wavefront.11``; the name alone means all of them, of
        a wavefront all but the piston.
    steps : int
        Steps of the search at most; each takes one or two gradients.
    progress : callable, optional
        Called with how many cameras have been tried, the last one's figure, and the best camera so far: a search that
        is stopped continues when it starts there.

    Raises
    ------
    InputError
        If a name or a bound is wrong, the camera lies outside them, or the figure is not finite at some camera.
    """
    from scipy.optimize import minimize

    numbers, low, high = _numbers(camera, bounds)
    start, names = values(camera, numbers), tuple(dict.fromkeys(number.name for number in numbers))
    for number, value, least, most in zip(numbers, start, low, high, strict=True):
        refuse_if(
            not least <= value <= most,
            f"bounds: {number.label} starts at {value:g}: it must lie from {least:g} to {most:g}",
        )
    best: list[Any] = [-np.inf, camera]
    tried = 0

    def cost(place: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        nonlocal tried
        one = changed(camera, numbers, low + place * (high - low))
        value, slopes = figure.gradient(one, names)
        tried += 1
        if not np.isfinite(value):
            raise InputError(f"figure: it is {value} for {one.to_json()}")
        if value > best[0]:
            best[:] = value, one
        if progress:
            progress(tried, value, best[1])
        slope = np.array([slopes[number.name][list(number.parts)].sum() for number in numbers])
        return -value, -slope * (high - low)

    options = {"maxiter": require_count("steps", steps), "ftol": _TOLERANCE}
    found = minimize(
        cost,
        (start - low) / (high - low),
        jac=True,
        method="L-BFGS-B",
        bounds=[(0.0, 1.0)] * len(numbers),
        options=options,
    )
    value, one = best
    labels = [number.label for number in numbers]
    chosen = dict(zip(labels, values(one, numbers).tolist(), strict=True))
    return Design(one, float(value), chosen, tried, str(found.message))


def _numbers(
    camera: PlenopticCamera, bounds: Mapping[str, tuple[float, float]]
) -> tuple[list[Number], NDArray[np.float64], NDArray[np.float64]]:
    """Return the parameters that vary, and their bounds."""
    numbers, limits = [], []
    for name, pair in bounds.items():
        refuse_if(
            np.shape(pair) != (2,) or not pair[0] < pair[1],
            f"bounds: {short_repr(name)} = {short_repr(pair)}: it must be the lowest and the highest value",
        )
        found = numbers_of(camera, str(name).split(".", 1)[0])
        chosen = [number for number in found if name in (number.name, number.label)]
        if not chosen:
            labels = ", ".join(number.label for number in found)
            raise InputError(f"bounds: {short_repr(name)}: the camera has {labels}")
        numbers += chosen
        limits += [pair] * len(chosen)
    refuse_if(not numbers, "bounds: name at least one parameter that varies")
    refuse_if(len({number.label for number in numbers}) < len(numbers), "bounds: a parameter has two of them")
    low, high = np.array(limits, np.float64).T
    return numbers, low, high
