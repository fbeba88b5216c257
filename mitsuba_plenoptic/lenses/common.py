"""Base classes of main lenses, and the function that makes a lens from plain parameters or Dr.Jit arrays.

There is one base class for a pupil at a finite distance, and one for a pupil that is the same for all points.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError
from ..optics import rays
from ..runtime import sqrt
from .main_lens import Entrance, MainLens, Pair


class UniformLens:
    """A main lens whose light is the same for every scene point, with the whole pupil open to all points."""

    pupil_radius: Any

    is_open_evenly = True
    changes_evenly = True

    round_map = None

    @property
    def reach(self) -> Any:
        """Radius of the pupil in millimetres."""
        return self.pupil_radius

    @property
    def entrance(self) -> Entrance:
        """Entrance of a thin lens."""
        return Entrance()

    def waves_of(self, points: NDArray[np.float64]) -> Self:
        """Return this lens, whose light is the same for all points."""
        return self

    def waves_of_one(self, point: NDArray[np.float64]) -> Self:
        """Return this lens, whose light is the same for all points."""
        return self

    def bind(self, points: NDArray[np.float64], which: Any = None) -> Self:
        """Return this lens, whose light is the same for all points."""
        return self

    def farthest(self, distances: Sequence[float]) -> NDArray[np.float64]:
        """Return no points, as no point limits the light."""
        return np.empty((0, 3))

    def open_fraction(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return 1, as the whole pupil is open to every position."""
        return np.ones(np.broadcast_shapes(np.shape(x), np.shape(y)))

    def open_part(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return 1, as the whole pupil is open to every point."""
        return np.ones(len(points))

    def open_slopes(self, names: Iterable[str], points: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Return an empty mapping: the open area depends on the aperture alone."""
        return {}

    def opaque(self, number: Callable[[Any], Any]) -> Self:
        """Return this lens unchanged."""
        return self

    def stretch(self, x: Any, y: Any, camera: PlenopticCamera, distance: float) -> Pair:
        """Return the positions unchanged."""
        return x, y

    def within(self, images: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the positions unchanged."""
        return images


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
    near = tuple(lens.chief_point(p, detector_distance / index) for p in position)
    if isinstance(index, (int, float)) and index == 1:
        return near[0], near[1]
    # One step: the direction at the paraxial place is right to the square of z / b.
    x, y = (lens.slope_to(0.0, m) for m in near)
    slope = rays.refracted((x, y), 1 / index)
    return position[0] + detector_distance * slope[0], position[1] + detector_distance * slope[1]


class FiniteDistance:
    """A main lens with its exit pupil at a finite distance before the array, for the ray model."""

    pupil_distance: Any

    def chief_point(self, position: Any, detector_distance: Any) -> Any:
        """Return a coordinate, on the MLA, of the line from a detector position to the centre of the exit pupil."""
        return rays.chief_point(position, self.pupil_distance, detector_distance)

    def pupil_distance_from(self, behind: Any) -> Any:
        """Return the distance in mm to the pupil from a plane `behind` mm behind the MLA."""
        return self.pupil_distance + behind

    def pupil_point(self, position: Any, slope: Any, height: Any = 0.0) -> Any:
        """Return a coordinate on the exit pupil of the ray from a position at a height before the MLA."""
        return position + (self.pupil_distance - height) * slope

    def slope_to(self, pupil: Any, position: Any, height: Any = 0.0) -> Any:
        """Return the slope, along one axis, between positions as in `pupil_point` and points of the exit pupil."""
        return (pupil - position) / (self.pupil_distance - height)


class FinitePupil(FiniteDistance, ABC):
    """A main lens with its exit pupil at a finite distance b before the array, for the ray and the wave model."""

    pupil_radius: Any

    @abstractmethod
    def convergence(self, distance: Any) -> Any:
        """Return the reciprocal of the distance from the exit pupil to the image of an object plane."""

    def meet_array(self, pupil: Any, cosine: Any, point: tuple[Any, Any, Any]) -> Any:
        """Return the positions where straight rays from the pupil meet the MLA."""
        return pupil + self.pupil_distance * cosine / np.sqrt(1 - (cosine**2).sum(0))

    def cone(self, distances: Any) -> float:
        """Return the largest direction cosine to the pupil's rim, for light focused on the MLA or on an image."""
        powers = np.abs(self.convergence(distances))
        return float(self.pupil_radius) * float(powers.max(initial=1 / self.pupil_distance))

    def from_array(self, cosine: Pair, image: Pair) -> tuple[Pair, Any, Any]:
        r"""Return pupil points :math:`M - R s`, radii :math:`R = b / \sqrt{1 - s^2}`, and R minus the chief ray's R."""
        (sx, sy), (x, y), b = cosine, image, self.pupil_distance
        R = b / sqrt(1 - sx * sx - sy * sy)
        return (x - R * sx, y - R * sy), R, R - sqrt(x * x + y * y + b * b)

    def to_array(self, pupil: NDArray[np.float64], image: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the direction cosines from points of the pupil to positions on the MLA."""
        towards = image - pupil
        return np.asarray(towards / np.sqrt((towards**2).sum(-1) + self.pupil_distance**2)[..., None])

    def chief_slope(self, image: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the slopes of the chief rays at positions on the MLA."""
        return np.asarray(image / self.pupil_distance)

    def curvature(self, square: Any) -> Any:
        """Return the wavefront curvature: the reciprocal of the distance whose square is given."""
        return 1 / sqrt(square)


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
    varying: Mapping[str, Any] | None = None,
    model: str | None = None,
) -> Any:
    """Return the optics of a camera's main lens at a wavelength.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float, optional
        Wavelength in nanometres. Default: that for which the main lens is specified.
    varying : mapping, optional
        Values that replace the camera's, such as Dr.Jit arrays with gradients: ``focal_length``,
        ``aperture_radius``, ``mla_distance`` and ``wavefront``.
    model : {"ideal", "parabolic"}, optional
        Refraction model of rays. Default: the camera's `lens_model`.

    Raises
    ------
    InputError
        If no function is registered for a main lens of this type.
    """
    given = varying or {}
    names = "focal_length", "aperture_radius", "mla_distance", "wavefront"
    numbers = {name: given.get(name, getattr(camera, name)) for name in names}
    build = BUILDERS.get(type(camera.main_lens))
    if build is None:
        raise InputError(f"main_lens = {camera.main_lens!r}: no function is marked to build a lens of this kind")
    return build(LensNumbers(camera, wavelength, **numbers, model=model or camera.lens_model))
