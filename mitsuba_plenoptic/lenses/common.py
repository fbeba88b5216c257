"""The function that makes a main lens from plain parameters or Dr.Jit arrays, and what follows from its members."""

import functools
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from ..camera import PlenopticCamera
from ..errors import InputError
from ..optics import in_millimetres, rays
from ..prescription import Collimator, Objective, Prescription
from ..runtime import Doubles, Facts, Pair
from .protocol import MainLens

if TYPE_CHECKING:
    from .fitted_lens import FittedLens


def chief_points(lens: MainLens, position: Pair, detector_distance: Any, index: Any) -> Pair:
    """Return where rays from detector positions to the pupil's centre cross the MLA, by Snell's law.

    Parameters
    ----------
    lens : MainLens
        Main lens.
    position : (array, array)
        x and y on the detector in millimetres.
    detector_distance : float or array
        Distance from the MLA to the detector in millimetres.
    index : float or array
        Refractive index of the medium between them.
    """
    near = tuple(lens.pupil.chief(p, detector_distance / index) for p in position)
    if isinstance(index, (int, float)) and index == 1:
        return near[0], near[1]
    # One step: the direction at the paraxial place is right to the square of z / b.
    x, y = (lens.pupil.slope(0.0, m) for m in near)
    slope = rays.refracted((x, y), 1 / index)
    return position[0] + detector_distance * slope[0], position[1] + detector_distance * slope[1]


def convergence(lens: MainLens, distance: Any) -> Any:
    """Return the reciprocal of the distance from the exit pupil to the image of an object plane."""
    return lens.vergence(distance) if lens.is_uniform else cast("FittedLens", lens).convergence(distance)


def cone(lens: MainLens, distances: Any) -> float:
    """Return half the range of direction cosines of a point's light at the MLA, the largest over `distances`."""
    radius = lens.pupil.radius
    distance = lens.pupil.distance
    if not lens.pupil.finite:
        return float(radius / distance)
    return float(radius) * float(np.abs(convergence(lens, distances)).max(initial=1 / distance))


def inverse_distance(lens: MainLens, points: Doubles) -> Doubles:
    """Return the reciprocals (n,) of the distances of scene points (n, 3) from the lens's entrance pupil.

    Behind an objective, which sees all depths under the same angles, it returns the depths instead.

    Parameters
    ----------
    lens : MainLens
        Main lens.
    points : float64 array (n, 3)
        Scene points in the camera frame.
    """
    return 1 / (points[:, 2] - lens.entrance.pupil) if lens.pupil.finite else points[:, 2]


def path_change(lens: MainLens, radius: Any, step: Any, wavelength: float) -> Any:
    r"""Return the difference in waves, at the pupil's edge, between wavefronts whose images lie a small step apart.

    The tilt that corresponds to the step is excluded. A thin lens of radius a has :math:`a (a^2 + 3 r^2) d / 2 b^3
    \lambda`, an upper bound for an ideal lens, whose light changes with the field only as defocus in tilted cones;
    wavefronts of all points in an object plane of an objective differ by tilts alone.

    Parameters
    ----------
    lens : MainLens
        Main lens.
    radius : array
        Distance r of the images from the axis in millimetres.
    step : array
        Distance d between the images in millimetres.
    wavelength : float
        Wavelength in nanometres.
    """
    if not lens.is_uniform:
        return cast("FittedLens", lens).path_change(radius, step, wavelength)
    a = lens.pupil.radius
    b = lens.pupil.distance
    return lens.pupil.finite * a * (a * a + 3 * radius * radius) * step / (2 * b**3 * in_millimetres(wavelength))


@dataclass(frozen=True)
class LensNumbers:
    """Camera, wavelength and parameters from which a main lens is built.

    Attributes
    ----------
    camera : PlenopticCamera
        The camera, for all parameters without gradients.
    wavelength : float, optional
        Wavelength in nanometres. None selects the wavelength for which the main lens is specified.
    focal_length, aperture_radius, mla_distance : float or Dr.Jit array
        Values of the camera, possibly with gradients.
    wavefront : floats or Dr.Jit arrays
        Coefficients of the aberrations.
    model : {"ideal", "parabolic"}
        Refraction model of rays, see `PlenopticCamera`.
    """

    camera: PlenopticCamera
    wavelength: float | None
    focal_length: Any
    aperture_radius: Any
    mla_distance: Any
    wavefront: Any
    model: str


Builder = TypeVar("Builder", bound=Callable[[LensNumbers], Any])

FILES = {type(None): "thin", Collimator: "thin", Objective: "telecentric", Prescription: "real_lens"}
"""Files of this folder whose functions make main lenses, by the type of the camera's `main_lens`."""

BUILDERS: dict[type, Callable[[LensNumbers], MainLens]] = {}
"""Functions that make a main lens, by the type of the camera's `main_lens`."""


def builds(description: type) -> Callable[[Builder], Builder]:
    """Return a decorator for functions that build main lenses from a type of `main_lens`; `type(None)` means thin."""

    def mark(function: Builder) -> Builder:
        BUILDERS[description] = function
        return function

    return mark


def main_lens(
    camera: PlenopticCamera,
    wavelength: float | None = None,
    *,
    varying: Facts | None = None,
    model: str | None = None,
) -> Any:
    """Return the optics of a camera's main lens at a wavelength.

    Parameters
    ----------
    wavelength : float, optional
        Wavelength in nanometres. Default: that for which the main lens is specified.
    varying : mapping, optional
        Values that replace the camera's, such as Dr.Jit arrays with gradients: ``focal_length``,
        ``aperture_radius``, ``mla_distance`` and ``wavefront``.
    model : {"ideal", "parabolic"}, optional
        Refraction model of rays. Default: the camera's `lens_model`.
    """
    varied = varying or {}
    names = "focal_length", "aperture_radius", "mla_distance", "wavefront"
    numbers = {name: varied.get(name, getattr(camera, name)) for name in names}
    kind = type(camera.main_lens)
    if kind in FILES:
        # Fits of pupils are imported for the lenses that need them.
        importlib.import_module(f"{__package__}.{FILES[kind]}")
    build = BUILDERS.get(kind)
    if build is None:
        raise InputError(f"main_lens = {camera.main_lens!r}: no function is marked to build a lens of this kind")
    return build(LensNumbers(camera, wavelength, **numbers, model=model or camera.lens_model))


# Fits of exit pupils are slow.
cached_main_lens = functools.lru_cache(maxsize=4)(main_lens)
