"""Random draws of the sensor's rays: for each detector point a lens, a point of that lens, and a wavelength."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from ..array import make_lattice
from ..array.lens_shifts import MOST_DEVIATIONS
from ..camera import PlenopticCamera
from ..design.quantities import (
    SECTORS,
    cosine_limits,
    crosstalk_defocus,
    crosstalk_neighbours,
    crosstalk_reach,
    turns_cosines,
)
from ..lenses.common import main_lens
from ..lenses.main_lens import Traced
from ..lenses.pupil import Pair
from ..optics.spectrum import RGB_WAVELENGTHS
from ..prescription import Glass
from ..prescription.glass import LINE_D
from ..prescription.lens_data import SINGLE
from ..runtime import drjit_array
from .tracer import Passage, PupilWalk, Walk

_STEP = 1.0
"""Step in nanometres of the wavelengths between which refractive indices are interpolated linearly, right to 1e-7."""

_FIELD_STEPS = 8
"""Steps of the distance from the axis in which the reach of light behind parabolic lenses is tabulated."""

_MIDDLES = 1024
"""Steps of the distance from the axis in which the middles of real lenses' pupils are tabulated."""

_MOST_CHECKED = 64
"""Largest number of lenses of which those that can light a point are counted for each ray."""


Rays = TypeVar("Rays", bound=PupilWalk)


@dataclass(frozen=True)
class RayColours:
    """Focal lengths and refractive indices for single rays, each with its own wavelength."""

    # Ratios of the focal lengths of the thin main lens and of the microlenses to the camera's parameters.
    ratio: Any
    mla_ratio: Any
    # Refractive indices behind each surface of a real main lens.
    indices: list[Any] | None

    def of(self, rays: Rays) -> Rays:
        """Return the path through the main lens for rays with these focal lengths and indices."""
        lens: Any = rays.lens
        if self.indices is not None:
            return replace(rays, lens=replace(lens, indices=self.indices))
        return replace(rays, lens=replace(lens, focal_length=lens.focal_length * self.ratio))


@dataclass(frozen=True)
class Dispersion:
    """The dispersion of a camera's glasses, for the colours of the active variant."""

    # In nanometres: the wavelengths of the channels in rgb variants, a grid in spectral variants.
    wavelengths: tuple[float, ...]
    # As in `RayColours`, at these wavelengths; a float where the value does not depend on the wavelength.
    ratio: Any
    mla_ratio: Any
    indices: list[Any] | None

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

    def draw(self, sample: Any, wavelengths: Any) -> tuple[RayColours, Any, Any]:
        """Return the optics of rays of random wavelengths, the unused part of the sample, and the channels' weights."""
        if mi.is_spectral:
            position = dr.clip((wavelengths[0] - self.wavelengths[0]) / _STEP, 0, len(self.wavelengths) - 1)
            low = mi.UInt32(dr.minimum(dr.floor(position), len(self.wavelengths) - 2))
            part = position - mi.Float(low)
            share = dr.zeros(mi.UnpolarizedSpectrum)
            share[0] = mi.Float(len(share))

            def take(table: Any) -> Any:
                first, second = dr.gather(mi.Float, table, low), dr.gather(mi.Float, table, low + 1)
                return first + part * (second - first)
        else:
            scaled = mi.Float(sample[0]) * 3
            whole = dr.minimum(dr.floor(scaled), 2)
            channel = mi.UInt32(whole)
            sample = mi.Point2f(scaled - whole, sample[1])
            share = mi.UnpolarizedSpectrum(*(dr.select(channel == i, mi.Float(3), 0) for i in range(3)))

            def take(table: Any) -> Any:
                return dr.gather(mi.Float, table, channel)

        def of(value: Any) -> Any:
            return take(value) if dr.is_array_v(value) else value

        indices = None if self.indices is None else [of(index) for index in self.indices]
        return RayColours(of(self.ratio), of(self.mla_ratio), indices), sample, share


@dataclass(frozen=True)
class Candidates:
    """Lenses around a chief ray's lens, from which the lens of each ray is drawn with equal probability."""

    # Steps in the lattice's indices, as two arrays; the first is the chief ray's own lens.
    steps: list[Any]
    # Distances from the chief ray's point within which the centres of lenses are tried, as of `cosine_limits`, by steps
    # of the distance from the axis, and the width of a step; None where all lenses are tried.
    limits: Any = None
    step: Any = 1.0
    # Change of the limits per relative change of a lens's focal length.
    defocus: Any = 0.0

    def limit(self, chief: Pair, towards: Pair) -> Any:
        """Return the distance in mm within which lens centres are tried, by their direction from the chief ray."""
        across, along = (
            towards[0] * chief[1] - towards[1] * chief[0],
            towards[0] * chief[0] + towards[1] * chief[1],
        )
        sector = dr.minimum(dr.floor(abs(dr.atan2(across, along)) * (SECTORS / math.pi)), SECTORS - 1)
        row = dr.floor(dr.minimum(dr.hypot(*chief) / self.step, dr.width(self.limits) // SECTORS - 1))
        return dr.gather(mi.Float, self.limits, mi.UInt32(row * SECTORS + sector))


def _varying_lens(camera: PlenopticCamera, numbers: dict[str, Any]) -> Any:
    """Return the main lens of a camera whose exposed parameters are given as Dr.Jit arrays."""
    wavefront = numbers.get("wavefront", mi.Float())
    aberrations = tuple(dr.gather(mi.Float, wavefront, i) for i in range(dr.width(wavefront)))
    return main_lens(camera, varying=numbers | {"wavefront": aberrations})


class RandomRays(NamedTuple):
    """Rays from detector points through random points of a lens or of the pupil."""

    # What `trace` needs to follow rays from other detector points through the same points.
    passage: Any
    traced: Traced
    weight: Any
    # Path of the light in front of the detector: how far sideways, and how deep.
    path: Pair


@dataclass(frozen=True)
class OrdinaryRays(PupilWalk):
    """The rays of a camera without a microlens array: from detector points through random points of the pupil."""

    # Dispersion of the glasses, if the paths of rays depend on colour.
    dispersion: Dispersion | None
    # Map from samples to points over a radius, the radius, and the power that passes them over that of the round pupil.
    draws: Callable[[Any], Pair]
    reach: Any
    share: Any
    # Middles of the pupil as detector points see it, over these points, by steps of the distance from the axis, and the
    # width of a step; None where the middle is always on the axis.
    middles: Any = None
    step: float = 1.0

    @classmethod
    def varying(cls, camera: PlenopticCamera, numbers: dict[str, Any]) -> OrdinaryRays:
        """Return the rays of a camera whose exposed parameters are given as Dr.Jit arrays."""
        plain = main_lens(camera)
        reach, middles, corner, dispersion = plain.reach, None, 1.0, Dispersion.of(camera)
        if not plain.is_uniform:
            corner = plain.corner
            heights = np.linspace(0, corner, _MIDDLES + 1)
            middle = plain.pupil_middle(heights)
            middles = drjit_array(mi.Float, np.append(0, middle[1:] / heights[1:]))
            tables = [] if dispersion is None else [np.atleast_1d(index)[[0, -1]] for index in dispersion.indices or ()]
            seen = [replace(plain, indices=ends) for ends in np.transpose(tables).tolist()] or [plain]
            aside = max(np.abs(each.pupil_middle(heights) - middle).max() for each in seen)
            # Rounding of the surfaces' coordinates moves rays at the pupil's edge.
            reach = max(each.pupil_reach(corner, about_middle=True) for each in seen) + aside + 4 * SINGLE * corner
        share = camera.aperture.share * (reach / plain.pupil.radius) ** 2
        made = camera.aperture.draws(), dr.opaque(mi.Float, reach), dr.opaque(mi.Float, share)
        return cls(camera, _varying_lens(camera, numbers), dispersion, *made, middles, corner / _MIDDLES)

    def draw(self, pixel: Pair, sample: Any, light: RayColours | None) -> RandomRays:
        """Return rays through points of the pupil, with the density of the power that passes them."""
        middle = self._middle(pixel)
        pupil = tuple(own + self.reach * place for own, place in zip(middle, self.draws(sample), strict=True))
        aside = dr.hypot(*(P - p for P, p in zip(pupil, pixel, strict=True)))
        return RandomRays(pupil, self.trace(pixel, pupil), self.share, (aside, self.lens.pupil.distance))

    def trace(self, pixel: Pair, pupil: Pair) -> Traced:
        """Return traced rays from detector points through points of the pupil."""
        return self.through_pupil(pupil, pixel)

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
        part = dr.detach(dr.lerp(*ends, position - mi.Float(low)))
        return part * pixel[0], part * pixel[1]

    def missed(self, pixel: Pair, sample: Any) -> float:
        """Return the part of the light of detector points that is not sampled."""
        return 0.0

    def steps(self, x: float, y: float) -> tuple[Pair, Pair]:
        """Return the changes of slope and place, at the detector, of rays from a step beside through a pupil point."""
        return (self.lens.pupil.slope(0.0, x), self.lens.pupil.slope(0.0, y)), (x, y)


@dataclass(frozen=True)
class CameraRays(Walk):
    """The walk of the sensor's rays, with the random draws of lenses and lens points."""

    # Dispersion of the glasses, if the paths of rays depend on colour.
    dispersion: Dispersion | None
    # The lenses that are tried, `candidates`.
    around: Candidates

    @classmethod
    def varying(cls, camera: PlenopticCamera, numbers: dict[str, Any]) -> CameraRays:
        """Return the walk of a camera whose exposed parameters are given as Dr.Jit arrays."""
        # The rotation is applied only if it is not zero, or a gradient for its angle is requested.
        turned = camera.mla_rotation != 0 or dr.grad_enabled(numbers["mla_rotation"])
        pitch, offset = numbers["mla_pitch"], numbers["mla_offset"]
        lattice = make_lattice(
            camera.mla_lattice,
            (dr.gather(mi.Float, pitch, 0), dr.gather(mi.Float, pitch, 1)) if dr.width(pitch) > 1 else (pitch, pitch),
            rotation=numbers["mla_rotation"] if turned else 0.0,
            offset=(offset.x, offset.y),
            aperture=camera.mla_aperture,
            fill=numbers["mla_fill"],
            displacement=camera.displacement(numbers["detector_distance"]),
        )
        rays = cls(
            camera,
            _varying_lens(camera, numbers),
            lattice,
            numbers["mla_focal_length"],
            numbers["detector_distance"],
            camera.mla_medium,
            Dispersion.of(camera),
            Candidates([]),
        )
        return replace(rays, around=rays.candidates())

    def draw(self, pixel: Pair, sample: Any, light: RayColours | None) -> RandomRays:
        """Return rays through points of lenses, which are drawn from those around chief rays."""
        passage, _, tried = self.pass_array(pixel, sample, self.around)
        if light is not None:
            lens = passage.lens._replace(focal_length=passage.lens.focal_length * light.mla_ratio)
            passage = passage._replace(lens=lens)
        traced = self.trace(pixel, passage)
        aside = dr.hypot(*(m - p for m, p in zip(passage.point, pixel, strict=True)))
        before, even, _ = self.out_of_array(pixel, passage)
        weight = tried * even * self.passed(passage.point, before, passage.lens.height)
        return RandomRays(passage, traced, weight, (aside, self.detector_distance))

    def chief(self, pixel: Pair) -> Traced:
        """Return traced rays from detector points through the centres of their chief rays' lenses."""
        passage, *_ = self.pass_array(pixel, mi.Point2f(0.5), Candidates([mi.Float(0), mi.Float(0)]))
        return self.trace(pixel, passage._replace(point=passage.lens.centre))

    def missed(self, pixel: Pair, sample: Any) -> float:
        """Return the part of the light of detector points through lenses that are not tried, by one ray from each."""
        steps = [step.numpy().astype(int) for step in self.around.steps]
        drawn = set(zip(*steps, strict=True))
        around = replace(self.candidates(beyond=max(self.camera.mla_pitches)), limits=None)
        passage, candidate, _ = self.pass_array(pixel, sample, around)
        _, _, open_ = self.trace(pixel, passage)
        beyond = mi.Bool([(int(i), int(j)) not in drawn for i, j in zip(*around.steps, strict=True)])
        chief, cell = self.chief_cell(pixel)
        lens = (index + dr.gather(mi.Float, step, candidate) for index, step in zip(cell, around.steps, strict=True))
        missed = dr.gather(mi.Bool, beyond, candidate) | ~self.tried(self.around, chief, *lens)
        return int(dr.count(open_ & missed)[0]) / max(1, int(dr.count(open_)[0]))

    def steps(self, x: float, y: float) -> tuple[Pair, Pair]:
        """Return the changes of slope and place, at the array, of rays from a step beside through a lens point."""
        z = self.detector_distance / self.medium
        return (-x / z, -y / z), (0.0, 0.0)

    def candidates(self, beyond: float = 0.0) -> Candidates:
        """Return the lenses from which the lenses of rays are drawn, at the wavelength that needs the most."""
        camera = self.camera
        seen = [camera] if self.dispersion is None else [camera, *self.dispersion.ends(camera)]
        defocus, reach = max(crosstalk_defocus(each) for each in seen), max(crosstalk_reach(each) for each in seen)
        # Displaced lenses are nearer, and irregular ones move their light, by at most this distance.
        beyond += camera.nearer(reach) + MOST_DEVIATIONS * camera.mla_jitter[1] * defocus
        steps = max((crosstalk_neighbours(each, beyond=beyond) for each in seen), key=len)
        limits, step = np.full(SECTORS, reach), 1.0
        if turns_cosines(camera):
            corner = math.hypot(*(np.abs(camera.pixel_coordinates(axis)).max() for axis in (0, 1)))
            radius = float(main_lens(camera).pupil.chief(corner + camera.pixel_size, camera.reduced_distance))
            radii, step = np.linspace(0, radius, _FIELD_STEPS + 1), radius / _FIELD_STEPS
            limits = np.max([cosine_limits(each, radii) for each in seen], axis=0)
            # A step has the limits of both of its ends.
            limits = np.maximum(limits[:-1], limits[1:])
            steps = max(steps, camera.lattice.neighbours(limits.max() + beyond), key=len)
        numbers = [drjit_array(mi.Float, values) for values in (*steps.T, limits, step, defocus)]
        dr.make_opaque(numbers)
        # Most rays through lenses that cannot light a point would miss the pupil, and the others would be noisier.
        checks = 1 < len(steps) <= _MOST_CHECKED
        return Candidates(numbers[:2], *(numbers[2:] if checks else ()))

    def tried(self, candidates: Candidates, chief: Pair, i: Any, j: Any) -> Any:
        """Return whether lenses are close enough to the chief rays' points to be tried."""
        if candidates.limits is None:
            return mi.Bool(True)
        x, y = self.lattice.centre(i, j)
        towards = x - chief[0], y - chief[1]
        limit = candidates.limit(chief, towards)
        if self.camera.mla_jitter[1]:
            limit += abs(1 - 1 / self.camera.focal_factor(i, j)) * candidates.defocus
        return dr.hypot(*towards) <= limit

    def _draw(self, candidates: Candidates, chief: Pair, cell: Pair, sample: Any) -> tuple[Pair, Any, Any, Any]:
        """Return lenses drawn around cells, the unused part of the sample, the choice, and the number of choices."""
        (i, j), count, within = cell, dr.width(candidates.steps[0]), mi.Float(sample)
        if count == 1:
            return cell, within, mi.UInt32(0), mi.Float(1)

        def nth(number: Any) -> Pair:
            right, up = (dr.gather(mi.Float, step, number) for step in candidates.steps)
            return i + right, j + up

        tried, near = mi.Float(count), []
        if candidates.limits is not None:
            # Their own lens is always tried, so that the number is never 0.
            near = [mi.Bool(True)]
            near += [self.tried(candidates, chief, *nth(mi.UInt32(number))) for number in range(1, count)]
            tried = sum((dr.select(each, 1, 0) for each in near), mi.Float(0))
        scaled = within * tried
        whole = dr.minimum(dr.floor(scaled), tried - 1)
        choice, passed = mi.UInt32(whole), mi.Float(0)
        for number, each in enumerate(near):
            choice = dr.select(each & (passed == whole), number, choice)
            passed += dr.select(each, 1, 0)
        return nth(choice), scaled - whole, choice, tried

    def pass_array(self, pixel: Pair, lens_sample: Any, candidates: Candidates) -> tuple[Passage, Any, Any]:
        """Return random points of the array through which rays from detector points pass.

        `pixel` is the detector point, a pair of Dr.Jit arrays. The index of the chosen candidate, and the number of
        candidates from which it was drawn, times the brightness of its lens, are returned as well.
        """
        chief, cell = self.chief_cell(pixel)
        (i, j), within, candidate, tried = self._draw(candidates, chief, cell, lens_sample[0])
        lens = self.lenslet(i, j)
        dx, dy = self.lattice.aperture_point(within, lens_sample[1])
        return Passage((lens.centre[0] + dx, lens.centre[1] + dy), lens), candidate, tried * lens.gain

    def pass_pixel_lens(self, pixel: Pair, pixel_size: Any, pupil_sample: Any) -> tuple[Pair, Pair, Pair, Any]:
        """Return random points of the lenses above detector points, and random points of the pupil.

        Lenses cover 2 x 2 pixels; the position within a pixel chooses the point of the lens. The slopes towards the
        pupil, the column and row of each pixel under its lens, and the brightness of lenses are returned as well.
        """
        offset = self.lattice.offset
        index, side, within = [], [], []
        for axis, p in enumerate(pixel):
            position = (p - offset[axis]) / pixel_size
            whole = dr.floor(position)
            index.append(dr.floor((whole + 0.5) / 2))
            side.append(whole - 2 * index[axis])
            within.append(position - whole)
        lens = self.lenslet(*index)
        dx, dy = self.lattice.aperture_point(*within)
        point = lens.centre[0] + dx, lens.centre[1] + dy
        x, y = mi.warp.square_to_uniform_disk(pupil_sample)
        slope = tuple(self.lens.pupil.slope(self.lens.reach * P, m) for P, m in zip((x, y), point, strict=True))
        return point, slope, (side[0], side[1]), lens.gain


def rays_of(camera: PlenopticCamera, numbers: dict[str, Any]) -> CameraRays | OrdinaryRays:
    """Return the rays of a camera whose exposed parameters are given as Dr.Jit arrays."""
    return (CameraRays if camera.has_array else OrdinaryRays).varying(camera, numbers)
