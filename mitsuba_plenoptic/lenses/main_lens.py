r"""The interface of main lenses, `MainLens`, for rays and waves; other modules do not depend on the kind of lens.

A main lens stands in the camera frame, whose origin is its front principal plane. The microlens array (MLA) is at the
distance b behind its rear principal plane; for a thin lens both planes are z = 0. Rays are followed from the MLA to the
scene. Waves are followed in the opposite direction: the field of a scene point on the exit pupil, given by the path
from the point in waves and by its amplitude, propagates from there to the MLA.

A new kind of main lens is a module with a class that has the methods of `MainLens` and a function, marked by
`common.builds`, that makes it for a camera. All methods take floats, NumPy arrays or Dr.Jit arrays, and propagate the
gradients that these carry.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera

Pair = tuple[Any, Any]
"""x and y in the camera frame, of positions, slopes or direction cosines."""

Traced = tuple[tuple[Any, Any, Any], Pair, Any]
"""Start point of a ray towards the scene, its slopes there, and whether it passes the main lens."""


class MainLens(Protocol):
    """The methods of a main lens that the camera uses; lengths in millimetres, wavelengths in nanometres.

    Methods for waves are called on the lens that `waves_of` returns, with the points that `waves_of` received.
    """

    @property
    def pupil_radius(self) -> Any:
        """Radius in mm of the smallest circle about the axis that contains the exit pupil."""

    @property
    def pupil_distance(self) -> Any:
        """Distance in mm from the exit pupil to the MLA."""

    @property
    def reach(self) -> float:
        """Radius in mm of a circle that contains the exit pupil as seen from anywhere on the detector."""

    @property
    def is_round(self) -> bool:
        """Whether the lens is rotationally symmetric about the axis."""

    @property
    def refraction(self) -> float:
        """Number that characterises the refraction of rays; lenses with equal numbers refract all rays alike."""

    @property
    def is_open_evenly(self) -> bool:
        """Whether the same circle of the exit pupil is unvignetted from every position on the MLA."""

    @property
    def changes_evenly(self) -> bool:
        """Whether light imaged on neighbouring microlenses changes equally with the camera's parameters."""

    @property
    def entrance(self) -> Entrance:
        """Entrance pupil of the lens."""

    @property
    def round_map(self) -> RoundMap | None:
        """Map from the pupil seen off the axis to the round pupil near the axis; None if both are the same."""

    def start_bounds(self, field: float) -> tuple[float, tuple[float, ...]]:
        """Return the radius, and the values of z, that bound the start points of rays to the MLA within `field`."""

    def waves_of(self, points: NDArray[np.float64]) -> MainLens:
        """Return the lens for wave propagation from scene points (n, 3).

        Parameters
        ----------
        points : float64 array (n, 3)
            Scene points in the camera frame.

        Raises
        ------
        InputError
            If a point does not lie before a real main lens, or lies outside the field that the lens covers.
        PhysicsError
            If the path of a point cannot be fitted.
        """

    def waves_of_one(self, point: NDArray[np.float64]) -> PointLight:
        """Return the light of a single scene point (3,), as exactly as the lens can represent it."""

    def farthest(self, distances: Sequence[float]) -> NDArray[np.float64]:
        """Return points (n, 3) with which `waves_of` covers all light from finite distances that a detector sees."""

    def chief_point(self, position: Any, detector_distance: Any) -> Any:
        """Return a coordinate, on the MLA, of the line from a detector position to the centre of the exit pupil."""

    def pupil_distance_from(self, behind: Any) -> Any:
        """Return the separation on the exit pupil, per difference in slope, of rays from a point behind the MLA."""

    def pupil_point(self, position: Any, slope: Any, height: Any = 0.0) -> Any:
        """Return a coordinate, on the exit pupil, of the ray from a position at a given height before the MLA.

        Parameters
        ----------
        position : array
            Coordinates of the positions from which the rays come.
        slope : array
            Their slopes along the same axis.
        height : array
            Distance of the positions before the MLA, towards the exit pupil.
        """

    def slope_to(self, pupil: Any, position: Any, height: Any = 0.0) -> Any:
        """Return the slope along one axis between points of the exit pupil and positions near the MLA.

        Parameters
        ----------
        pupil, position : array
            Coordinates on the exit pupil and near the MLA.
        height : array
            Distance of the positions before the MLA, towards the exit pupil.
        """

    def open_fraction(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the unvignetted fraction of the circle of radius `reach`, as seen from positions on the MLA."""

    def vergence(self, distance: Any) -> Any:
        """Return the reciprocal of the distance from the rear principal plane to the image of an object plane."""

    def trace(self, position: Pair, slope: Pair) -> Traced:
        """Return the ray from a position on the MLA to the scene: its start point, direction, and whether it passes.

        Parameters
        ----------
        position : (array, array)
            x and y on the MLA.
        slope : (array, array)
            dx/dz and dy/dz of the ray between MLA and lens.

        Returns
        -------
        point : (array, array, array)
            Start point of the ray towards the scene, in the camera frame.
        slope : (array, array)
            Slopes of the ray there.
        open : array
            Whether the ray passes the lens.
        """

    def convergence(self, distance: Any) -> Any:
        """Return the reciprocal of the distance from the exit pupil to the image of an object plane."""

    def ray(self, pupil: Pair, position: Pair) -> Traced:
        """Return the ray from a position on the MLA through a pupil point, in the form that `trace` returns."""

    def bind(self, points: NDArray[np.float64], which: Any = None) -> Light:
        """Return the light of some scene points.

        Parameters
        ----------
        points : float64 array (n, 3)
            The points in the camera frame, or in a frame rotated about the axis if the lens is round.
        which : UInt32 array of Dr.Jit, optional
            The point of each lane. Default: the light takes NumPy arrays (n, m), one row per point.
        """

    def images(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the positions (n, 2) on the MLA of the rays from scene points (n, 3) through the pupil's centre."""

    def inverse_distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the reciprocals (n,) of the distances of scene points (n, 3) from the lens's entrance pupil."""

    def points(self, images: NDArray[np.float64], inverse_distance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the scene points (n, 3) with given `images` and `inverse_distance`."""

    def meet_array(self, pupil: Any, cosine: Any, point: tuple[Any, Any, Any]) -> Any:
        """Return positions (2, ...) on the MLA of rays from points of the pupil with given direction cosines.

        Parameters
        ----------
        pupil, cosine : array (2, ...)
            Points of the exit pupil, and direction cosines of the rays there.
        point : (array, array, array)
            Scene point from which the rays come.
        """

    def open_part(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the fraction (n,) of the circle of radius `reach` that is unvignetted for each point."""

    def open_slopes(self, names: Iterable[str], points: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Return derivatives (1, n) of the logarithm of the open area of each point, for the parameters that affect it.

        For all other parameters the open area is that of a pupil that scales with the aperture.

        Parameters
        ----------
        names : iterable of str
            Parameters of the camera.
        points : float64 array (n, 3)
            Scene points in the camera frame.
        """

    def varying(self, numbers: Mapping[str, Any], names: Container[str], turned: Any) -> Any:
        """Return the lens with Dr.Jit parameters that carry gradients.

        Parameters
        ----------
        numbers : mapping
            Dr.Jit values: ``focal_length``, ``aperture_radius``, ``mla_distance``, ``wavelength``, ``wavefront``.
        names : container of str
            The parameters that vary.
        turned : float or Dr.Jit array
            Clockwise rotation of the scene, in degrees, that precedes the frame of the points.
        """

    def opaque(self, number: Callable[[Any], Any]) -> MainLens:
        """Return the lens with its plain parameters made opaque, by a function, to the compiler of kernels."""

    def stretch(self, x: Any, y: Any, camera: PlenopticCamera, distance: float) -> Pair:
        """Return where chief rays from the object points that bins assign to x, y meet the MLA.

        Parameters
        ----------
        x, y : array
            Coordinates on the MLA of the images of the bins, as a thin lens forms them.
        camera : PlenopticCamera
            The camera.
        distance : float
            Distance of the object plane in millimetres.
        """

    def within(self, images: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return positions (..., 2) on the MLA, moved to the edge of the illuminated field if they lie outside."""

    def cone(self, distances: Any) -> float:
        """Return half the range of direction cosines of a point's light at the MLA, the largest over `distances`."""

    def from_array(self, cosine: Pair, image: Pair) -> tuple[Pair, Any, Any]:
        """Return the pupil points of plane waves that reach a position on the MLA, as in the Debye integral.

        Parameters
        ----------
        cosine : (array, array)
            Direction cosines of the waves.
        image : (array, array)
            The position.

        Returns
        -------
        pupil : (array, array)
            Points of the exit pupil from which they come.
        length : array
            Length on the pupil per small range of direction cosines: :math:`dP = R ds` near the axis.
        path : array
            Path from there to the position, less that from the pupil's centre, in millimetres.
        """

    def to_array(self, pupil: NDArray[np.float64], image: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the direction cosines, (..., 2), from points of the exit pupil to positions on the MLA."""

    def chief_slope(self, image: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the slopes of the chief rays at positions on the MLA."""

    def curvature(self, square: Any) -> Any:
        """Return the wavefront curvature, at the MLA, of waves from the pupil at a squared distance from its centre."""

    def path_change(self, radius: Any, step: Any, wavelength: float) -> Any:
        """Return the difference in waves, at the pupil's edge, between wavefronts whose images lie a small step apart.

        The tilt that corresponds to the step is excluded.

        Parameters
        ----------
        radius : array
            Distance of the images from the axis in millimetres.
        step : array
            Distance between the images in millimetres.
        wavelength : float
            Wavelength in nanometres.
        """


class LightOnPupil(Protocol):
    """Path, amplitude and edge of scene points' light on the exit pupil; lengths in mm, wavelengths in nm.

    Points passed to its methods must be the points to which the object is bound.
    """

    def path(self, pupil: Pair, point: tuple[Any, Any, Any], wavelength: float) -> Any:
        """Return the path in waves from a scene point to an exit pupil point, less the path to the pupil's centre.

        Parameters
        ----------
        pupil : (array, array)
            Point on the exit pupil in millimetres.
        point : (array, array, array)
            Scene point in the camera frame in millimetres.
        wavelength : float
            Wavelength in nanometres.
        """

    def amplitude(self, pupil: Pair, point: tuple[Any, Any, Any]) -> Any:
        """Return the modulus of a scene point's field on the exit pupil, in units common to the whole field."""

    def inside(self, pupil: Pair) -> Any:
        """Return the distance in mm of a point from the edge of the exit pupil, positive inside."""


class Light(LightOnPupil, Protocol):
    """Light of scene points on the exit pupil, with its directions and the rays to the MLA."""

    def is_open(self, pupil: Pair) -> Any:
        """Return whether a point lies inside the exit pupil or, up to rounding, on its edge."""

    def cosines(self, pupil: Pair, point: tuple[Any, Any, Any]) -> Pair:
        """Return the direction cosines of a scene point's light at the exit pupil: the gradient of `path`."""

    def land(self, pupil: Pair, point: tuple[Any, Any, Any]) -> Pair:
        """Return the position in mm, on the MLA, of the ray from a scene point through a pupil point."""


class PointLight(LightOnPupil, Protocol):
    """Light of a single point, from `MainLens.waves_of_one`."""

    pupil_radius: Any
    pupil_distance: Any


@dataclass(frozen=True)
class Entrance:
    """The scene side of a main lens, in the camera frame: its entrance pupil; a thin lens is its own pupil.

    Attributes
    ----------
    pupil : float
        z of the entrance pupil, in millimetres.
    front : float
        z of a plane in front of the whole lens.
    magnification : float
        Coordinates on the exit pupil over those on the entrance pupil.
    """

    pupil: float = 0.0
    front: float = 0.0
    magnification: float = 1.0


@dataclass(frozen=True, eq=False)
class RoundMap:
    """Map from exit pupil points, seen from fields along x, to the corresponding points of the round pupil.

    Parameters
    ----------
    field : float
        Distance of the last field from the axis, on the array; the first is at 0.
    closed : float
        Distance from the axis, on the array, from which the lens lights nothing; infinity if the last field is lit.
    half : float
        Largest coordinate of the nodes in the plane of the pupil, along x and y.
    points : array
        Corresponding point of each node, and its distance from the centre, (fields, rows, columns, 3).
    """

    field: float
    closed: float
    half: float
    points: NDArray[np.float32]
