"""The search for camera parameters that maximise a figure of merit."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ...camera import PlenopticCamera
from ...errors import InputError, refuse_if, require_count, short_repr
from ...runtime import Doubles, Pair
from .merit import Gradient
from .point_rays import vector_of


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
        Figure of merit of the camera.
    values : dict
        The parameters that varied, by name.
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
    bounds: Mapping[str, Pair],
    *,
    steps: int = 30,
    progress: Callable[[int, float, PlenopticCamera], None] | None = None,
) -> Design:
    """Find camera parameters near a start that maximise a figure of merit.

    SciPy's L-BFGS-B searches locally with the figure's gradient; several starts show whether there are other optima.

    Parameters
    ----------
    figure : Figure
        The figure of merit to maximise, such as `RefocusedContrast` or `DepthInformation`.
    camera : PlenopticCamera
        The start of the search; parameters that are not named keep their values.
    bounds : mapping
        Lowest and highest value by name: names of `CaptureOperator.derivative`, with an index from 1 where there are
        several, as ``wavefront.11``; the name alone means all components, of a wavefront all but the piston.
    steps : int
        Steps of the search at most; each takes one or two gradients.
    progress : callable, optional
        Called with the number of cameras tried, the last figure, and the best camera so far, from which a stopped
        search can be started again.
    """
    from scipy.optimize import minimize

    camera.require_array("maximise")
    camera = camera.regular
    labels: list[str] = []
    for name in bounds:
        all_of = vector_of(camera, str(name).split(".", 1)[0])
        chosen = [component.label for component in all_of.components if name in (component.name, component.label)]
        refuse_if(not chosen, f"bounds: {short_repr(name)}: the camera has {', '.join(all_of.labels)}")
        labels += chosen
    refuse_if(not labels, "bounds: name at least one parameter that varies")
    refuse_if(len(set(labels)) < len(labels), "bounds: a parameter has two of them")
    vector = vector_of(camera, [label.split(".", 1)[0] for label in labels]).keep(labels)
    low, high = vector.limits(bounds)
    best: list = [-np.inf, camera]
    tried = 0

    def cost(position: Doubles) -> tuple[float, Doubles]:
        nonlocal tried
        candidate = vector.at(low + position * (high - low))
        value, slopes = figure.gradient(candidate, vector.names)
        tried += 1
        if not np.isfinite(value):
            raise InputError(f"figure: it is {value} for {candidate.to_json()}")
        if value > best[0]:
            best[:] = value, candidate
        if progress:
            progress(tried, value, best[1])
        return -value, -vector.slopes(slopes) * (high - low)

    # Relative change of the figure that ends a search.
    options = {"maxiter": require_count("steps", steps), "ftol": 1e-6}
    result = minimize(
        cost,
        (vector.values - low) / (high - low),
        jac=True,
        method="L-BFGS-B",
        bounds=[(0.0, 1.0)] * len(low),
        options=options,
    )
    value, camera_of_best = best
    values = dict(zip(vector.labels, vector.of(camera_of_best).values.tolist(), strict=True))
    return Design(camera_of_best, float(value), values, tried, str(result.message))
