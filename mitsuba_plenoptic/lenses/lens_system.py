r"""Rays through a real lens, traced surface by surface.

The camera frame's origin is the front principal plane, and z increases towards the scene. The microlens array (MLA) is
at the distance b behind the rear principal plane. Both planes are those at the prescription's wavelength. A camera's
focal length scales the whole prescription, and its aperture radius is the radius of the entrance pupil.

There is no :math:`\cos^4` factor: as with the thin lens, a pixel is the mean radiance over its lens; light blocked by
surfaces or the stop counts as dark. Vignetting and pupil aberrations affect only which part of a micro-image is lit.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from ..errors import InputError, refuse_if
from ..prescription import Paraxial, Prescription, height, paraxial, vergence
from ..runtime import Doubles, Pair, Triple, maximum, rsqrt, select, sqrt
from . import sequential
from .accuracy import ACCURACY
from .protocol import Traced
from .pupil import Pupil


@dataclass(frozen=True, eq=False)
class LensSystem:
    """A lens of several surfaces in front of an array, stopped down and scaled.

    Parameters
    ----------
    prescription : Prescription
        The lens.
    focal_length : float or Dr.Jit array
        Focal length to which the lens is scaled.
    aperture_radius : float or Dr.Jit array
        Radius of the lens's entrance pupil.
    mla_distance : float or Dr.Jit array
        Distance from the rear principal plane to the array.
    wavelength : float, optional
        Wavelength in nanometres of the light. Default: the prescription's own.
    indices : sequence of float or Dr.Jit array, optional
        For `trace`: the refractive index behind each surface for each ray. Default: the indices at the wavelength.
    """

    prescription: Prescription
    focal_length: Any
    aperture_radius: Any
    mla_distance: Any
    wavelength: float | None = None
    indices: Sequence | None = None

    @classmethod
    def of(cls, camera: PlenopticCamera, wavelength: float | None = None) -> LensSystem:
        """Return the main lens of a camera that has a prescription.

        Parameters
        ----------
        wavelength : float, optional
            Wavelength in nanometres. Default: the prescription's own.
        """
        if camera.prescription is None:
            raise InputError("main_lens: the camera has none with surfaces")
        return cls(camera.prescription, camera.focal_length, camera.aperture_radius, camera.mla_distance, wavelength)

    @functools.cached_property
    def numbers(self) -> Paraxial:
        """Paraxial quantities of the unscaled prescription at the prescription's wavelength."""
        return paraxial(self.prescription)

    @functools.cached_property
    def scale(self) -> Any:
        """Scale factor from the prescription to the camera's lens."""
        return self.focal_length / self.numbers.focal_length

    @functools.cached_property
    def stop_radius(self) -> Any:
        """Radius of the stop in the prescription's lengths, before scaling."""
        full = self.prescription.surfaces[self.prescription.stop].semi_aperture
        return self.aperture_radius / self.scale * (full / self.numbers.entrance_radius)

    @property
    def pupil(self) -> Pupil:
        """The paraxial exit pupil."""
        distance = self.mla_distance + self.scale * (self.numbers.rear_principal - self.numbers.exit_pupil)
        return Pupil(self.aperture_radius * (self.numbers.exit_radius / self.numbers.entrance_radius), distance)

    @property
    def front(self) -> Any:
        """Coordinate z of the first surface's vertex in the camera frame, in mm."""
        return self.scale * self.numbers.front_principal

    @property
    def back_distance(self) -> Any:
        """Distance in mm from the last surface's vertex to the MLA."""
        return self.mla_distance + self.scale * self.numbers.rear_principal

    @property
    def front_bounds(self) -> tuple[float, Pair]:
        """Semi-aperture of the first surface, and the range of z that the surface occupies, in mm."""
        surface = self.prescription.surfaces[0]
        radius = surface.semi_aperture
        sag = height(surface, radius * radius)
        low, high = sorted((0.0, -float(sag)))
        return self.scale * radius, (self.front + self.scale * low, self.front + self.scale * high)

    def pupil_reach(self, field: float, about_middle: bool = False) -> float:
        """Return the largest distance in mm from the axis at which rays to the MLA cross the exit pupil's plane.

        Or, `about_middle`, from where the chief rays cross it, see `pupil_middle`.

        Parameters
        ----------
        field : float
            Largest distance from the axis on the MLA, in millimetres.
        about_middle : bool
            Whether distances are those from chief rays.

        Raises
        ------
        InputError
            If no ray passes the lens, even from the axis.
        """
        axis = np.linspace(-ACCURACY.tested_radius, ACCURACY.tested_radius, ACCURACY.tested_points) * self.pupil.radius
        heights = np.linspace(0, field, ACCURACY.tested_fields)
        y, Px, Py = np.meshgrid(heights, axis[ACCURACY.tested_points // 2 :], axis, indexing="ij")
        middle = self.pupil_middle(heights)[:, None, None]
        _, _, is_open = self.ray((Px, Py + middle), (np.zeros_like(y), y))
        refuse_if(not np.any(is_open[0]), "main_lens: no ray gets through it to the middle of the array")
        away = np.hypot(Px, Py if about_middle else Py + middle)
        return float(np.max(away[is_open])) + (axis[1] - axis[0])

    def pupil_middle(self, height: Doubles) -> Doubles:
        """Return where chief rays to heights on the MLA cross the exit pupil's plane; 0 where the lens blocks them."""
        middle = height + self.pupil.distance * self.chief_slope(height)
        is_open = self.ray((0 * height, middle), (0 * height, height))[2]
        return np.where(is_open, middle, 0.0)

    def vergence(self, distance: Any) -> Any:
        """Return the reciprocal of the distance from the rear principal plane to the image of an object plane.

        At other wavelengths than the prescription's, the principal planes move, too.

        Parameters
        ----------
        distance : float or array
            Distance of the plane before the front principal plane.
        """
        if self.light == self.prescription.wavelength:
            return vergence(self.focal_length, distance)
        here = paraxial(self.prescription, self.light)
        # Extra distances of the object from the front principal plane, and of the image from the rear one.
        front = self.scale * (here.front_principal - self.numbers.front_principal)
        rear = self.scale * (here.rear_principal - self.numbers.rear_principal)
        power = vergence(self.scale * here.focal_length, distance + front)
        return power / (1 + rear * power)

    def trace(self, position: Pair, slope: Pair) -> Traced:
        """Follow a ray from a position on the MLA to the scene, as described in `MainLens.trace`."""
        point, (L, M, N), is_open, _ = self._follow(position, slope)
        x, y, z = (self.scale * value for value in point)
        return (x, y, self.front + z), (L / N, M / N), is_open

    def clearance(self, position: Pair, slope: Pair) -> Any:
        """Return how far inside the nearest edge rays from the MLA pass, over that edge's radius; below 0: blocked."""
        squares: list = []
        is_open = self._follow(position, slope, squares)[2]
        squares = [square / surface.semi_aperture**2 for square, surface in zip(squares, self.backwards, strict=True)]
        inside = 1 - sqrt(functools.reduce(maximum, squares))
        # Farther outside, rays that turn back or miss surfaces tell no distance.
        return select(is_open, inside, maximum(-abs(inside), -0.25))

    def _follow(self, position: Pair, slope: Pair, squares: list | None = None) -> tuple[Triple, Triple, Any, Any]:
        """Return what `sequential.follow` does of rays from the MLA, in lengths of the prescription."""
        tx, ty = slope
        N = rsqrt(1 + tx * tx + ty * ty)
        x, y = (m / self.scale for m in position)
        start = (x, y, -self.back_distance / self.scale)
        return sequential.follow(self.backwards, start, (tx * N, ty * N, N), squares)

    def ray(self, pupil: Pair, position: Pair) -> Traced:
        """Return the ray from a position on the MLA through a point of the exit pupil, as `trace` does."""
        tx, ty = (self.pupil.slope(P, q) for P, q in zip(pupil, position, strict=True))
        return self.trace(position, (tx, ty))

    def beside(self, point: Triple, slope: Pair, change: Pair, step: Pair = (0.0, 0.0)) -> tuple[Triple, Pair]:
        """Return the ray that leaves the MLA from a slightly changed position with slightly changed slopes.

        The change is paraxial: the height is the same on both principal planes. Ray differentials need no more.

        Parameters
        ----------
        point, slope : tuple of array
            The ray in the form that `trace` returns.
        change, step : (array, array)
            Differences of the slopes and of the positions on the MLA.
        """
        moved = []
        turned = []
        for x, t, d, s in zip(point[:2], slope, change, step, strict=True):
            height = s + self.mla_distance * d
            turn = d - height / self.focal_length
            moved.append(x + height + point[2] * turn)
            turned.append(t + turn)
        return (moved[0], moved[1], point[2]), (turned[0], turned[1])

    def chief_slope(self, height: Any) -> Any:
        """Return the slope, at the MLA, of the ray from heights on the MLA's y axis through the stop's centre.

        Parameters
        ----------
        height : float64 array
            Heights in millimetres.
        """
        lens = self.backwards[: len(self.backwards) - self.prescription.stop]

        def at_stop(height: Doubles, slope: Doubles) -> Any:
            N = 1 / np.sqrt(1 + slope * slope)
            start = (0.0 * height, height / self.scale, -self.back_distance / self.scale)
            return sequential.follow(lens, start, (0.0 * slope, slope * N, N))[0][1]

        height = np.asarray(height, np.float64)
        slope = -height / self.pupil.distance / ACCURACY.height_steps
        for count in range(1, ACCURACY.height_steps + 1):
            target = height * count / ACCURACY.height_steps
            nearby = slope + 1e-3 * self.pupil.radius / self.pupil.distance
            for _ in range(ACCURACY.few_secants if count < ACCURACY.height_steps else ACCURACY.secants):
                low = at_stop(target, slope)
                high = at_stop(target, nearby)
                step = np.where(high == low, 0.0, low * (nearby - slope) / np.where(high == low, 1.0, high - low))
                slope, nearby = slope - step, slope
            # Far from the axis the paraxial pupil may be a bad guess.
            slope = slope * (min(count + 1, ACCURACY.height_steps) / count)
        return slope

    @property
    def light(self) -> float:
        """Wavelength of the light in nanometres, by default the prescription's."""
        return self.prescription.wavelength if self.wavelength is None else self.wavelength

    @functools.cached_property
    def backwards(self) -> list[sequential.Element]:
        """The surfaces in the order in which rays from the MLA meet them, stopped down, before scaling."""
        return sequential.elements(
            self.prescription, self.light, stop_radius=self.stop_radius, backwards=True, indices=self.indices
        )

    @functools.cached_property
    def forwards(self) -> list[sequential.Element]:
        """The surfaces in the order in which light from the scene meets them, stopped down, before scaling."""
        return sequential.elements(self.prescription, self.light, stop_radius=self.stop_radius)

    def through(self, point: Triple, slope: Pair) -> tuple[Pair, Pair, Any, Any]:
        """Return the ray from a scene point, which may lie anywhere along it, to the MLA.

        Parameters
        ----------
        point : (array, array, array)
            Point in the camera frame.
        slope : (array, array)
            Its slopes dx/dz and dy/dz.

        Returns
        -------
        place : (array, array)
            Position where the ray meets the MLA.
        slope : (array, array)
            Slopes of the ray there.
        open : array
            Whether the ray passes the lens.
        path : array
            Optical path from the point to the MLA, in millimetres.
        """
        x, y, z = tuple(value / self.scale for value in point)
        tx, ty = slope
        N = rsqrt(1 + tx * tx + ty * ty)
        # In the direction of the light z decreases, whereas the lens counts it in the opposite sense.
        start = (x, y, self.numbers.front_principal - z)
        (x, y, z), (L, M, N), is_open, path = sequential.follow(self.forwards, start, (-tx * N, -ty * N, N))
        left = (self.back_distance / self.scale - z) / N
        position = (self.scale * (x + left * L), self.scale * (y + left * M))
        return position, (-L / N, -M / N), is_open, self.scale * (path + left)
