"""Point spread of one scene point through the camera, and its fields in the planes on the way."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..camera import NOT_ROUND, PlenopticCamera, Round, Use, require_camera, require_support
from ..detector import DetectorOperator
from ..errors import InputError, require_choice, require_wavelength, suggest_keywords
from ..fields import OpticalSystem
from ..optics import guards
from ..runtime import POINTS, Doubles, Floats, Job, Threads, as_array, one_at_a_time
from . import full_fields
from .full_fields import PointFields
from .operator import CaptureOperator
from .pupil_weights import PupilWeights
from .rays_of_points import ray_spread
from .sampling import check_positions
from .scene_points import sample_pairs

_RAYS = 2**21


@suggest_keywords
@one_at_a_time
def point_spread_function(
    camera: PlenopticCamera,
    position: Any,
    *,
    wavelength: float | None = None,
    method: str = "patch",
    model: str = "wave",
) -> Floats:
    """Return the light of one scene point in each recorded pixel.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera; its recorded window may be a crop.
    position : (float, float, float)
        Scene point (X, Y, g) in the camera frame, in millimetres; g is its distance from the main lens.
    wavelength : float, optional
        Wavelength in nanometres. Rays need it for dispersive glasses only.
    method : {"patch", "full_field"}
        Of waves: "patch" propagates the lit part of the field only, in milliseconds; "full_field" takes no shortcut and
        seconds. They agree to 0.5 % (relative L2) with a regular array and in focus, to 2 % out of focus without one.

    model : {"wave", "ray"}
        Whether light goes through the camera as waves, or as two million rays through the pupil.

    Returns
    -------
    float32 array (rows, columns)
        Fractions of the power through the aperture, its blades, picture and apodisation; vignetting takes a part of it.

    Raises
    ------
    PhysicsError
        If too much of the light is lost.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> camera = mp.PlenopticCamera(detector_width=0.128, resolution=(64, 64))
    >>> spread = mp.point_spread_function(camera, (0.0, 0.0, 236.0), wavelength=633)
    >>> spread.shape
    (64, 64)
    """
    point = _check(camera, position)
    require_choice("model", model, ("wave", "ray"))
    if model == "ray":
        wavelength = None if wavelength is None else require_wavelength(wavelength)
        spread = ray_spread(camera, point, 2 * sample_pairs(_RAYS)[:, :2] - 1, wavelength).astype(np.float32)
        return DetectorOperator.of(camera).forward(spread)
    if wavelength is None:
        raise InputError("wavelength = None: waves need one")
    operator = CaptureOperator(camera, point[None], wavelength=wavelength, method=method, accuracy=0)
    # What interpolation leaves below zero between the samples is not light.
    return np.maximum(operator.forward([1.0], job=Job(batch_map=Threads(1))), 0)


@one_at_a_time
def point_fields(camera: PlenopticCamera, position: Any, *, wavelength: float) -> PointFields:
    """Return the complex field of one scene point at the pupil, the MLA and the detector.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    position : (float, float, float)
        The point (X, Y, g) in the camera's frame, in millimetres.
    wavelength : float
        Wavelength in nanometres.
    """
    with guards.watch():
        wavelength = require_wavelength(wavelength)
        point = _check(camera, position)
        require_support(camera, Use.POINT_FIELDS)
        camera = camera.at_wavelength(wavelength)
        weights = None if camera.aperture == Round() else PupilWeights.through(camera.aperture, 1)
        system = OpticalSystem(camera.replace(**NOT_ROUND), wavelength)
        return full_fields.point_fields(system, point, pupil_weights=weights)


def _check(camera: PlenopticCamera, position: Any) -> Doubles:
    require_camera(camera)
    point = as_array("position", position, POINTS[1:], rule="it must be three numbers (X, Y, g)", shape=(3,))
    return check_positions(point[None], camera)[0]
