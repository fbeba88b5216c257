"""Fits of camera parameters to captures of known light, by least squares with derivatives of the captures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from ... import choices
from ...camera import CameraVector, PlenopticCamera, Use, require_support
from ...errors import (
    refuse_if,
    require_accuracy,
    require_choice,
    require_count,
    require_number,
    require_wavelength,
    suggest_keywords,
    warn,
)
from ...io import Checkpoint
from ...linear import PixelNoise
from ...runtime import Doubles, Progress
from .fit_light import Pixels, View, by_model, check_views, kept_numbers, light_digest
from .fit_result import Fit, doubts, steps_along, summary
from .point_rays import RayModel, RayModels, WaveModel, check_numbers, vector_of

_ROUNDS = 2
"""How often the noise is taken from the model anew, where it depends on it."""

_DONE = 1e-7
"""Relative change of the parameters, or of the sum of squares, that ends a round."""


@suggest_keywords
def fit(
    camera: PlenopticCamera,
    views: View | Sequence[View],
    names: Iterable[str] | str,
    *,
    wavelength: float = 633.0,
    photons: float | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    model: str = "wave",
    accuracy: float = 0.0,
    steps: int = 30,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
) -> Fit:
    r"""Find the camera parameters that explain captures of known light best, by the wave model or the ray model.

    The weighted squares of the residuals are minimised by a trust region method (``scipy.optimize.least_squares``). The
    wave model uses the derivatives of `CaptureOperator`, the ray model finite differences of captures with fixed rays.
    Ray captures have kinks; therefore the standard deviations come from mean slopes over one deviation, on the side
    where the captures change less. The light is held fixed. The variance of photon noise is computed from the model's
    expected image and updated after a first fit, since variances from the data would give bright pixels the wrong
    weights and bias the parameters. Where less than one electron is expected, pixels are weighted as if it were one;
    deviations and chi-square take that into account.

    A warning is issued if chi-square differs from 1 by more than five of its deviations, if a parameter ends at a
    bound, or if the search has not converged.

    Parameters
    ----------
    camera : PlenopticCamera
        The start of the fit; parameters that are not fitted keep its values. The start must be so near that spots of
        the model overlap those of the captures; `lattice_from_white` brings a lattice near.
    views : View, or sequence of View
        Captures by one camera, and their light.
    names : str or iterable of str
        Names of the fitted parameters, which must have derivatives (see `CaptureOperator.derivative`); a single
        component has its index from 1, as in ``wavefront.5``.
    wavelength : float
        Wavelength in nanometres.
    photons : float, optional
        Photons counted in a pixel of value 1, for views whose noise is not given.
    bounds : mapping, optional
        Lowest and highest value by name, as in `Fit.values`. By default lengths stay within 50 % of their start, angles
        within 50 degrees of it, and ``mla_fill`` is at most 1. A parameter that ends at a bound causes a warning, and
        its deviation is one-sided, see `Fit`.
    model : {"ray", "wave"}
        Model of the light in the camera. The ray model is faster and neglects diffraction.
    accuracy : float
        Tolerated error of the wave model, for speed; 0: none. As for `CaptureOperator`: above 0 shared point spreads
        make the model jump a little.
    steps : int
        Cameras that are tried at most in each of the two rounds, or in the single one if the noise does not depend on
        the model; 2 or more.
    progress : callable, optional
        Called with the number of cameras tried and the largest possible number.
    checkpoint : Checkpoint, optional
        Keeps the best camera of a long fit, so that the same fit resumes from there after a stop.
    """
    from scipy.optimize import least_squares

    require_support(camera, Use.FITS)
    camera = camera.regular
    observations = [views] if isinstance(views, View) else list(views)
    default = None if photons is None else PixelNoise(require_number("photons", photons, positive=True))
    refuse_if(
        default is None and any(view.noise is None for view in observations),
        "photons: give them, or the noise of every view",
    )
    vector = vector_of(camera, names)
    start = vector.values
    unit = vector.scales
    limits = vector.limits(bounds)
    if model == "ray":
        check_numbers(vector)
    check_views(camera, observations, default)
    images = np.stack([view.image for view in observations]).astype(np.float64)
    model_of = _model_of(model, camera, observations, require_wavelength(wavelength), require_accuracy(accuracy))
    steps = require_count("steps", steps, minimum=2)
    trial = _Trials(vector, model_of, progress, _ROUNDS * steps)
    x = start
    if checkpoint:
        settings = {"model": model, "wavelength": wavelength, "photons": photons, "accuracy": accuracy}
        # A fit may continue from its last camera as well as from the first.
        fixed = {name: value for name, value in camera.to_dict().items() if name not in vector.names}
        whole_vector = vector_of(camera, vector.names)
        fixed |= {
            label: value
            for label, value in zip(whole_vector.labels, whole_vector.values.tolist(), strict=True)
            if label not in vector.labels
        }
        facts = {"numbers": vector.labels, "bounds": dict(bounds or {}), "camera": fixed}
        trial.checkpoint = checkpoint
        arrays = checkpoint.begin_arrays(**facts, **settings, light_digest=light_digest(observations))
        if arrays is not None:
            # Those of an earlier run of the same fit.
            x, trial.count = kept_numbers(arrays, start.shape)
        x = np.clip(x, *limits)

    def pixels_at(x: Doubles) -> Pixels:
        return Pixels.of(observations, trial.expected(x), default)

    def residuals(x: Doubles, pixels: Pixels) -> Doubles:
        return ((trial.expected(x) - images) / pixels.weight).ravel()

    def jacobian(x: Doubles, pixels: Pixels) -> Doubles:
        return (trial.derivatives(x) / pixels.weight).reshape(len(start), -1).T

    options = {"bounds": limits, "x_scale": unit, "xtol": _DONE, "ftol": _DONE, "max_nfev": steps}
    for _ in range(_ROUNDS if any(by_model(view, default) for view in observations) else 1):
        # Weights by what a model expects, and held within a round, do not follow the noise, as those by the data would.
        result = least_squares(residuals, x, jacobian, args=(pixels_at(x),), **options)
        x = result.x
    pixels = pixels_at(x)
    named = vector.at(x), vector.labels, x, unit, limits
    outcome = summary(*named, jacobian(x, pixels) * unit, residuals(x, pixels), pixels, trial.count)
    last = model_of(outcome.camera)
    if isinstance(last, RayModel):
        # The slopes at one point are not those over which noise moves a fit.
        slopes = last.slopes(
            vector,
            steps_along(outcome),
            lambda images: float(np.linalg.norm((images - trial.expected(x)) / pixels.weight)),
        )
        rows = (slopes / pixels.weight).reshape(len(start), -1).T * unit
        outcome = summary(*named, rows, residuals(x, pixels), pixels, trial.count)
    if result.status == 0:
        warn(f"fit: it ended after {trial.count} cameras before it had settled: start nearer, or fit fewer parameters")
    for doubt in doubts(outcome, observations, trial.expected(x)):
        warn(f"fit: {doubt}")
    return outcome


class Model(Protocol):
    """The captures of some views by a camera."""

    def images(self) -> Doubles:
        """Return the expected pixels of all views, (views, rows, columns)."""

    def derivatives(self, vector: CameraVector, images: Doubles) -> Doubles:
        """Return the derivatives of the captures, (parameters, views, rows, columns)."""


def _model_of(
    model: str, camera: PlenopticCamera, views: list[View], wavelength: float, accuracy: float
) -> Callable[[PlenopticCamera], Model]:
    """Return a function that makes the model of captures for a camera near the first one."""
    if require_choice("model", model, choices.MODELS) == "wave":
        return partial(WaveModel, views=views, wavelength=wavelength, accuracy=accuracy)
    refuse_if(accuracy, f"accuracy = {accuracy:g}: it is for fits by the wave model; leave it out")
    return RayModels(camera, views, wavelength).at


@dataclass(eq=False)
class _Trials:
    """Cameras tried by a fit, of which the latest one is remembered."""

    vector: CameraVector
    model_of: Callable[[PlenopticCamera], Model]
    progress: Progress | None
    most: int
    checkpoint: Checkpoint | None = None
    count: int = 0
    _x: Doubles | None = None
    _slopes: Doubles | None = None

    def expected(self, x: Doubles) -> Doubles:
        """Return the captures of the camera with the parameters x."""
        if self._x is None or not np.array_equal(x, self._x):
            self._model = self.model_of(self.vector.at(x))
            self._images, self._slopes, self._x = self._model.images(), None, x.copy()
            self.count += 1
            if self.progress:
                self.progress(min(self.count, self.most), self.most)
        return self._images

    def derivatives(self, x: Doubles) -> Doubles:
        """Return the derivatives of the captures at x, requested only where a step led to a better camera."""
        images = self.expected(x)
        if self.checkpoint:
            self.checkpoint.save_arrays(lambda: {"numbers": x, "tried": np.array([self.count], np.float64)})
        if self._slopes is None:
            self._slopes = self._model.derivatives(self.vector, images)
        return self._slopes
