r"""What every main lens offers, as rays and as waves pass it: all else asks it, and nothing else knows its kind.

A main lens stands in the camera frame, whose origin is its front principal plane. The microlens array (MLA) is at the
distance b behind its rear principal plane; for a thin lens both planes are z = 0. Rays are followed from the MLA to the
scene. Waves are followed the other way: a scene point has a field on the exit pupil, given by the path from the point
in waves and by its amplitude, and propagates from there to the MLA.

A new main lens is a file with a class that has the methods of `MainLens`, and with a function, marked by `builds`, that
makes it for a camera. All methods take floats, NumPy arrays or Dr.Jit arrays; where those carry gradients, so do the
results.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera

if TYPE_CHECKING:
    from .round_pupil import RoundMap

Pair = tuple[Any, Any]
"""x and y in the camera frame, of places or of slopes."""

Traced = tuple[tuple[Any, Any, Any], Pair, Any]
"""Where a ray starts towards the scene, its slopes there, and whether the main lens lets it through."""


@dataclass(frozen=True)
class LensNumbers:
    """What a main lens is built from.

    Attributes
    ----------
    camera : PlenopticCamera
        The camera, for all that has no gradients.
    wavelength : float, optional
        In nanometres. None: that of the main lens's own numbers.
    focal_length, aperture_radius, mla_distance : float or Dr.Jit array
        Those of the camera, or the same with gradients.
    wavefront : floats or Dr.Jit arrays
        Coefficients of its aberrations.
    model : {"ideal", "parabolic"}
        How rays refract, see `PlenopticCamera`.
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
"""Functions that make a main lens, by the type of what a camera's `main_lens` is."""


def builds(description: type) -> Callable[[Builder], Builder]:
    """Mark the function that makes the main lens of cameras whose `main_lens` is of some type; None's is a thin one."""

    def mark(function: Builder) -> Builder:
        BUILDERS[description] = function
        return function

    return mark


class MainLens(Protocol):
    """What the camera asks of its main lens. Lengths are millimetres, wavelengths nanometres.

    What is about waves is asked of the lens that `waves_of` returns, which serves the points that it was given.
    """

    @property
    def pupil_radius(self) -> Any:
        """Radius of the smallest circle about the axis that holds the exit pupil."""

    @property
    def pupil_distance(self) -> Any:
        """Distance from the exit pupil to the MLA."""

    @property
    def reach(self) -> float:
        """Radius of a circle about the axis that holds the exit pupil, seen from anywhere on the detector."""

    @property
    def is_round(self) -> bool:
        """Whether it is the same all around the axis."""

    @property
    def refraction(self) -> float:
        """A number that is the same for lenses of one camera through which all rays go the same ways."""

    @property
    def is_open_evenly(self) -> bool:
        """Whether from everywhere on the MLA the same circle of the exit pupil is open."""

    @property
    def changes_evenly(self) -> bool:
        """Whether the light of points at neighbouring microlenses changes alike with the camera's parameters."""

    @property
    def entrance(self) -> Entrance:
        """The scene's side of it."""

    @property
    def round_map(self) -> RoundMap | None:
        """A map from the pupil, seen off the axis, onto the round one near the axis; None where both are the same."""

    def start_bounds(self, field: float) -> tuple[float, tuple[float, ...]]:
        """Return a radius and the z between which all rays start that reach the MLA up to a distance from the axis."""

    def waves_of(self, points: NDArray[np.float64]) -> MainLens:
        """Return the lens as the waves of scene points (n, 3) pass it.

        Parameters
        ----------
        points : float64 array (n, 3)
            Scene points in the camera frame.

        Raises
        ------
        InputError
            If a point does not lie before a real main lens, or not within the field that it covers.
        PhysicsError
            If its path cannot be fitted.
        """

    def waves_of_one(self, point: NDArray[np.float64]) -> PointLight:
        """Return the light of a single scene point (3,), as exactly as the lens can."""

    def farthest(self, distances: Sequence[float]) -> NDArray[np.float64]:
        """Return points (n, 3) that `waves_of` needs for all light at some finite distances that a detector sees."""

    def chief_point(self, place: Any, detector_distance: Any) -> Any:
        """Return one coordinate on the MLA of rays from places on the detector to the middle of the exit pupil."""

    def pupil_distance_from(self, behind: Any) -> Any:
        """Return how far on the exit pupil rays from one point so far behind the MLA are apart, over their slopes."""

    def pupil_point(self, place: Any, slope: Any, height: Any = 0.0) -> Any:
        """Return one coordinate on the exit pupil of rays from places nearer to it by a height than the MLA.

        Parameters
        ----------
        place : array
            Coordinates where the rays meet the array.
        slope : array
            Their slopes along the same axis.
        height : array
            How far the places stand before the MLA.
        """

    def slope_to(self, pupil: Any, place: Any, height: Any = 0.0) -> Any:
        """Return the slope along one axis between points of the exit pupil and places near the MLA.

        Parameters
        ----------
        pupil, place : array
            Coordinates on the exit pupil and near the MLA.
        height : array
            How far the places stand before the MLA.
        """

    def open_fraction(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the fraction of the circle of the radius `reach` that is open, seen from places on the MLA."""

    def vergence(self, distance: Any) -> Any:
        """Return the reciprocal of the distance, behind the rear principal plane, of an object plane's image."""

    def trace(
        self, place: tuple[Any, Any], slope: tuple[Any, Any]
    ) -> tuple[tuple[Any, Any, Any], tuple[Any, Any], Any]:
        """Follow a ray from a place on the MLA to the scene.

        Parameters
        ----------
        place : (array, array)
            x and y on the MLA.
        slope : (array, array)
            dx/dz and dy/dz of the ray between MLA and lens.

        Returns
        -------
        point : (array, array, array)
            Where the ray starts towards the scene, in the camera frame.
        slope : (array, array)
            Its slopes there.
        open : array
            Whether the lens lets it through.
        """

    def convergence(self, distance: Any) -> Any:
        """Return the reciprocal of the distance from the exit pupil to an object plane's image."""

    def ray(self, pupil: tuple[Any, Any], place: tuple[Any, Any]) -> tuple[tuple[Any, Any, Any], tuple[Any, Any], Any]:
        """Return the ray that comes from a place on the MLA through a pupil point, as `trace` does."""

    def bind(self, points: NDArray[np.float64], which: Any = None) -> Light:
        """Return the light of some scene points.

        Parameters
        ----------
        points : float64 array (n, 3)
            The points in the camera frame, or in one that is turned about the axis if the lens is round.
        which : UInt32 array of Dr.Jit, optional
            The point of each lane. Default: NumPy's arrays (n, m) are asked for, of which each row is a point's.
        """

    def images(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where on the MLA the rays from scene points (n, 3) through the pupil's middle come; (n, 2)."""

    def nearness(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the reciprocals of the distances of scene points (n, 3) from the lens's entrance pupil; (n,)."""

    def points(self, images: NDArray[np.float64], nearness: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the scene points (n, 3) that have these `images` and this `nearness`."""

    def meet_array(self, pupil: Any, cosine: Any, point: tuple[Any, Any, Any]) -> Any:
        """Return the places (2, ...) on the MLA of rays that leave points of the pupil by direction cosines.

        Parameters
        ----------
        pupil, cosine : array (2, ...)
            Points of the exit pupil, and direction cosines of the rays there.
        point : (array, array, array)
            Scene point from which the rays come.
        """

    def open_part(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the fraction of the circle of the radius `reach` that is open to each of some points, (n,)."""

    def open_slopes(self, names: Iterable[str], points: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Return derivatives of the logarithm of the open area for points, (1, n), by those parameters it knows.

        For all others the area is that of a pupil that grows with the opening.

        Parameters
        ----------
        names : iterable of str
            Parameters of the camera.
        points : float64 array (n, 3)
            Scene points in the camera frame.
        """

    def varying(self, numbers: Mapping[str, Any], names: Container[str], turned: Any) -> Any:
        """Return the lens with the gradients of its parameters.

        Parameters
        ----------
        numbers : mapping
            ``focal_length``, ``aperture_radius``, ``mla_distance``, ``wavelength`` and ``wavefront`` of Dr.Jit.
        names : container of str
            Which of them vary.
        turned : float or Dr.Jit number
            Degrees by which the scene turns, clockwise, before the frame of the points.
        """

    def opaque(self, number: Callable[[Any], Any]) -> MainLens:
        """Return the lens with plain parameters that a function has made Dr.Jit's, if kernels depend on them."""

    def stretch(self, x: Any, y: Any, camera: PlenopticCamera, distance: float) -> tuple[Any, Any]:
        """Return where chief rays from object points come that bins of reconstructions count at x, y.

        Parameters
        ----------
        x, y : array
            Coordinates on the MLA of the images of the bins by a thin lens.
        camera : PlenopticCamera
            The camera.
        distance : float
            Of the object plane, in millimetres.
        """

    def within(self, images: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return places on the MLA (..., 2), those to which no light comes moved towards the axis to where it does."""

    def cone(self, distances: Any) -> float:
        """Return half the range of direction cosines of one point's light at the MLA, the widest of some distances."""

    def from_array(self, cosine: tuple[Any, Any], image: tuple[Any, Any]) -> tuple[tuple[Any, Any], Any, Any]:
        """Go back along plane waves at a place on the MLA, as the Debye integral does.

        Parameters
        ----------
        cosine : (array, array)
            Direction cosines of the waves.
        image : (array, array)
            The place.

        Returns
        -------
        pupil : (array, array)
            Points of the exit pupil from which they come.
        length : array
            By how much a small range of direction cosines is spread there: :math:`dP = R ds` near the axis.
        path : array
            From there to the place, less that from the pupil's centre, in millimetres.
        """

    def to_array(self, pupil: NDArray[np.float64], image: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the direction cosines, (..., 2), from points of the exit pupil to places on the MLA."""

    def chief_slope(self, image: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the slopes of the chief rays at places on the MLA."""

    def curvature(self, square: Any) -> Any:
        """Return the curvature of waves at the MLA from the pupil, at a squared distance from its centre."""

    def path_change(self, radius: Any, step: Any, wavelength: float) -> Any:
        """Return by how many waves, at the pupil's edge, wavefronts differ whose images lie a small step apart.

        Beyond the tilt that goes with the step. `radius` is the distance of the images from the axis.

        Parameters
        ----------
        radius : array
            Distance of the images from the axis in millimetres.
        step : array
            Distance between the images in millimetres.
        wavelength : float
            Wavelength in nanometres.
        """


class Light(Protocol):
    """Scene points' light on the exit pupil. Lengths are millimetres, wavelengths nanometres.

    Points that it is asked for must be those that it is bound to.
    """

    def path(self, pupil: tuple[Any, Any], point: tuple[Any, Any, Any], wavelength: float) -> Any:
        """Return the path from a scene point to an exit pupil point, less that to the pupil's centre, in waves.

        Parameters
        ----------
        pupil : (array, array)
            Point on the exit pupil in millimetres.
        point : (array, array, array)
            Scene point in the camera frame in millimetres.
        wavelength : float
            Wavelength in nanometres.
        """

    def amplitude(self, pupil: tuple[Any, Any], point: tuple[Any, Any, Any]) -> Any:
        """Return the modulus of a scene point's field on the exit pupil, in units that are the same for all of it."""

    def inside(self, pupil: tuple[Any, Any]) -> Any:
        """Return how far within the edge of the exit pupil a point lies, negative outside."""

    def is_open(self, pupil: tuple[Any, Any]) -> Any:
        """Return whether a point lies within the edge of the exit pupil, or but for rounding on it."""

    def cosines(self, pupil: tuple[Any, Any], point: tuple[Any, Any, Any]) -> tuple[Any, Any]:
        """Return the direction cosines in which a scene point's light leaves the exit pupil, the gradient of `path`."""

    def land(self, pupil: tuple[Any, Any], point: tuple[Any, Any, Any]) -> tuple[Any, Any]:
        """Return the place on the MLA of the ray from a scene point through a pupil point; `ray` leads back."""


class PointLight(Protocol):
    """What `MainLens.waves_of_one` returns: the path, amplitude and edge of `Light` for one point."""

    pupil_radius: Any
    pupil_distance: Any

    def path(self, pupil: tuple[Any, Any], point: tuple[Any, Any, Any], wavelength: float) -> Any:
        """Return what `Light.path` does.

        Parameters
        ----------
        pupil : (array, array)
            Point on the exit pupil in millimetres.
        point : (array, array, array)
            Scene point in the camera frame in millimetres.
        wavelength : float
            Wavelength in nanometres.
        """

    def amplitude(self, pupil: tuple[Any, Any], point: tuple[Any, Any, Any]) -> Any:
        """Return what `Light.amplitude` does."""

    def inside(self, pupil: tuple[Any, Any]) -> Any:
        """Return what `Light.inside` does."""


@dataclass(frozen=True)
class Entrance:
    """The scene's side of a main lens, in the camera frame; a thin lens is its own pupils.

    Attributes
    ----------
    pupil : float
        z of the entrance pupil, in millimetres.
    front : float
        z of a plane before all of the lens.
    magnification : float
        Places on the exit pupil over those on the entrance pupil.
    """

    pupil: float = 0.0
    front: float = 0.0
    magnification: float = 1.0
