r"""The main lens, as rays and waves see it: everything else asks it, and nothing else knows its focal length.

A main lens stands in the camera frame, whose origin is its front principal plane. The microlens array (MLA) is at the
distance b behind its rear principal plane; for a thin lens both planes are z = 0. Rays are followed from the MLA to the
scene. Waves are followed the other way: a scene point has a field on the exit pupil, given by the path from the point
in waves and by its amplitude, and goes on from there to the MLA.

A new main lens is a new class with the methods of `MainLens`, and a case in `main_lens`. All methods take floats, NumPy
arrays or Dr.Jit arrays; where those carry gradients, so do the results.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from .telecentric import TelecentricLens
from .thin import ThinLens
from .wave_cameras import require_ideal


class MainLens(Protocol):
    """What the camera asks of its main lens. Lengths are millimetres, wavelengths nanometres."""

    @property
    def pupil_radius(self) -> Any:
        """Radius of the smallest circle about the axis that holds the exit pupil."""

    @property
    def pupil_distance(self) -> Any:
        """Distance from the exit pupil to the MLA."""

    @property
    def is_round(self) -> bool:
        """Whether it is the same all around the axis."""

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


class UniformLens(MainLens, Light, Protocol):
    """A main lens that is the light of any scene point itself: it need not be bound to some."""


def main_lens(camera: PlenopticCamera) -> UniformLens:
    """Return a camera's thin main lens, or its objective, as waves pass it.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.

    Raises
    ------
    InputError
        If the camera has a tilted array or its main lens distorts, which waves do not know, or is not thin.
    """
    require_ideal(camera)
    if camera.objective is not None:
        return TelecentricLens(camera.objective)
    camera.require_thin("this is done")
    numbers = camera.focal_length, camera.aperture_radius, camera.mla_distance
    return ThinLens(*numbers, camera.lens_model, camera.wavefront)
