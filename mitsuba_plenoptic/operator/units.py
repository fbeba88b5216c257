"""The units of captures: a pixel is the mean radiance over its lens's area."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..lenses.fitted_lens import FittedLens, lens_of_waves
from ..lenses.lens_changes import open_area
from ..lenses.open_pupil import pupil_bound


def brightness(lattice: Any, pupil_radius: Any, detector_distance: Any, pixel_size: Any) -> Any:
    r"""Return :math:`A_{pupil} z^2 / (A_{lens} A_{pixel})`, of the weight of a point what depends on the camera.

    The rest is its radiance times the solid angle :math:`A_c / b^2` that it stands for.

    Parameters
    ----------
    lattice : Lattice
        The microlens array.
    pupil_radius, detector_distance, pixel_size : float or Dr.Jit array
        In millimetres.
    """
    pupil = math.pi * pupil_radius**2
    return pupil * detector_distance**2 / (lattice.lens_area * pixel_size**2)


def brightness_of(camera: PlenopticCamera) -> float:
    """Return `brightness` for a camera."""
    return float(brightness(camera.lattice, pupil_bound(camera), camera.detector_distance, camera.pixel_size))


def brightness_at(camera: PlenopticCamera, points: NDArray[np.float64], wavelength: float) -> NDArray[np.float64]:
    """Return `brightness` with the part of the pupil that is open to each of some points, (n,).

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    points : float64 array (n, 3)
        Scene points in the camera frame.
    wavelength : float
        In nanometres.
    """
    lens, whole = lens_of_waves(camera, points, wavelength), np.full(len(points), brightness_of(camera))
    if not isinstance(lens, FittedLens):
        return whole
    return np.asarray(whole * open_area(lens, points) / (math.pi * pupil_bound(camera) ** 2))


def radiance_weight(camera: PlenopticCamera, area: float) -> float:
    r"""Return what all pixels together record of a small area of radiance 1: `brightness` times :math:`A_c / b^2`.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    area : float
        The area :math:`A_c` of its image on the array, in square millimetres; in the Fourier arrangement that of its
        native image, which the tube lens forms at b.
    """
    objective = camera.objective
    b = objective.tube_focal_length if objective is not None and objective.is_fourier else camera.pupil_distance
    return area / b**2 * brightness_of(camera)
