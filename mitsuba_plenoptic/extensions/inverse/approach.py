"""Coarse fits that bring a camera close enough to the true one for `fit` to converge."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from ...camera import CameraVector, PlenopticCamera
from ...errors import require_wavelength, warn
from ...io import Checkpoint
from ...runtime import Doubles, Pair, Progress
from ...views import estimate_lens_grid
from .fit_light import View, check_views, kept_numbers, light_digest
from .point_rays import RayModels, check_numbers, vector_of


def lattice_from_white(camera: PlenopticCamera, white: Any) -> PlenopticCamera:
    """Return the camera with pitches, angle and offset of the microlens array found from a white capture.

    Parameters
    ----------
    camera : PlenopticCamera
        The approximate camera. Its distances determine the ratio of the lens pitch to that of the micro-images, and its
        lattice selects, among equivalent lattices, the one of the nearest axis and angle.
    white : array (rows, columns)
        A capture of something evenly white.
    """
    camera.require_array("lattice_from_white")
    centres = estimate_lens_grid(white).centres().reshape(-1, 2)
    shrunk = camera.pupil_distance / (camera.pupil_distance + camera.reduced_distance)
    position = (centres + camera.crop_offset - np.array(camera.resolution) / 2) * (camera.pixel_size * shrunk)
    distance = np.hypot(*position.T)
    reach = 3 * max(camera.mla_pitches)
    fitted = camera
    while True:
        # From the axis outwards, so that errors of the start do not add up to whole lenses.
        fitted = _fitted(fitted, position[distance <= reach])
        if reach > distance.max():
            return fitted
        reach *= 1.5


def _fitted(camera: PlenopticCamera, position: Doubles) -> PlenopticCamera:
    """Return the camera with an array adjusted so that its lenses nearest to the given positions lie on them."""
    lattice = camera.lattice
    if lattice.displacement is not None:
        position = np.stack(lattice.displacement.regular(*position.T), axis=-1)
    i, j = lattice.regular.cell(*position.T)
    u, v = (np.asarray(coordinate, np.float64) for coordinate in lattice.unit_centre(i, j))
    v = v * lattice.row_ratio
    x, y = position.T
    ones = np.ones_like(u)
    none = np.zeros_like(u)
    # Steps (a, b) along the rows and q (-b, a) across them, of which the ratio q of the pitches is refined in turn.
    ratio = camera.mla_pitches[1] / camera.mla_pitches[0]
    for _ in range(8):
        rows = np.concatenate([np.stack([u, -ratio * v, ones, none], 1), np.stack([ratio * v, u, none, ones], 1)])
        (a, b, left, up), *_ = np.linalg.lstsq(rows, np.concatenate([x, y]), rcond=None)
        if np.ndim(camera.to_dict()["mla_pitch"]) == 0:
            break
        across = (x - left - a * u) * -b + (y - up - b * u) * a
        ratio = float((across * v).sum() / ((a * a + b * b) * (v * v).sum()))
    pitch = math.hypot(a, b)
    return camera.replace(
        mla_pitch=pitch if ratio == 1 else (pitch, ratio * pitch),
        mla_rotation=math.degrees(math.atan2(b, a)),
        mla_offset=(float(left), float(up)),
    )


_MOST_STEPS = 15
"""Cameras that are tried with each blur."""


def coarse_fit(
    camera: PlenopticCamera,
    views: View | Sequence[View],
    names: Iterable[str] | str,
    *,
    wavelength: float = 633.0,
    bounds: Mapping[str, Pair] | None = None,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
) -> PlenopticCamera:
    """Return a camera from which `fit` converges, for a start whose lengths are some percent off.

    A fit does not converge if the spots of the model do not overlap the spots of a capture. Here both are blurred, at
    first enough to overlap, then less and less, and the squared differences are minimised with the fast ray model.
    Because of the blur, and of diffraction, which the ray model neglects, the result is less accurate than photon noise
    would allow.

    Parameters
    ----------
    camera : PlenopticCamera
        The start; its lattice must be right to half a pitch everywhere, see `lattice_from_white`.
    views : View, or sequence of View
        Captures by one camera, and their light.
    names : str or iterable of str
        The parameters that are fitted, as for `fit`.
    wavelength : float
        Wavelength in nanometres.
    bounds : mapping, optional
        Bounds as for `fit`, with the same defaults. A parameter that ends at a bound causes a warning.
    progress : callable, optional
        Called with the number of cameras tried and the largest possible number.
    checkpoint : Checkpoint, optional
        Keeps the camera found with each blur, so that the same fit resumes from there after a stop.
    """
    observations = [views] if isinstance(views, View) else list(views)
    check_views(camera, observations)
    vector = vector_of(camera, names)
    check_numbers(vector)
    low, high = vector.limits(bounds)
    models = RayModels(camera, observations, require_wavelength(wavelength))
    # Standard deviations of the Gaussians that blur captures, one after the other: in microlenses, at least a pixel.
    blurs = np.unique(np.maximum(np.array((2.0, 1.0, 0.5, 0.25, 0.125)) * camera.pixels_per_lens, 1.0))[::-1].tolist()
    fitted = camera
    tried = 0
    first = 0
    if checkpoint:
        facts = {"numbers": vector.labels, "bounds": dict(bounds or {}), "camera": camera.to_dict()}
        stored = checkpoint.begin_arrays(**facts, wavelength=wavelength, light_digest=light_digest(observations))
        if stored is not None:
            x, tried = kept_numbers(stored, vector.values.shape)
            fitted = vector.at(np.clip(x, low, high))
            first = tried // _MOST_STEPS

    def count() -> None:
        nonlocal tried
        tried += 1
        if progress:
            progress(tried, _MOST_STEPS * len(blurs))

    for stage, blur in enumerate(blurs[first:], first + 1):
        # What is blurred by half a microlens or more does not show the lattice.
        fixed = ("mla_pitch", "mla_rotation", "mla_offset") if blur >= 0.5 * camera.pixels_per_lens else ()
        sought = np.array([component.name not in fixed for component in vector.components])
        if sought.any():
            some = vector.of(fitted).keep(np.array(vector.labels)[sought])
            fitted = _nearest(some, (low[sought], high[sought]), models, observations, blur, count)
        if checkpoint:
            tried_in_all = np.array([stage * _MOST_STEPS], np.float64)
            checkpoint.save_arrays(partial(dict, numbers=vector.of(fitted).values, tried=tried_in_all))
    x = vector.of(fitted).values
    # A parameter is at a bound if it is nearer than this part of what lies between its bounds.
    stuck = np.minimum(x - low, high - x) <= 1e-3 * (high - low)
    if stuck.any():
        named = ", ".join(f"{vector.labels[index]} = {x[index]:.6g}" for index in np.flatnonzero(stuck))
        warn(f"coarse_fit: at a bound: {named}: start nearer, give other bounds, or fit fewer parameters")
    return fitted


def _nearest(
    vector: CameraVector,
    limits: Pair,
    models: RayModels,
    views: list[View],
    blur: float,
    count: Callable[[], None],
) -> PlenopticCamera:
    """Return the camera whose captures, blurred by some pixels, are nearest to the views; `count` counts the trials."""
    from scipy.ndimage import gaussian_filter
    from scipy.optimize import least_squares

    recorded = np.stack([view.image for view in views]).astype(np.float64)
    masks = np.stack([view.used for view in views])
    brightest = recorded.max(axis=(1, 2), keepdims=True, where=masks, initial=0)
    start = vector.values
    unit = vector.scales

    def blurred(images: Doubles) -> Doubles:
        return gaussian_filter(images * masks / brightest, blur, axes=(-2, -1))

    def camera_at(step: Doubles) -> PlenopticCamera:
        return vector.at(start + step * unit)

    def residuals(step: Doubles) -> Doubles:
        count()
        return blurred(models.images(camera_at(step)) - recorded).ravel()

    def jacobian(step: Doubles) -> Doubles:
        slopes = models.at(camera_at(step)).derivatives(vector, recorded) * unit[:, None, None, None]
        return blurred(slopes).reshape(len(start), -1).T

    bounds = tuple((limit - start) / unit for limit in limits)
    return camera_at(least_squares(residuals, 0 * start, jacobian, bounds=bounds, max_nfev=_MOST_STEPS).x)
