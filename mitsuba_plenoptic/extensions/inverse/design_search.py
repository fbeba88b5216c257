"""The search for camera parameters that maximise a figure of merit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...camera.vector import CameraVector
from ...errors import InputError, refuse_if, require_count, short_repr
from ...light.lens_kinds import regular_array
from .merit import Gradient
from .point_rays import vector_of

_TOLERANCE = 1e-6
"""Relative change of the figure that ends a search."""


class Figure(Protocol):
    """A figure of merit of a camera, which a search maximises."""

    def value(self, camera: PlenopticCamera) -> float:
        """Return the figure of merit of a camera."""

    def gradient(self, camera: PlenopticCamera, names: Iterable[str]) -> tuple[float, Gradient]:
        """Return a camera's figure of merit and its derivatives, by name as in `CaptureOperator.gradient`."""


@dataclass(frozen=True)
class Design:
    """The camera that a search has found, and its figure of merit.

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
    """Find camera parameters near a start that maximise a figure of merit.

    SciPy's L-BFGS-B searches locally with the figure's gradient; several starts show whether there are other optima.

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

    camera = regular_array(camera)
    vector = _vector(camera, bounds)
    low, high = vector.limits(bounds)
    best: list[Any] = [-np.inf, camera]
    tried = 0

    def cost(position: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        nonlocal tried
        one = vector.at(low + position * (high - low))
        value, slopes = figure.gradient(one, vector.names)
        tried += 1
        if not np.isfinite(value):
            raise InputError(f"figure: it is {value} for {one.to_json()}")
        if value > best[0]:
            best[:] = value, one
        if progress:
            progress(tried, value, best[1])
        return -value, -vector.slopes(slopes) * (high - low)

    options = {"maxiter": require_count("steps", steps), "ftol": _TOLERANCE}
    found = minimize(
        cost,
        (vector.values - low) / (high - low),
        jac=True,
        method="L-BFGS-B",
        bounds=[(0.0, 1.0)] * len(low),
        options=options,
    )
    value, one = best
    chosen = dict(zip(vector.labels, vector.of(one).values.tolist(), strict=True))
    return Design(one, float(value), chosen, tried, str(found.message))


def _vector(camera: PlenopticCamera, bounds: Mapping[str, tuple[float, float]]) -> CameraVector:
    """Return the vector of the varied camera parameters, those that have bounds."""
    named: list[str] = []
    for name in bounds:
        found = vector_of(camera, str(name).split(".", 1)[0])
        chosen = [each.label for each in found.components if name in (each.name, each.label)]
        refuse_if(not chosen, f"bounds: {short_repr(name)}: the camera has {', '.join(found.labels)}")
        named += chosen
    refuse_if(not named, "bounds: name at least one parameter that varies")
    refuse_if(len(set(named)) < len(named), "bounds: a parameter has two of them")
    return vector_of(camera, [label.split(".", 1)[0] for label in named]).keep(named)
