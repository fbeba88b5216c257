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

from ..camera import PlenopticCamera
from ..errors import InputError
from ..thin_lens import vergence
from . import rays
from .distortion import undistort
from .phase import in_millimetres, parabola
from .wavefront import Wavefront


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

    def aim(self, pupil: tuple[Any, Any], place: tuple[Any, Any]) -> tuple[Any, Any]:
        """Return the slopes, towards the scene, of the ray that comes from a place on the MLA through a pupil point."""

    def land(self, pupil: tuple[Any, Any], point: tuple[Any, Any, Any]) -> tuple[Any, Any]:
        """Return the place on the MLA of the ray from a scene point through a pupil point; `aim` leads back."""

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

    def cosines(self, pupil: tuple[Any, Any], point: tuple[Any, Any, Any]) -> tuple[Any, Any]:
        """Return the direction cosines in which a scene point's light leaves the exit pupil, the gradient of `path`."""

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


@dataclass(frozen=True)
class ThinLens:
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

    def aim(self, pupil: tuple[Any, Any], place: tuple[Any, Any]) -> tuple[Any, Any]:
        """Return the slopes of the ray to the conjugate of a place on the MLA; the aberrations are not followed."""
        tx, ty = ((P - q) / self.pupil_distance for P, q in zip(pupil, place, strict=True))
        return self._refract((tx, ty), pupil)

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
    """Refuse, for work by waves, a camera with a tilted array or a main lens that distorts or is not thin.

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
    camera.require_thin("waves are followed, but by method full_field,")
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
    """Refuse, for work by a kernel bank, a camera whose main lens has aberrations.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.

    Raises
    ------
    InputError
        If it has.
    """
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


def main_lens(camera: PlenopticCamera) -> MainLens:
    """Return a camera's main lens as waves pass it.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.

    Raises
    ------
    InputError
        If the camera has a tilted array or its main lens distorts or is not thin, which waves do not know.
    """
    require_ideal(camera)
    numbers = camera.focal_length, camera.aperture_radius, camera.mla_distance
    return ThinLens(*numbers, camera.lens_model, camera.wavefront)
