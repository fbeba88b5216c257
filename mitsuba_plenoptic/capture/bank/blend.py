"""Where the bank is right, and where point spreads must be computed exactly: by how many lenses a point is blurred."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from ...camera import PlenopticCamera
from ...optics.main_lens import main_lens
from ...optics.open_pupil import pupil_bound
from .local_lens import Spread, at_pupil

_LIMITS = ((0.004, (8.0, 12.0)), (0.02, (4.0, 4.75)), (1.0, (3.0, 4.5)))
"""Lenses of blur up to which point spreads are exact, and from which on all is the bank's, by allowed error."""


def blur_of(camera: PlenopticCamera, vergence: Any) -> Any:
    """Return over how many lenses the image of a point is blurred by rays near the axis, with its defocus's sign.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    vergence : float or array
        Vergence of the point's image, in 1/mm.
    """
    lens: Any = main_lens(camera) if camera.prescription is None else camera
    if camera.prescription is not None:
        vergence = at_pupil(camera, vergence)
    return (1 - lens.pupil_distance * vergence) * (2 * lens.pupil_radius / max(camera.mla_pitches))


def least_blur(camera: PlenopticCamera, vergence: Any) -> Any:
    """Return over how many lenses the light of a point is blurred at least, wherever on the detector its image lies.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    vergence : float or array
        Vergence of the point's image, in 1/mm.
    """
    blur = blur_of(camera, vergence)
    if camera.prescription is None:
        return abs(blur)
    before, behind = Spread.of(camera).less
    choose, most = (dr.select, dr.maximum) if dr.is_array_v(blur) else (np.where, np.maximum)
    return most(abs(blur) - choose(blur > 0, before, behind), 0)


def most_blur(camera: PlenopticCamera, vergence: Any) -> Any:
    """Return over how many lenses the light of a point is blurred at most; parameters as of `least_blur`."""
    blur = abs(blur_of(camera, vergence))
    if camera.prescription is None:
        return blur
    return (blur + Spread.of(camera).most) * max(1.0, pupil_bound(camera) / camera.pupil_radius)


def blur_limits(accuracy: float) -> tuple[float, float]:
    """Return the lenses of blur at which the bank begins to be used, and from which on it is used alone."""
    return next(limits for allowed, limits in _LIMITS if accuracy < allowed)


def near_weight(camera: PlenopticCamera, vergence: Any, accuracy: float) -> Any:
    """Return which fraction of a point's light needs its exact point spread; the rest is the bank's.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    vergence : array of NumPy or Dr.Jit
        Vergences of the points' images, in 1/mm.
    accuracy : float
        Allowed relative error; at 0 nothing is the bank's.

    Returns
    -------
    array
        From 1 near focus smoothly to 0.
    """
    if accuracy == 0:
        return 0 * vergence + 1
    low, high = blur_limits(accuracy)
    clip = dr.clip if dr.is_array_v(vergence) else np.clip
    part = clip((high - least_blur(camera, vergence)) / (high - low), 0, 1)
    return part * part * (3 - 2 * part)
