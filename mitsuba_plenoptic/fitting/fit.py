"""Fitting numbers of a camera to captures of known light: least squares with the captures' own derivatives."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..bounds import require_wavelength
from ..camera import PlenopticCamera
from ..capture.accuracy import check_accuracy
from ..capture.pupil_weights import PupilWeights
from ..errors import InputError, did_you_mean, require_choice, require_number, shown, suggest_keywords
from ..io.checkpoints import Checkpoint, digest
from .light import View, check_views
from .model import Model, Number, changed, numbers_of, scales, values
from .ray_model import RayModels, check_numbers

METHODS = ("waves", "rays")

_ROUNDS = 2
"""How often the noise of photons is taken from the model anew."""

_MOST_STEPS = 30

_DONE = 1e-7
"""Relative change of the numbers, or of the sum of squares, that ends a round."""

_FARTHEST = 50.0
"""Units, of `Fit.scales`, by which numbers may change where no bounds are given."""

_LEAST_PHOTONS = 1.0
"""Photons of which the noise is that of a dark pixel."""


@dataclass(frozen=True)
class Direction:
    """A change of all numbers at once that the captures tell to some deviation, apart from other directions.

    Attributes
    ----------
    deviation : float
        Standard deviation along it, in the units of `Fit.scales`.
    parts : dict
        By number, its part in the direction; their squares add to 1.
    """

    deviation: float
    parts: dict[str, float]


@dataclass(frozen=True)
class Fit:
    """What a fit found.

    Attributes
    ----------
    camera : PlenopticCamera
        The camera.
    values, deviations : dict
        By name the fitted numbers and their standard deviations; those of a parameter with several are named with what
        place they have, from 1: ``mla_offset.1``.
    covariance : float64 array (numbers, numbers)
        Of the numbers, in their order in `values`: the inverse of Fisher's information, from the captures' derivatives.
    scales : dict
        The unit of each number in `directions`: a hundredth of it, a degree, a pitch, a wave.
    directions : tuple of Direction
        What can be told, from the worst on: numbers with large parts in a direction of a large deviation cannot be
        told apart.
    chi_square : float
        Sum of the squared residuals over their variances, divided by pixels minus numbers: near 1 where the model and
        the noise are right.
    steps : int
        Cameras that have been tried.
    """

    camera: PlenopticCamera
    values: dict[str, float]
    deviations: dict[str, float]
    covariance: NDArray[np.float64]
    scales: dict[str, float]
    directions: tuple[Direction, ...]
    chi_square: float
    steps: int


@suggest_keywords
def fit(
    camera: PlenopticCamera,
    views: View | Sequence[View],
    names: Iterable[str] | str,
    *,
    wavelength: float = 633.0,
    photons: float | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    method: str = "waves",
    accuracy: float = 0.0,
    progress: Callable[[int, int], None] | None = None,
    checkpoint: Checkpoint | None = None,
) -> Fit:
    r"""Find the numbers of a camera that explain captures of known light best, by waves or by rays.

    Least squares of the pixels over their deviations (a trust region method: ``scipy.optimize.least_squares``), by
    waves with the derivatives of `CaptureOperator`, by rays with differences of captures whose rays are held. The light
    is held. Where the noise is that of photons, its variance is that of the model, taken anew after a first fit, so
    that the fit is as good as maximum likelihood.

    Parameters
    ----------
    camera : PlenopticCamera
        Where to start; the numbers that are not fitted are right. It must be near: spots of the model that lie beside
        those of a capture by more than their width do not find them. `lattice_from_white` brings a lattice near.
    views : View, or sequence of View
        Captures by one camera, and their light.
    names : str or iterable of str
        What is fitted: names of the numbers by which captures are differentiated, as of `CaptureOperator.derivative`.
    wavelength : float
        In nanometres.
    photons : float, optional
        Photons of a pixel of value 1, for views whose noise is not given.
    bounds : mapping, optional
        By name, as in `Fit.values`, the lowest and the highest value. Default: what keeps lengths within half of where
        they start, angles within 50 degrees, and ``mla_fill`` at most 1.
    method : {"waves", "rays"}
        How the light of the points goes through the camera. Rays are quicker and know no diffraction.
    accuracy : float
        As of `CaptureOperator`, for waves. Above 0 shared point spreads make the model jump a little.
    progress : callable, optional
        Called with the cameras that have been tried and the most that are.
    checkpoint : Checkpoint, optional
        Keeps the best camera of a long fit, so that the same fit goes on from there after a stop.

    Raises
    ------
    InputError
        If an input has a wrong value, the camera has an objective or the noise of a view is not known.
    """
    from scipy.optimize import least_squares

    if camera.objective is not None:
        camera.require_thin("cameras are fitted", "fit one behind a prescription")
    given = [views] if isinstance(views, View) else list(views)
    _check(camera, given, photons)
    numbers = numbers_of(camera, names)
    start = values(camera, numbers)
    unit = scales(camera, numbers)
    limits = _limits(numbers, start, unit, bounds)
    for number, value, low, high in zip(numbers, start, *limits, strict=True):
        if not low <= value <= high:
            raise InputError(f"bounds: {number.label} starts at {value:g}: it must lie from {low:g} to {high:g}")
    images = np.stack([view.image for view in given]).astype(np.float64)
    if method == "rays":
        check_numbers(numbers)
    model = _model_of(method, camera, given, require_wavelength(wavelength), check_accuracy(accuracy))
    trial = _Trials(camera, numbers, model, progress)
    x = start
    if checkpoint:
        asked = {"method": method, "wavelength": wavelength, "photons": photons, "accuracy": accuracy}
        # Where a fit goes on is as good as where it began.
        sought = {number.name for number in numbers}
        held = {name: value for name, value in camera.to_dict().items() if name not in sought}
        facts = {"numbers": [number.label for number in numbers], "bounds": dict(bounds or {}), "camera": held}
        x = np.clip(trial.go_on(checkpoint, start, **facts, **asked, light_digest=_digest(given)), *limits)
    for _ in range(_ROUNDS if photons is not None else 1):
        noise = _noise(given, trial.expected(x), photons)

        def residuals(x: NDArray[np.float64], noise: NDArray[np.float64] = noise) -> NDArray[np.float64]:
            return np.asarray(((trial.expected(x) - images) / noise).ravel())

        def jacobian(x: NDArray[np.float64], noise: NDArray[np.float64] = noise) -> NDArray[np.float64]:
            return np.asarray((trial.derivatives(x) / noise).reshape(len(numbers), -1).T)

        options = {"bounds": limits, "x_scale": unit, "xtol": _DONE, "ftol": _DONE, "max_nfev": _MOST_STEPS}
        x = least_squares(residuals, x, jacobian, **options).x
    noise = _noise(given, trial.expected(x), photons)
    square = float((((trial.expected(x) - images) / noise) ** 2).sum())
    rows = (trial.derivatives(x) / noise).reshape(len(numbers), -1).T * unit
    return _summary(changed(camera, numbers, x), numbers, x, rows, unit, square / (images.size - x.size), trial.count)


class _Model(Protocol):
    """What a camera records of some views."""

    def images(self) -> NDArray[np.float64]:
        """Return the expected pixels of all views, (views, rows, columns)."""

    def derivatives(self, numbers: list[Number], images: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives of these, (numbers, views, rows, columns)."""


def _model_of(
    method: str, camera: PlenopticCamera, views: list[View], wavelength: float, accuracy: float
) -> Callable[[PlenopticCamera], _Model]:
    """Return what makes the model of a camera near the first."""
    if require_choice("method", method, METHODS) == "waves":
        return partial(Model, views=views, wavelength=wavelength, accuracy=accuracy)
    if accuracy:
        raise InputError(f"accuracy = {accuracy:g}: it is for fits by waves; leave it out")
    return RayModels(camera, views, wavelength).at


class _Trials:
    """Cameras that are tried, of which the last one is kept."""

    def __init__(
        self,
        camera: PlenopticCamera,
        numbers: list[Number],
        model_of: Callable[[PlenopticCamera], _Model],
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self._camera, self._numbers, self._progress = camera, numbers, progress
        self._model_of = model_of
        self._checkpoint: Checkpoint | None = None
        self.count = 0
        self._x: NDArray[np.float64] | None = None
        self._slopes: NDArray[np.float64] | None = None

    def expected(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what a camera of these numbers records."""
        if self._x is None or not np.array_equal(x, self._x):
            self._model = self._model_of(changed(self._camera, self._numbers, x))
            self._images, self._slopes, self._x = self._model.images(), None, x.copy()
            self.count += 1
            if self._progress:
                self._progress(min(self.count, _ROUNDS * _MOST_STEPS), _ROUNDS * _MOST_STEPS)
        return self._images

    def derivatives(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives of that, which are asked for where a step has led to a better camera."""
        images = self.expected(x)
        if self._checkpoint:
            self._checkpoint.save_arrays(lambda: {"numbers": x, "tried": np.array([self.count], np.float64)})
        if self._slopes is None:
            self._slopes = self._model.derivatives(self._numbers, images)
        return self._slopes

    def go_on(self, checkpoint: Checkpoint, start: NDArray[np.float64], **facts: Any) -> NDArray[np.float64]:
        """Keep the numbers in a checkpoint, and return those that it has of the same fit, or the start."""
        self._checkpoint = checkpoint
        arrays = checkpoint.begin_arrays(**facts)
        if arrays is None:
            return start
        x, tried = arrays.get("numbers"), arrays.get("tried")
        if x is None or tried is None or x.shape != start.shape or tried.shape != (1,):
            raise InputError("checkpoint: it is damaged: its numbers are not those of this fit")
        self.count = int(tried[0])
        return x


def _digest(views: list[View]) -> str:
    """Return by what captures and their light are known as the same."""
    arrays: list[NDArray[Any] | None] = []
    for view in views:
        pupil = PupilWeights.of(view.pupil_weights, len(view.points))
        arrays += [view.image, view.points, view.weights, None if view.noise is None else np.asarray(view.noise)]
        arrays += [None] * 3 if pupil is None else [pupil.table, pupil.index, pupil.slant]
    return digest(*arrays)


def _check(camera: PlenopticCamera, views: list[View], photons: float | None) -> None:
    """Refuse views that do not fit together."""
    check_views(camera, views)
    if photons is not None:
        require_number("photons", photons, positive=True)
    for view in views:
        if view.noise is None and photons is None:
            raise InputError("photons: tell them, or the noise of every view")


def _limits(
    numbers: list[Number],
    start: NDArray[np.float64],
    unit: NDArray[np.float64],
    bounds: Mapping[str, tuple[float, float]] | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lowest and the highest values of the numbers: not far from the start, unless told."""
    labels = [number.label for number in numbers]
    low, high = start - _FARTHEST * unit, start + _FARTHEST * unit
    high[[label == "mla_fill" for label in labels]] = 1.0
    for name, pair in (bounds or {}).items():
        if name not in labels:
            raise InputError(
                f"bounds: {shown(name)} is not fitted; there are {', '.join(labels)}{did_you_mean(name, labels)}"
            )
        if np.shape(pair) != (2,) or not pair[0] < pair[1]:
            raise InputError(f"bounds: {name} = {shown(pair)}: it must be the lowest and the highest value")
        low[labels.index(name)], high[labels.index(name)] = pair
    return low, high


def _noise(views: list[View], expected: NDArray[np.float64], photons: float | None) -> NDArray[np.float64]:
    """Return the standard deviations of all pixels."""
    if photons is None:
        return np.stack([np.broadcast_to(view.noise, view.image.shape) for view in views])
    shot = np.sqrt(np.maximum(expected, _LEAST_PHOTONS / photons) / photons)
    return np.stack(
        [own if view.noise is None else own * 0 + view.noise for view, own in zip(views, shot, strict=True)]
    )


def _summary(
    camera: PlenopticCamera,
    numbers: list[Number],
    x: NDArray[np.float64],
    rows: NDArray[np.float64],
    unit: NDArray[np.float64],
    chi_square: float,
    steps: int,
) -> Fit:
    """Gather what a fit found; `rows` are the weighted derivatives for changes of one unit."""
    labels = [number.label for number in numbers]
    for label, told in zip(labels, np.abs(rows).max(axis=0).tolist(), strict=True):
        if not told:
            raise InputError(f"{label}: the captures tell nothing of it")
    _, singular, vectors = np.linalg.svd(rows, full_matrices=False)
    with np.errstate(divide="ignore"):
        deviations = 1 / singular
    covariance: Any = (vectors.T * deviations**2) @ vectors * np.outer(unit, unit)
    directions = tuple(
        Direction(float(deviation), dict(zip(labels, vector.tolist(), strict=True)))
        for deviation, vector in zip(deviations[::-1], vectors[::-1], strict=True)
    )

    def by_label(given: NDArray[np.float64]) -> dict[str, float]:
        return dict(zip(labels, given.tolist(), strict=True))

    own = by_label(np.sqrt(np.diag(covariance)))
    return Fit(camera, by_label(x), own, covariance, by_label(unit), directions, chi_square, steps)
