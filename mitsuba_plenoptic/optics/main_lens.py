r"""The main lens, as rays and waves see it: everything else asks it, and nothing else knows its focal length.

A main lens stands in the camera frame, whose origin is its front principal plane. The microlens array (MLA) is at the
distance b behind its rear principal plane; for a thin lens both planes are z = 0. Rays are followed from the MLA to the
scene. Waves are followed the other way: a scene point has a field on the exit pupil, given by the path from the point
in waves and by its amplitude, and goes on from there to the MLA.

A new main lens is a new class with the methods of `MainLens`, and a case in `main_lens`. All methods take floats, NumPy
arrays or Dr.Jit arrays; where those carry gradients, so do the results.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError
from ..thin_lens import vergence
from . import rays
from .distortion import undistort
from .finite_pupil import FinitePupil
from .phase import in_millimetres, parabola
from .telecentric import TelecentricLens
from .wavefront import Wavefront

_ROUNDING = 1e-9
"""How far outside a round pupil, over its radius, a point counts as on its edge."""


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


@dataclass(frozen=True)
class ThinLens(FinitePupil):
    r"""A thin lens with a round pupil.

    Parameters
    ----------
    focal_length : float or Dr.Jit array
        Focal length :math:`f_1`.
    pupil_radius : float or Dr.Jit array
        Radius :math:`D_1 / 2`.
    pupil_distance : float or Dr.Jit array
        Distance b to the MLA.
    model : {"ideal", "parabolic"}
        How rays refract: by slopes, stigmatically, or by direction cosines, as the parabolic phase element that waves
        always pass.
    aberrations : floats or Dr.Jit numbers
        Coefficients of Zernike polynomials, see `wavefront`.
    """

    focal_length: Any
    pupil_radius: Any
    pupil_distance: Any
    model: str = "ideal"
    aberrations: Any = ()
    _wavefront: Wavefront = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        # At once: what is first made where Dr.Jit suspends gradients would carry none later.
        object.__setattr__(self, "_wavefront", Wavefront(self.aberrations, self.pupil_radius))

    @property
    def is_round(self) -> bool:
        """Without aberrations it is."""
        return len(self.aberrations) == 0

    def vergence(self, distance: Any) -> Any:
        r"""Return :math:`1/g' = 1/f_1 - 1/g`; zero or negative where there is no real image."""
        return vergence(self.focal_length, distance)

    def trace(
        self, place: tuple[Any, Any], slope: tuple[Any, Any]
    ) -> tuple[tuple[Any, Any, Any], tuple[Any, Any], Any]:
        """Follow a ray from a place on the MLA to the scene."""
        Px, Py = (rays.pupil_point(m, t, self.pupil_distance) for m, t in zip(place, slope, strict=True))
        if self.model == "ideal":
            behind = self._refract(slope, (Px, Py))
        else:
            behind = rays.cosines_to_slopes(*self._refract(rays.slopes_to_cosines(*slope), (Px, Py)))
        return (Px, Py, 0.0), behind, Px * Px + Py * Py <= self.pupil_radius * self.pupil_radius

    def _refract(self, direction: tuple[Any, Any], pupil: tuple[Any, Any]) -> tuple[Any, Any]:
        tx, ty = (rays.main_lens_slope(t, P, self.focal_length) for t, P in zip(direction, pupil, strict=True))
        if not self.is_round:
            sx, sy = self._wavefront.slope(*pupil)
            tx, ty = tx + sx, ty + sy
        return tx, ty

    def convergence(self, distance: Any) -> Any:
        """Return `vergence`: the lens is its own pupil."""
        return self.vergence(distance)

    def ray(self, pupil: tuple[Any, Any], place: tuple[Any, Any]) -> tuple[tuple[Any, Any, Any], tuple[Any, Any], Any]:
        """Return the ray to the conjugate of a place on the MLA; its own aberrations are not followed."""
        tx, ty = ((P - q) / self.pupil_distance for P, q in zip(pupil, place, strict=True))
        return (*pupil, 0.0), self._refract((tx, ty), pupil), True

    def bind(self, points: NDArray[np.float64], which: Any = None) -> ThinLens:
        """Return the lens, which is the same for all points."""
        return self

    def images(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where on the MLA the rays from scene points (n, 3) through the pupil's middle come; (n, 2)."""
        return np.asarray(rays.conjugate_coordinate(points[:, :2], points[:, 2:], self.pupil_distance))

    def nearness(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the reciprocals of the distances of scene points; (n,)."""
        return np.asarray(1 / points[:, 2])

    def points(self, images: NDArray[np.float64], nearness: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the scene points (n, 3) that have these `images` and this `nearness`."""
        distance = 1 / nearness[:, None]
        return np.hstack([images * (-distance / self.pupil_distance), distance])

    def land(self, pupil: tuple[Any, Any], point: tuple[Any, Any, Any]) -> tuple[Any, Any]:
        """Return the place on the MLA of the ray from a scene point through a pupil point, without aberrations."""
        b, f1, g = self.pupil_distance, self.focal_length, point[2]
        x, y = (rays.mla_point(X, P, g, b, f1) for X, P in zip(point[:2], pupil, strict=True))
        if not self.is_round:
            sx, sy = self._wavefront.slope(*pupil)
            x, y = x + b * sx, y + b * sy
        return x, y

    def path(self, pupil: tuple[Any, Any], point: tuple[Any, Any, Any], wavelength: float) -> Any:
        r"""Return :math:`(|P - X| - |X| - P^2 / 2 f_1 + W(P)) / \lambda`, the paths' difference without cancellation.

        The lens is a thin parabolic phase element (Goodman, "Introduction to Fourier Optics", section 5.1) with the
        aberrations W.

        Parameters
        ----------
        pupil : (array, array)
            Point on the exit pupil in millimetres.
        point : (array, array, array)
            Scene point in the camera frame in millimetres.
        wavelength : float
            Wavelength in nanometres.
        """
        (Px, Py), (X, Y, g) = pupil, point
        square = Px * Px + Py * Py
        axis = _signed(_sqrt(X * X + Y * Y + g * g), g)
        difference = (square - 2 * (Px * X + Py * Y)) / (_distance(pupil, point) + axis)
        waves = difference * (1 / in_millimetres(wavelength)) + parabola(square, self.focal_length, wavelength)
        return waves if self.is_round else waves + self._wavefront.path(Px, Py) * (1 / in_millimetres(wavelength))

    def amplitude(self, pupil: tuple[Any, Any], point: tuple[Any, Any, Any]) -> Any:
        r"""Return :math:`|g| / |P - X|^2`: the first Rayleigh-Sommerfeld solution (Goodman, section 3.5)."""
        length = _distance(pupil, point)
        return abs(point[2]) / (length * length)

    def inside(self, pupil: tuple[Any, Any]) -> Any:
        """Return how far within the edge of the pupil a point lies."""
        return self.pupil_radius - _sqrt(pupil[0] * pupil[0] + pupil[1] * pupil[1])

    def is_open(self, pupil: tuple[Any, Any]) -> Any:
        """Return whether a point lies within the edge of the pupil, or but for rounding on it."""
        return self.inside(pupil) >= -_ROUNDING * self.pupil_radius

    def cosines(self, pupil: tuple[Any, Any], point: tuple[Any, Any, Any]) -> tuple[Any, Any]:
        r"""Return :math:`(P - X) / |P - X| - P / f_1` along x and y, and the slope of the aberrations."""
        length = _distance(pupil, point)
        sx, sy = ((P - X) / length - P / self.focal_length for P, X in zip(pupil, point[:2], strict=True))
        if not self.is_round:
            x, y = self._wavefront.slope(*pupil)
            sx, sy = sx + x, sy + y
        return sx, sy

    def path_change(self, radius: Any, step: Any, wavelength: float) -> Any:
        r"""Return :math:`a (a^2 + 3 r^2) d / 2 b^3 \lambda`, of the third order (a: pupil's radius, d: step).

        Parameters
        ----------
        radius : array
            Distance of the images from the axis in millimetres.
        step : array
            Distance between the images in millimetres.
        wavelength : float
            Wavelength in nanometres.
        """
        a, b = self.pupil_radius, self.pupil_distance
        return a * (a * a + 3 * radius * radius) * step / (2 * b**3 * in_millimetres(wavelength))


def _distance(pupil: tuple[Any, Any], point: tuple[Any, Any, Any]) -> Any:
    """Return the distance |P - X|, negative for light that converges to a point behind the lens."""
    dx, dy, g = pupil[0] - point[0], pupil[1] - point[1], point[2]
    return _signed(_sqrt(dx * dx + dy * dy + g * g), g)


def _signed(length: Any, g: Any) -> Any:
    return dr.copysign(length, g) if dr.is_array_v(length) else np.copysign(length, g)


def _sqrt(value: Any) -> Any:
    return dr.sqrt(value) if dr.is_array_v(value) else np.sqrt(value)


@dataclass(frozen=True)
class DistortedLens(ThinLens):
    """A thin lens whose rays go on as if they came from another point of the MLA's plane; for rays only.

    Parameters
    ----------
    distortion : five floats
        See `mitsuba_plenoptic.optics.distortion`.
    """

    distortion: tuple[float, ...] = (0.0,) * 5

    def trace(
        self, place: tuple[Any, Any], slope: tuple[Any, Any]
    ) -> tuple[tuple[Any, Any, Any], tuple[Any, Any], Any]:
        """Follow a ray from a place on the MLA to the scene: through the same point of the pupil."""
        source = undistort(*place, self.distortion)
        moved = (t + (m - u) / self.pupil_distance for t, m, u in zip(slope, place, source, strict=True))
        return super().trace(source, (next(moved), next(moved)))


def require_ideal(camera: PlenopticCamera) -> None:
    """Refuse, for work by waves, a camera with a tilted array or a thin main lens that distorts.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.

    Raises
    ------
    InputError
        Naming the parameter.
    """
    require_regular(camera)
    for name in ("mla_tilt", "distortion"):
        if any(getattr(camera, name)):
            raise InputError(f"{name} = {getattr(camera, name)}: waves need 0; work by rays, or set it to 0")


def require_regular(camera: PlenopticCamera) -> None:
    """Refuse, for work by waves, an irregular array and pixels that answer to angles differently.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.

    Raises
    ------
    InputError
        Naming the parameter.
    """
    for name in ("mla_jitter", "pixel_response"):
        if any(getattr(camera, name)):
            raise InputError(f"{name} = {getattr(camera, name)}: it is for rays; work by rays, or leave it out")


def require_round(camera: PlenopticCamera) -> None:
    """Refuse, for work by a kernel bank, a camera whose main lens is not thin or has aberrations.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.

    Raises
    ------
    InputError
        If it has.
    """
    if camera.main_lens is not None:
        camera.require_thin("method bank is", "use method patch")
    if any(camera.wavefront):
        raise InputError("wavefront: method bank needs a main lens without aberrations; use patch, or set them to 0")


def require_no_glass(camera: PlenopticCamera, what: str) -> None:
    """Refuse, for work that knows no dispersion, a camera whose thin lenses are of glass.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    what : str
        The rule, before "leave it out".

    Raises
    ------
    InputError
        Naming the glass.
    """
    for name in ("glass", "mla_glass"):
        glass = getattr(camera, name)
        if glass is not None:
            raise InputError(f"{name} = {glass.name or glass.form}: {what} leave it out")


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
