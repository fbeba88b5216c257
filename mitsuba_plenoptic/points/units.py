"""The units of captures: a pixel is the mean radiance over its lens's area, or over the pupil without microlenses."""

import math
from typing import Any, cast

import numpy as np

from ..camera import PlenopticCamera
from ..fields import OpticalSystem
from ..lenses import FittedLens, MainLens, open_area
from ..runtime import Doubles


def brightness(lattice: Any, pupil_radius: Any, reduced_distance: Any, pixel_size: Any) -> Any:
    r"""Return the camera's factor in a point's weight, :math:`A_{pupil} (z/n)^2 / (A_{lens} A_{pixel})`.

    The other factors are the point's radiance and the solid angle :math:`A_c / b^2` that the point represents.
    """
    pupil = math.pi * pupil_radius**2
    return pupil * reduced_distance**2 / (lattice.lens_area * pixel_size**2)


def detector_brightness(distance: Any, pixel_size: Any) -> Any:
    r"""Return `brightness` of a camera without an array, :math:`b^2 / A_{pixel}`, with the pupil's distance b."""
    return distance**2 / pixel_size**2


def brightness_of(camera: PlenopticCamera, lens: MainLens) -> float:
    r"""Return the `brightness` of a camera with its main lens.

    A point's weight in `CaptureOperator` is this number times its radiance and the solid angle :math:`A_c / b^2`.
    """
    if not camera.has_array:
        return float(detector_brightness(lens.pupil.distance, camera.pixel_size))
    # The reach of rays is that of the field stop where the array stands in an image of the stop.
    radius = lens.pupil.radius if camera.lens_data.images_stop else lens.reach
    return float(brightness(camera.lattice, radius, camera.reduced_distance, camera.pixel_size))


def brightness_at(system: OpticalSystem, points: Doubles) -> Doubles:
    """Return `brightness_of` a system with the open part of the pupil for each point, (n,)."""
    lens = system.waves_of(points)
    mean_brightness = brightness_of(system.camera, system.lens)
    if lens.is_uniform:
        return np.full(len(points), mean_brightness)
    return mean_brightness * (open_area(cast(FittedLens, lens), points) / (math.pi * lens.reach**2))


def radiance_weight(camera: PlenopticCamera, lens: MainLens, area: float) -> float:
    r"""Return the total signal of a small area of radiance 1 in all pixels: `brightness_of` times :math:`A_c / b^2`.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    lens : MainLens
        Its main lens, such as ``OpticalSystem(camera, wavelength).lens``.
    area : float
        The area's image in the plane of the microlenses or of an ordinary camera's detector, in square millimetres.
    """
    return area / lens.pupil.distance**2 * brightness_of(camera, lens)
