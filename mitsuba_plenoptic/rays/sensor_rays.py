"""Sampler of the sensor's rays: for each detector point a lens, a point of that lens, and a wavelength."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..array import make_lattice
from ..camera import PlenopticCamera
from ..lenses import Traced, main_lens
from ..optics import RGB_WAVELENGTHS
from ..prescription import LINE_D, SINGLE, Glass
from ..runtime import Named, Numbers, Pair, drjit_array
from .lens_choice import CHIEF, LensChoice
from .tracer import Passage, Ray, Walk

_STEP = 1.0
"""Step in nanometres of the wavelengths between which refractive indices are interpolated linearly, right to 1e-7."""

_MIDDLES = 1024
"""Steps of the distance from the axis in which the middles of real lenses' pupils are tabulated."""


@dataclass(frozen=True)
class Dispersion:
    """Focal lengths and refractive indices of a camera at some wavelengths, or, after `draw`, for each ray."""

    # In nanometres: the wavelengths of the channels in rgb variants, a grid in spectral variants.
    wavelengths: Numbers
    # Ratios of the focal lengths of the thin main lens and of the microlenses to the camera's parameters; a float where
    # the value does not depend on the wavelength.
    ratio: Any
    mla_ratio: Any
    # Refractive indices behind each surface of a real main lens.
    indices: list | None

    @classmethod
    def of(cls, camera: PlenopticCamera) -> Dispersion | None:
        """Return the dispersion of a camera, or None if the paths of rays do not depend on colour."""
        if not camera.is_dispersive or not (mi.is_rgb or mi.is_spectral):
            return None
        wavelengths = RGB_WAVELENGTHS
        if mi.is_spectral:
            wavelengths = tuple(np.arange(mi.MI_CIE_MIN, mi.MI_CIE_MAX + _STEP, _STEP).tolist())

        def along(glass: Glass | None, value: Callable[[Glass, float], float]) -> Any:
            if glass is None:
                return 1.0
            # Beyond a glass's table detectors are nearly blind; the values at its ends are used there.
            low, high = glass.reach
            table = mi.Float([value(glass, min(max(wavelength, low), high)) for wavelength in wavelengths])
            dr.make_opaque(table)
            return table

        microlenses = along(camera.mla_glass, Glass.focal_ratio)
        if camera.mla_shape is not None:
            shape = camera.mla_shape
            microlenses = mi.Float([1 / shape.strength(wavelength) for wavelength in wavelengths])
            dr.make_opaque(microlenses)
        surfaces = camera.lens_data.traced_surfaces
        indices = [along(surface.glass, Glass.at) for surface in surfaces] if surfaces else None
        return cls(wavelengths, along(camera.glass, Glass.focal_ratio), microlenses, indices)

    def ends(self, camera: PlenopticCamera) -> list[PlenopticCamera]:
        """Return the camera at the shortest and at the longest wavelength."""
        glasses = [glass for glass in (camera.glass, camera.mla_glass) if glass is not None]
        low = max([min(self.wavelengths), *(glass.reach[0] for glass in glasses)])
        high = min([max(self.wavelengths), *(glass.reach[1] for glass in glasses)])
        return [camera.at_wavelength(wavelength) for wavelength in (min(low, LINE_D), max(high, LINE_D))]

    def draw(self, sample: Any, wavelengths: Any) -> tuple[Dispersion, Any, Any]:
        """Return the dispersion for rays of random wavelengths, what is left of the sample, and the channels' weights.

        In rgb variants each ray draws a channel; in spectral variants rays have `wavelengths`.
        """
        if mi.is_spectral:
            position = dr.clip((wavelengths[0] - self.wavelengths[0]) / _STEP, 0, len(self.wavelengths) - 1)
            low = mi.UInt32(dr.minimum(dr.floor(position), len(self.wavelengths) - 2))
            fraction = position - mi.Float(low)
            share = dr.zeros(mi.UnpolarizedSpectrum)
            share[0] = mi.Float(len(share))

            def at(table: Any) -> Any:
                first = dr.gather(mi.Float, table, low)
                second = dr.gather(mi.Float, table, low + 1)
                return first + fraction * (second - first)
        else:
            scaled = mi.Float(sample[0]) * 3
            channel_index = dr.minimum(dr.floor(scaled), 2)
            channel = mi.UInt32(channel_index)
            sample = mi.Point2f(scaled - channel_index, sample[1])
            share = mi.UnpolarizedSpectrum(*(dr.select(channel == i, mi.Float(3), 0) for i in range(3)))

            def at(table: Any) -> Any:
                return dr.gather(mi.Float, table, channel)

        def of_rays(value: Any) -> Any:
            return at(value) if dr.is_array_v(value) else value

        indices = None if self.indices is None else [of_rays(index) for index in self.indices]
        ratios = {"ratio": of_rays(self.ratio), "mla_ratio": of_rays(self.mla_ratio)}
        return replace(self, indices=indices, **ratios), sample, share

    def refracting(self, rays: RaySampler) -> RaySampler:
        """Return a sampler of rays that the main lens refracts with these focal lengths and indices."""
        lens: Any = rays.walk.lens
        if self.indices is not None:
            lens = replace(lens, indices=self.indices)
        else:
            lens = replace(lens, focal_length=lens.focal_length * self.ratio)
        return replace(rays, walk=replace(rays.walk, lens=lens))


@dataclass(frozen=True)
class PupilRays:
    """Sampler of the rays of a camera without a microlens array, through random points of the pupil."""

    walk: Walk
    # Dispersion of the glasses, if the paths of rays depend on colour.
    dispersion: Dispersion | None
    # Map from samples to points over a radius, the radius, and the power that passes them over that of the round pupil.
    draws: Callable[[Any], Pair]
    radius: Any
    share: Any
    # Middles of the pupil as detector points see it, over these points, by steps of the distance from the axis, and the
    # width of a step; None where the middle is always on the axis.
    middles: Any = None
    step: float = 1.0

    @classmethod
    def varying(cls, camera: PlenopticCamera, lens: Any) -> PupilRays:
        """Return the sampler of a camera whose lens may have gradients."""
        plain = main_lens(camera)
        radius = plain.reach
        middles = None
        corner = 1.0
        dispersion = Dispersion.of(camera)
        if not plain.is_uniform:
            corner = plain.corner
            heights = np.linspace(0, corner, _MIDDLES + 1)
            middle = plain.pupil_middle(heights)
            middles = drjit_array(mi.Float, np.append(0, middle[1:] / heights[1:]))
            tables = [] if dispersion is None else [np.atleast_1d(index)[[0, -1]] for index in dispersion.indices or ()]
            variants = [replace(plain, indices=ends) for ends in np.transpose(tables).tolist()] or [plain]
            aside = max(np.abs(lens_at_end.pupil_middle(heights) - middle).max() for lens_at_end in variants)
            # Rounding of the surfaces' coordinates moves rays at the pupil's edge.
            radius = (
                max(lens_at_end.pupil_reach(corner, about_middle=True) for lens_at_end in variants)
                + aside
                + 4 * SINGLE * corner
            )
        share = camera.aperture.share * (radius / plain.pupil.radius) ** 2
        return cls(
            Walk(camera, lens),
            dispersion,
            camera.aperture.draws(),
            dr.opaque(mi.Float, radius),
            dr.opaque(mi.Float, share),
            middles,
            corner / _MIDDLES,
        )

    def sample(self, pixel: Pair, sample: Any, dispersion: Dispersion | None) -> tuple[Ray, Pair]:
        """Return rays through points of the pupil with the density of the power that passes them, and these points."""
        middle = self._middle(pixel)
        pupil = tuple(c + self.radius * x for c, x in zip(middle, self.draws(sample), strict=True))
        origin, slope, valid = self.walk.through_pupil(pupil, pixel)
        return Ray(pixel, pixel, pupil, self.share, valid, origin, slope), pupil

    def second_leg(self, ray: Ray) -> Pair:
        """Return the path of the light of rays in front of the detector: how far sideways, and how deep."""
        return ray.aside(ray.P), self.walk.lens.pupil.distance

    def trace(self, pixel: Pair, pupil: Pair) -> Traced:
        """Return traced rays from detector points through points of the pupil."""
        return self.walk.through_pupil(pupil, pixel)

    def chief(self, pixel: Pair) -> Traced:
        """Return traced rays from detector points through the middle of the pupil."""
        return self.trace(pixel, self._middle(pixel))

    def _middle(self, pixel: Pair) -> Pair:
        """Return the middles of the pupil as detector points see it."""
        if self.middles is None:
            return mi.Float(0), mi.Float(0)
        position = dr.minimum(dr.hypot(*pixel) / self.step, _MIDDLES)
        low = mi.UInt32(dr.minimum(dr.floor(position), _MIDDLES - 1))
        ends = [dr.gather(mi.Float, self.middles, low + end) for end in (0, 1)]
        middle = dr.detach(dr.lerp(*ends, position - mi.Float(low)))
        return middle * pixel[0], middle * pixel[1]

    def missed(self, pixel: Pair, sample: Any) -> float:
        """Return the part of the light of detector points that is not sampled."""
        return 0.0

    def steps(self, x: float, y: float) -> tuple[Pair, Pair]:
        """Return the changes of slope and position, at the detector, of rays from a step beside to a pupil point."""
        return (self.walk.lens.pupil.slope(0.0, x), self.walk.lens.pupil.slope(0.0, y)), (x, y)


@dataclass(frozen=True)
class LensRays:
    """Sampler of the rays of a camera with a microlens array, through random points of random lenses."""

    walk: Walk
    # Dispersion of the glasses, if the paths of rays depend on colour.
    dispersion: Dispersion | None
    # The lenses of which one is drawn for each ray.
    choice: LensChoice

    @classmethod
    def varying(cls, camera: PlenopticCamera, lens: Any, numbers: Named) -> LensRays:
        """Return the sampler of a camera whose lens and exposed parameters may have gradients."""
        # The rotation is applied only if it is not zero, or a gradient for its angle is requested.
        turned = camera.mla_rotation != 0 or dr.grad_enabled(numbers["mla_rotation"])
        pitch = numbers["mla_pitch"]
        offset = numbers["mla_offset"]
        focal_length = numbers["mla_focal_length"]
        lattice = make_lattice(
            camera.mla_lattice,
            (dr.gather(mi.Float, pitch, 0), dr.gather(mi.Float, pitch, 1)) if dr.width(pitch) > 1 else (pitch, pitch),
            rotation=numbers["mla_rotation"] if turned else 0.0,
            offset=(offset.x, offset.y),
            aperture=camera.mla_aperture,
            fill=numbers["mla_fill"],
            displacement=camera.displacement(numbers["detector_distance"]),
        )
        walk = Walk(camera, lens, lattice, focal_length, numbers["detector_distance"], camera.mla_medium)
        rays = cls(walk, Dispersion.of(camera), CHIEF)
        return replace(rays, choice=LensChoice.of_points(rays.ends))

    @property
    def ends(self) -> list[PlenopticCamera]:
        """The camera at its own wavelength and, with dispersion, at the shortest and at the longest one."""
        camera = self.walk.camera
        return [camera] if self.dispersion is None else [camera, *self.dispersion.ends(camera)]

    def _pass(self, pixel: Pair, sample: Any, choice: LensChoice) -> tuple[Passage, Any, Any]:
        """Return random points of random lenses, the lenses' numbers in the choice, and the rays' weights."""
        (i, j), within, lens_number, tried = choice.draw(self.walk, pixel, sample[0])
        lens = self.walk.lenslet(i, j)
        dx, dy = self.walk.lattice.aperture_point(within, sample[1])
        return Passage((lens.centre[0] + dx, lens.centre[1] + dy), lens), lens_number, tried * lens.gain

    def sample(self, pixel: Pair, sample: Any, dispersion: Dispersion | None) -> tuple[Ray, Passage]:
        """Return rays through random points of lenses, which are drawn from those around chief rays."""
        passage, _, weight = self._pass(pixel, sample, self.choice)
        if dispersion is not None:
            lens = passage.lens._replace(focal_length=passage.lens.focal_length * dispersion.mla_ratio)
            passage = passage._replace(lens=lens)
        walk = self.walk
        m = passage.point
        height = passage.lens.height
        slope, even, emerges = walk.out_of_array(pixel, passage)
        x, y = (walk.lens.window.point(position, t, height) for position, t in zip(m, slope, strict=True))
        weight = weight * even * walk.transmittance((x, y), m)
        origin, slope, valid = walk.into_scene(m, slope, height)
        return Ray(pixel, m, (x, y), weight, valid & emerges, origin, slope), passage

    def sample_pupil(self, pixel: Pair, pixel_size: Any, sample: Any) -> tuple[Ray, Pair, Pair]:
        """Return rays through random points of the pupil to the lenses above detector points, for tabulated responses.

        Lenses cover 2 x 2 pixels; the position within a pixel chooses the point of the lens. The column and row of each
        pixel under its lens, and the slopes between lens and pupil, are returned as well.
        """
        walk = self.walk
        index = []
        side = []
        within = []
        for axis, p in enumerate(pixel):
            position = (p - walk.lattice.offset[axis]) / pixel_size
            cell = dr.floor(position)
            index.append(dr.floor((cell + 0.5) / 2))
            side.append(cell - 2 * index[axis])
            within.append(position - cell)
        lens = walk.lenslet(*index)
        dx, dy = walk.lattice.aperture_point(*within)
        m = (lens.centre[0] + dx, lens.centre[1] + dy)
        radius = walk.lens.reach
        x, y = (radius * P for P in mi.warp.square_to_uniform_disk(sample))
        behind = walk.lens.pupil.slope(x, m[0]), walk.lens.pupil.slope(y, m[1])
        # A pixel sees this square of the pupil through an ideal lens.
        area = dr.square(pixel_size * walk.lens.pupil.distance * walk.medium / walk.detector_distance)
        weight = math.pi * radius**2 / area * walk.transmittance((x, y), m) * lens.gain
        origin, slope, valid = walk.lens.trace(m, behind)
        return Ray(pixel, m, (x, y), weight, valid, origin, slope), (side[0], side[1]), behind

    def second_leg(self, ray: Ray) -> Pair:
        """Return the path of the light of rays between array and detector: how far sideways, and how deep."""
        return ray.aside(ray.m), self.walk.detector_distance + self.walk.camera.array_height(*ray.m)

    def trace(self, pixel: Pair, passage: Passage) -> Traced:
        """Return traced rays from detector points through points of lenses."""
        return self.walk.trace(pixel, passage)

    def chief(self, pixel: Pair) -> Traced:
        """Return traced rays from detector points through the centres of their chief rays' lenses."""
        passage, *_ = self._pass(pixel, mi.Point2f(0.5), CHIEF)
        return self.trace(pixel, passage._replace(point=passage.lens.centre))

    def missed(self, pixel: Pair, sample: Any) -> float:
        """Return the part of the light of detector points through lenses that are not tried, by one ray from each."""
        walk = self.walk
        if walk.camera.lens_data.images_stop:
            return 0.0  # all lenses of the stop's image are tried that the field stop leaves
        around = replace(LensChoice.of_points(self.ends, beyond=max(walk.camera.mla_pitches)), limits=None)
        passage, lens_number, _ = self._pass(pixel, sample, around)
        _, _, valid = self.trace(pixel, passage)
        beyond = mi.Bool([lens not in self.choice.lenses for lens in around.lenses])
        chief, cell = walk.chief_cell(pixel)
        near = self.choice.is_near(walk, chief, *around.at(cell, lens_number))
        missed = dr.gather(mi.Bool, beyond, lens_number) | ~near
        return int(dr.count(valid & missed)[0]) / max(1, int(dr.count(valid)[0]))

    def steps(self, x: float, y: float) -> tuple[Pair, Pair]:
        """Return the changes of slope and position, at the array, of rays from a step beside to a lens point."""
        z = self.walk.detector_distance / self.walk.medium
        return (-x / z, -y / z), (0.0, 0.0)


RaySampler = LensRays | PupilRays
"""The sampler of a camera's rays: with a microlens array it draws a lens for each, without one a point of the pupil."""


def sampler_of(camera: PlenopticCamera, numbers: Named) -> RaySampler:
    """Return the ray sampler of a camera whose exposed parameters are given as Dr.Jit arrays."""
    wavefront = numbers.get("wavefront", mi.Float())
    aberrations = tuple(dr.gather(mi.Float, wavefront, i) for i in range(dr.width(wavefront)))
    lens = main_lens(camera, varying=numbers | {"wavefront": aberrations})
    return LensRays.varying(camera, lens, numbers) if camera.has_array else PupilRays.varying(camera, lens)
