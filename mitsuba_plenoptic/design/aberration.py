"""Wavefront aberration, over the field, of a thin main lens whose `lens_model` is ``parabolic``."""

import math

import numpy as np

from ..camera import PlenopticCamera
from ..errors import require_wavelength
from ..lenses import main_lens
from .quantities import best_distances

_SPOKES = 24
_HEIGHTS = 5
"""Angles on the pupil, and image heights from the axis to the farthest pixel."""


def parabolic_aberration(camera: PlenopticCamera, wavelength: float) -> float:
    r"""Return the wavefront aberration of a parabolic main lens, in waves, for object points in the plane in focus.

    Light of a point gains the path :math:`W = (p - i) / \lambda`, with the paths p and i through a thin parabolic phase
    and through a stigmatic lens. Piston and tilt, which move an image and do not blur it, are taken away at each image
    height, and one defocus for the whole field, as the camera may be focused anew: by least squares over the pupil and
    five heights, from the axis to the recorded pixel that is farthest from it. The result is the largest difference of
    W over the pupil, of all heights; Rayleigh's criterion allows a quarter. On the axis it is of third order
    :math:`a^4 (1/g^3 + 1/b^3) / 32 \lambda`, for the radius a of the pupil, the object distance g and the distance b of
    the array.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera, with either `lens_model`.
    wavelength : float
        Wavelength in nanometres.

    Returns
    -------
    float
        0 for cameras with a `main_lens`, and those of which no plane is in focus.
    """
    wavelength = require_wavelength(wavelength)
    if camera.main_lens is not None:
        return 0.0
    at_wavelength = camera.at_wavelength(wavelength)
    distances = [g for g in best_distances(at_wavelength) if g > at_wavelength.focal_length]
    # 1e4: Distance of objects at infinity, over that of the main lens from the array.
    return max(
        (_peak_to_valley(at_wavelength, min(g, 1e4 * at_wavelength.mla_distance), wavelength) for g in distances),
        default=0.0,
    )


def _peak_to_valley(camera: PlenopticCamera, distance: float, wavelength: float) -> float:
    """Return the difference between greatest and smallest path over the pupil, for points at a distance."""
    square = np.linspace(0, 1, 33)[:, None]
    angle = 2 * math.pi * np.arange(_SPOKES) / _SPOKES
    x, y = (camera.aperture_radius * (np.sqrt(square) * turn(angle)).ravel() for turn in (np.cos, np.sin))
    # By the trapezoidal rule over the area.
    weights = np.repeat(np.where(square % 1 == 0, 0.5, 1.0).ravel(), _SPOKES)
    reach = math.hypot(*(float(np.abs(camera.pixel_coordinates(axis)).max()) for axis in (0, 1)))
    heights = np.linspace(0, reach, _HEIGHTS)[:, None]
    point = -heights * distance / camera.mla_distance, 0 * heights, np.full_like(heights, distance)
    parabolic, ideal = (
        main_lens(camera, wavelength, model=model).path((x, y), point, wavelength) for model in ("parabolic", "ideal")
    )
    scale = np.sqrt(weights)[:, None]
    plane = np.stack([np.ones_like(x), x, y], axis=1)

    def rest(values: np.ndarray) -> np.ndarray:
        return values - plane @ np.linalg.lstsq(scale * plane, scale * values, rcond=None)[0]

    path = rest((parabolic - ideal).T)
    defocus = rest((x * x + y * y)[:, None])
    path -= defocus * (weights @ (path * defocus)).sum() / (_HEIGHTS * (weights @ defocus**2).sum())
    return float(np.ptp(path, axis=0).max())
