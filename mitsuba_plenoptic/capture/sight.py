"""Rays from the pupil into the scene, and what they find there."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..bounds import SHORTEST
from ..errors import InputError
from ..optics.lens_system import LensSystem
from ..optics.main_lens import MainLens
from . import child
from .chains import Optics
from .draws import channels
from .first_vertex import first_vertex
from .places import seen_directly


@dataclass(frozen=True)
class Sight:
    """The scene as it is seen through the pupil.

    Attributes
    ----------
    optics : Optics
        The scene, and the integrator that finds the radiance.
    sensor : mitsuba.Sensor
        Where the pupil is, and when the shutter is open.
    wavelengths : tuple of float, optional
        For spectral variants: those of the channels of the radiance, in nanometres.
    """

    optics: Optics
    sensor: Any
    wavelengths: tuple[float, ...] | None

    @classmethod
    def of(cls, scene: Any, sensor: Any, integrator: Any, wavelengths: tuple[float, ...] | None) -> Sight:
        """Look at a scene with a Mitsuba integrator; where anything branches light, at one wavelength only.

        Raises
        ------
        InputError
            If there are several wavelengths, and mirrors, glass, cut-outs, masks or media.
        """
        optics = Optics.of(scene, child.Child.of(integrator), sensor)
        if wavelengths is not None and len(wavelengths) > 1 and not optics.plain:
            raise InputError(
                f"variant {mi.variant()}: {len(wavelengths)} wavelengths at once need a scene without mirrors, "
                "glass, cut-outs, masks and media; use an rgb variant, or one wavelength"
            )
        return cls(optics, sensor, wavelengths)

    def require_surfaces(self, lens: str) -> None:
        """Refuse what is seen through a microscope's objective by rays alone.

        Parameters
        ----------
        lens : str
            What messages call the objective.

        Raises
        ------
        InputError
            If there are mirrors, glass, cut-outs, masks or media, or an environment, which is infinitely far.
        """
        if not self.optics.plain or self.optics.scene.environment() is not None:
            raise InputError(
                f"main_lens = {lens}: behind an objective waves know scenes of surfaces without mirrors, glass, "
                "cut-outs, masks and media, and without an environment; capture by rays"
            )

    def vergences(self, lens: MainLens | LensSystem) -> tuple[float, float]:
        """Return the vergences of the images of the nearest and the farthest point that can be seen to shine."""
        box, to_camera = self.optics.scene.bbox(), self.sensor.world_transform().inverse()
        nearest = farthest = math.inf
        if box.valid():
            depths = [float((to_camera @ mi.Point3f(box.corner(corner))).z[0]) for corner in range(8)]
            nearest = max(SHORTEST, min(depths))
            # Mirrors and lenses show things from beyond.
            if self.optics.plain and self.optics.scene.environment() is None:
                farthest = max(nearest, *depths)
        return float(lens.vergence(nearest)), float(lens.vergence(farthest))

    def ray(self, point: tuple[Any, Any, Any], slope: tuple[Any, Any]) -> tuple[Any, Any]:
        """Return the ray from a point of the main lens, and the cosine of its angle with the axis."""
        direction = dr.normalize(mi.Vector3f(*slope, 1))
        to_world = self.sensor.world_transform()
        ray = mi.Ray3f(to_world @ mi.Point3f(*point), to_world @ direction)
        ray.time = self.sensor.shutter_open() + 0.5 * self.sensor.shutter_open_time()
        if self.wavelengths is not None:
            ray.wavelengths = self.lights(ray)[0].wavelengths
        return ray, direction.z

    def lights(self, ray: Any) -> list[Any]:
        """Return rays as all wavelengths take them together: several at a time, spread evenly over all of them."""
        if self.wavelengths is None:
            return [ray]
        lanes, count = len(ray.wavelengths), len(self.wavelengths)
        groups = -(-count // lanes)
        made = []
        for group in range(groups):
            own = self.wavelengths[group::groups]
            copy = mi.Ray3f(ray)
            # What is left over repeats the last.
            copy.wavelengths = type(ray.wavelengths)([own[min(lane, len(own) - 1)] for lane in range(lanes)])
            made.append(copy)
        return made

    def spectrum(self, radiances: list[Any]) -> list[Any]:
        """Return the channels of the radiances that were found along the rays of `lights`."""
        if self.wavelengths is None:
            return channels(radiances[0])
        groups = len(radiances)
        return [radiances[number % groups][number // groups] for number in range(len(self.wavelengths))]

    def look(
        self, point: tuple[Any, Any, Any], slope: tuple[Any, Any], seed: int, counts: Callable[[Any], Any] | None = None
    ) -> tuple[list[Any], Any]:
        """Sample the light along rays.

        Parameters
        ----------
        point : (Float, Float, Float)
            Where the rays leave the main lens, in the camera frame.
        slope : (Float, Float)
            Their slopes.
        seed : int
            Of the random numbers.
        counts : callable, optional
            Tells from the distances on which rays light counts; where it does not, it may be left out.

        Returns
        -------
        radiance : list of Float
            For each channel.
        distance : Float
            Distance, from the point along the axis, of the plane from which the light seems to come; infinite, or
            negative where it converges.
        """
        ray, cosine = self.ray(point, slope)
        if not self.optics.plain:
            vertex = first_vertex(self.optics, seed, ray, 1, counts and (lambda distance: counts(distance * cosine)))
            return channels(vertex.radiance), vertex.place.distance * cosine
        distance = seen_directly(self.optics.scene.ray_intersect(ray)).distance * cosine
        if counts is None:
            return self._light(ray, seed), distance
        mask = counts(distance)
        dr.eval(distance, mask, ray)
        some = dr.compress(mask)
        radiance = channels(dr.zeros(mi.UnpolarizedSpectrum, dr.width(ray)))
        if dr.width(some):
            for channel, light in zip(radiance, self._light(dr.gather(mi.Ray3f, ray, some), seed), strict=True):
                dr.scatter(channel, light, some)
        return radiance, distance

    def _light(self, ray: Any, seed: int) -> list[Any]:
        """Sample the light of rays that nothing branches, by channel."""
        sampler = child.random_numbers(seed, dr.width(ray))
        integrator = self.optics.child.integrator
        return channels(child.sample(integrator, self.optics.scene, sampler, ray, None, mi.Bool(True)))
