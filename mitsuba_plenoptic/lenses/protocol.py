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

from collections.abc import Callable, Container
from dataclasses import dataclass
from typing import Any, Protocol

from ..runtime import Doubles, Facts, Floats, Numbers, Pair, Triple
from .pupil import Pupil

Traced = tuple[Triple, Pair, Any]
"""Start point of a ray towards the scene, its slopes there, and whether it passes the main lens."""


class MainLens(Protocol):
    """The methods of a main lens that the camera uses; lengths in millimetres, wavelengths in nanometres.

    Methods for waves are called on the lens that `waves_of` returns, with the points that `waves_of` received.
    """

    @property
    def pupil(self) -> Pupil:
        """Exit pupil, as the MLA sees it."""

    @property
    def window(self) -> Pupil:
        """What bounds the directions of rays at the MLA: the exit pupil or, in an image of the stop, the field stop."""

    @property
    def reach(self) -> Any:
        """Radius in mm of a circle that contains `window` as seen from anywhere on the detector."""

    @property
    def is_uniform(self) -> bool:
        """Whether its light changes alike for all scene points, through the whole pupil: the lens has a closed form.

        Otherwise the lens is a `RealLens`, and the lens that `waves_of` returns a `FittedLens`.
        """

    @property
    def entrance(self) -> Entrance:
        """Entrance pupil of the lens."""

    def waves_of(self, points: Doubles) -> MainLens:
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

    def ray(self, pupil: Pair, position: Pair) -> Traced:
        """Return the ray from a position on the MLA through a pupil point, in the form that `trace` returns."""

    def bind(self, points: Doubles, index: Any = None) -> Light:
        """Return the light of some scene points.

        Parameters
        ----------
        points : float64 array (n, 3)
            The points in the camera frame, or in a frame rotated about the axis if the lens is round.
        index : UInt32 array of Dr.Jit, optional
            The point of each lane. Default: the light takes NumPy arrays (n, m), one row per point.
        """

    def images(self, points: Doubles) -> Doubles:
        """Return the positions (n, 2) on the MLA of the rays from scene points (n, 3) through the pupil's centre."""

    def points(self, images: Doubles, inverse_distance: Doubles) -> Doubles:
        """Return the scene points (n, 3) with given `images` and `common.inverse_distance`."""

    def varying(self, numbers: Facts, names: Container[str], turned: Any) -> Any:
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

    def opaque(self, convert: Callable[[Any], Any]) -> MainLens:
        """Return the lens with its plain parameters made opaque, by a function, to the compiler of kernels."""


class LightOnPupil(Protocol):
    """Path, amplitude and edge of scene points' light on the exit pupil; lengths in mm, wavelengths in nm.

    Points passed to its methods must be the points to which the object is bound.
    """

    def path(self, pupil: Pair, point: Triple, wavelength: float) -> Any:
        """Return the path in waves from a scene point to an exit pupil point, less the path to the pupil's centre.

        Points are in millimetres, the scene point in the camera frame.
        """

    def amplitude(self, pupil: Pair, point: Triple) -> Any:
        """Return the modulus of a scene point's field on the exit pupil, in units common to the whole field."""

    def inside(self, pupil: Pair) -> Any:
        """Return the distance in mm of a point from the edge of the exit pupil, positive inside."""


class Light(LightOnPupil, Protocol):
    """Light of scene points on the exit pupil, with its directions and the rays to the MLA."""

    def is_open(self, pupil: Pair) -> Any:
        """Return whether a point lies inside the exit pupil or, up to rounding, on its edge."""

    def cosines(self, pupil: Pair, point: Triple) -> Pair:
        """Return the direction cosines of a scene point's light at the exit pupil: the gradient of `path`."""

    def land(self, pupil: Pair, point: Triple) -> Pair:
        """Return the position in mm, on the MLA, of the ray from a scene point through a pupil point."""


class PointLight(LightOnPupil, Protocol):
    """Light of a single point, from `OpticalSystem.waves_of_one`."""

    @property
    def pupil(self) -> Pupil:
        """Exit pupil, as the MLA sees it."""


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
    radius, depths : float, floats
        Largest distance from the axis, and z, between which rays from the middle of the array start.
    growth : float
        Growth of this distance with the rays' distance from the axis on the array.
    """

    pupil: float = 0.0
    front: float = 0.0
    magnification: float = 1.0
    radius: float = 0.0
    depths: Numbers = (0.0,)
    growth: float = 0.0


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
    points: Floats
