"""A camera near the one that has recorded known light, found from afar."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..bounds import require_wavelength
from ..camera import PlenopticCamera
from ..errors import InputError
from .light import View, check_views
from .model import Number, changed, numbers_of, scales, values
from .ray_model import RayModels, check_numbers

_BLURS = (2.0, 1.0, 0.5, 0.25, 0.125)
"""Standard deviations of the Gaussians that blur captures, in microlenses, one after the other."""

_SHARPEST = 1.0
"""Least of them, in pixels."""

_LATTICE = ("mla_pitch", "mla_rotation", "mla_offset")
_TELLS_LATTICE = 0.5
"""Blur, in microlenses, below which the lattice is sought, too: what is blurred more does not show it."""

_MOST_STEPS = 15
"""Cameras that are tried with each."""


def come_near(
    camera: PlenopticCamera,
    views: View | Sequence[View],
    names: Iterable[str] | str,
    *,
    wavelength: float = 633.0,
    progress: Callable[[int, int], None] | None = None,
) -> PlenopticCamera:
    """Find a camera from which `fit` goes on, where one starts some percent off in every length.

    Spots of a model that lie beside those of a capture do not find them. Here both are blurred, first so much that
    they overlap and then less and less, and the least squares of their differences are found by rays, which is quick.
    What rays do not know, diffraction, and what is blurred make the result wrong by more than the noise of photons.

    Parameters
    ----------
    camera : PlenopticCamera
        Where to start: the lattice by less than half a pitch wrong anywhere, see `lattice_from_white`.
    views : View, or sequence of View
        Captures by one camera, and their light.
    names : str or iterable of str
        What is sought, as for `fit`.
    wavelength : float
        In nanometres.
    progress : callable, optional
        Called with the cameras that have been tried and the most that are.

    Raises
    ------
    InputError
        If an input has a wrong value, or as of `capture.point_rays.PointRays`.
    """
    given = [views] if isinstance(views, View) else list(views)
    check_views(camera, given)
    if not all(view.image.max() > 0 for view in given):
        raise InputError("image: it is black: nothing can be found by it")
    numbers = numbers_of(camera, names)
    check_numbers(numbers)
    models = RayModels(camera, given, require_wavelength(wavelength))
    blurs = np.maximum(np.array(_BLURS) * camera.pixels_per_lens, _SHARPEST)
    found, tried = camera, 0

    def count() -> None:
        nonlocal tried
        tried += 1
        if progress:
            progress(tried, _MOST_STEPS * len(blurs))

    for blur in np.unique(blurs)[::-1].tolist():
        whole = blur >= _TELLS_LATTICE * camera.pixels_per_lens
        sought = [number for number in numbers if not (whole and number.name in _LATTICE)]
        if sought:
            found = _nearest(found, sought, models, given, blur, count)
    return found


def _nearest(
    camera: PlenopticCamera,
    numbers: list[Number],
    models: RayModels,
    views: list[View],
    blur: float,
    count: Callable[[], None],
) -> PlenopticCamera:
    """Return the camera whose captures, blurred by so many pixels, are nearest to the views; count what is tried."""
    from scipy.ndimage import gaussian_filter
    from scipy.optimize import least_squares

    seen = np.stack([view.image for view in views]).astype(np.float64)
    brightest = seen.max(axis=(1, 2), keepdims=True)
    start, unit = values(camera, numbers), scales(camera, numbers)

    def blurred(images: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(gaussian_filter(images / brightest, blur, axes=(-2, -1)))

    def camera_at(place: NDArray[np.float64]) -> PlenopticCamera:
        return changed(camera, numbers, start + place * unit)

    def residuals(place: NDArray[np.float64]) -> NDArray[np.float64]:
        count()
        return blurred(models.images(camera_at(place)) - seen).ravel()

    def jacobian(place: NDArray[np.float64]) -> NDArray[np.float64]:
        slopes = models.at(camera_at(place)).derivatives(numbers, seen) * unit[:, None, None, None]
        return blurred(slopes).reshape(len(numbers), -1).T

    return camera_at(least_squares(residuals, 0 * start, jacobian, max_nfev=_MOST_STEPS).x)
