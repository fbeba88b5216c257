r"""Points of a scene's rough surfaces that lasers light directly, for a coherent capture.

Chief rays through a jittered grid of points on the microlens array, with some points in each resolved spot, find the
surfaces; shadow rays find the lasers that light them. A point stands for the part of the surface whose chief rays cross
the area A of one cell of the grid. With the radiance L that its surface reflects towards the camera, its power is

.. math:: w = L \, \frac{A}{b^2} \, \frac{A_{pupil} z^2}{A_{lens} A_{pixel}}

in the units of captures. Lasers are mutually coherent: the fields of several that light one point add with the phases
of their paths, so that the reflected light has the fringes of their interference.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...errors import InputError, did_you_mean, refuse_if
from ...fields import OpticalSystem
from ...optics import guards, in_millimetres
from ...points import radiance_weight
from ...rays import LensWindow
from ...runtime import Doubles, Triple, drjit_array, require_memory
from ...scene import random_numbers, world_ray

_COARSE = 64
"""Chief rays along each axis that find the distances of the surfaces, and so the width of their blur."""

_WIDER = 3.0
"""Width of the square of these rays over that of the recorded lenses."""

_SEARCH = 2**16
"""Number of rays from each laser, and of rays through the whole pupil, that find surfaces beside the chief rays."""

_ACROSS = 4
"""Chief rays along each axis through a shape that is at most as many times as large as their distance."""

_RIM = 12
"""Points on the edge of the pupil that must see the lit points."""

_RINGS = 8
_SPOKES = 32
"""Points of the pupil whose rays determine the width of the blur."""

_LANES = 2**20
"""Number of chief rays that are traced at once."""


@dataclass(frozen=True)
class LitPoints:
    """Points of surfaces that reflect laser light, with their powers."""

    # Positions in the camera frame, (n, 3).
    positions: Doubles
    # Power of each in the units of captures, (n,).
    weights: Doubles


@dataclass(frozen=True)
class LaserScene:
    """A scene with lasers, and the sensor that captures it."""

    scene: Any
    sensor: Any
    lasers: Sequence
    system: OpticalSystem

    def points(self, per_spot: float, seed: int) -> LitPoints:
        """Return lit points of the scene, with a given number in each square of side lambda b / D on the array."""
        lens = self.system.lens
        nothing = LitPoints(np.empty((0, 3)), np.empty(0))
        rng = np.random.default_rng(seed)
        window = LensWindow.of(self.system)
        middle = (window.low + window.high) / 2
        half = (window.high - window.low) / 2
        coarse = np.stack(np.meshgrid(*[(np.arange(_COARSE) + 0.5) * 2 / _COARSE - 1] * 2), -1).reshape(-1, 2)
        wide = middle + coarse * half * _WIDER
        search = np.random.default_rng([seed, 1])
        # What is small, or so far out of focus that only its blur reaches the detector, may be beside these rays.
        towards = np.concatenate([wide, self._laser_images(search), self._pupil_images(middle, half, search)])
        surfaces, _, _ = self._lit(np.concatenate([towards, *self._small_shapes(2 * half * _WIDER / _COARSE)]), seed)
        if not len(surfaces):
            # Surfaces, lit or not, whose blur may bring light.
            surfaces = self._in_camera(self._hit(wide))
        if not len(surfaces):
            return nothing
        blur = self._blur(surfaces)
        reaches = (np.abs(lens.images(surfaces) - middle) <= half + blur[:, None]).all(1)
        if not reaches.any():
            return nothing
        half = half + blur[reaches].max()
        spot = in_millimetres(self.system.wavelength) * lens.pupil.distance / (2 * lens.pupil.radius)
        count = np.ceil(2 * half / spot * math.sqrt(per_spot)).astype(int)
        total = math.prod(count.tolist())
        # Memory of a lit point.
        require_memory(64.0 * total, f"points_per_spot = {per_spot:g}: {total} rays to points")
        cell = 2 * half / count
        parts = []
        for first in range(0, total, _LANES):
            index = np.arange(first, min(first + _LANES, total))
            cells = np.stack([index % count[0], index // count[0]], 1) + rng.random((len(index), 2))
            parts.append(self._lit(middle - half + cells * cell, int(rng.integers(2**32))))
        positions, power, hidden = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        if power.sum() > 0:
            guards.check(guards.HIDDEN, float(power @ hidden / power.sum()))
        return LitPoints(positions, power * radiance_weight(self.system.camera, lens, float(cell.prod())))

    def _lit(self, positions_on_array: Doubles, seed: int) -> Triple:
        """Return lit points on chief rays, their radiance, and the fraction of the pupil's rim hidden from each.

        `positions_on_array` are (n, 2).
        """
        hit = self._hit(positions_on_array)
        radiance = self._radiance(hit, seed)
        lit = np.flatnonzero(radiance > 0)
        if not len(lit):
            return np.empty((0, 3)), np.empty(0), np.empty(0)
        hit = dr.gather(type(hit), hit, drjit_array(mi.UInt32, lit))
        positions = self._in_camera(hit)
        angle = 2 * math.pi * np.arange(_RIM) / _RIM
        hidden = np.zeros(len(lit))
        for x, y in self.system.lens.reach * np.stack([np.cos(angle), np.sin(angle)], 1):
            target = self.sensor.world_transform() @ mi.Point3f(float(x), float(y), 0)
            hidden += self.scene.ray_test(hit.spawn_ray_to(target)).numpy() / _RIM
        return positions, radiance[lit], hidden

    def _hit(self, positions_on_array: Doubles, pupil: Doubles | None = None) -> Any:
        """Return Mitsuba's intersections of chief rays, or of rays through given points (2, n) of the pupil."""
        q = tuple(drjit_array(mi.Float, positions_on_array[:, axis]) for axis in (0, 1))
        zero = dr.zeros(mi.Float, len(positions_on_array))
        through = (zero, zero) if pupil is None else tuple(drjit_array(mi.Float, axis) for axis in pupil)
        point, slope, _ = self.system.lens.ray(through, q)
        return self.scene.ray_intersect(world_ray(self.sensor, (point[0], point[1], point[2] + zero), slope))

    def _in_camera(self, hit: Any) -> Doubles:
        """Return the positions (n, 3) in the camera frame of the intersections that are valid."""
        positions = (self.sensor.world_transform().inverse() @ hit.p).numpy().T
        return np.asarray(positions, np.float64)[hit.is_valid().numpy()]

    def _images(self, hit: Any) -> Doubles:
        """Return where the chief rays of intersection points before the main lens meet the array, (n, 2)."""
        positions = self._in_camera(hit)
        return self.system.lens.images(positions[positions[:, 2] > 0])

    def _laser_images(self, rng: np.random.Generator) -> Doubles:
        """Return where chief rays of the points that lasers light meet the array."""
        parts = []
        for laser in self.lasers:
            a, b, c, d = (drjit_array(mi.Float, numbers) for numbers in rng.random((4, _SEARCH)))
            ray, _ = laser.sample_ray(self.sensor.shutter_open(), mi.Float(0.5), mi.Point2f(a, b), mi.Point2f(c, d))
            parts.append(self._images(self.scene.ray_intersect(mi.Ray3f(ray))))
        return np.concatenate(parts)

    def _pupil_images(self, middle: Doubles, half: Doubles, rng: np.random.Generator) -> Doubles:
        """Return array positions of the chief rays of all points that recorded lenses can see through the pupil."""
        positions = middle + half * (2 * rng.random((_SEARCH, 2)) - 1)
        radius = self.system.lens.reach * np.sqrt(rng.random(_SEARCH))
        angle = 2 * math.pi * rng.random(_SEARCH)
        return self._images(self._hit(positions, radius * np.stack([np.cos(angle), np.sin(angle)])))

    def _small_shapes(self, step: Doubles) -> list[Doubles]:
        """Return chief rays through the images of small shapes, a few `step` wide, one array per shape."""
        to_camera = self.sensor.world_transform().inverse()
        rays = []
        grid = np.stack(np.meshgrid(*[(np.arange(_ACROSS) + 0.5) / _ACROSS] * 2), -1).reshape(-1, 2)
        for shape in self.scene.shapes():
            box = shape.bbox()
            sides = np.array([box.corner(corner) for corner in range(8)], np.float32).T
            world = mi.Point3f(*(drjit_array(mi.Float, side) for side in sides))
            corners = (to_camera @ world).numpy().T.astype(float)
            if corners[:, 2].min() > 0:
                images = self.system.lens.images(corners)
                low = images.min(0)
                high = images.max(0)
                if (high - low < _ACROSS * step).all():
                    rays.append(low + (high - low) * grid)
        return rays

    def _blur(self, points: Doubles) -> Doubles:
        """Return the distance on the array, in mm, between the chief ray and other rays of each point (n, 3).

        The displacement is linear in the inverse distance, so that its greatest length is below straight lines between
        the lengths at some distances.
        """
        # A thin lens: the table of support refuses others.
        lens: Any = self.system.lens
        radius = lens.pupil.radius * (np.arange(_RINGS) + 1) / _RINGS
        angle = 2 * math.pi * np.arange(_SPOKES) / _SPOKES
        pupil = np.outer(radius, np.cos(angle)).ravel(), np.outer(radius, np.sin(angle)).ravel()
        inverse = 1 / points[:, 2]
        # 9: Distances at which the blur is computed.
        steps = np.linspace(inverse.min(), inverse.max(), 9)
        axial = ((0.0, 0.0, 1 / step) for step in steps)
        moved = (np.array(lens.land(pupil, point)).T - lens.land((0.0, 0.0), point) for point in axial)
        return np.interp(inverse, steps, [np.hypot(*displacement.T).max() for displacement in moved])

    def _radiance(self, hit: Any, seed: int) -> Doubles:
        """Return the radiance at hits: the squared modulus of the sum of the lasers' fields."""
        sampler = random_numbers(seed, dr.width(hit.t))
        context = mi.BSDFContext()
        bsdf = hit.bsdf()
        total = np.zeros(dr.width(hit.t), np.complex128)
        positions = hit.p.numpy().T.astype(np.float64)
        for laser in self.lasers:
            sample, arriving = laser.sample_direction(hit, sampler.next_2d(), hit.is_valid())
            active = hit.is_valid() & (sample.pdf > 0) & ~self.scene.ray_test(hit.spawn_ray_to(sample.p))
            refuse_if(
                dr.any(mi.unpolarized_spectrum(arriving)[0] < 0),
                f"lasers = {laser.id()}: its light is negative; intensities and irradiances must be at least 0",
            )
            reflected = bsdf.eval(context, hit, hit.to_local(sample.d), active) * arriving
            light = dr.select(active, mi.unpolarized_spectrum(reflected)[0], 0).numpy().astype(np.float64)
            refuse_if(not np.isfinite(light).all(), "scene: the laser light of some points is NaN or infinite")
            refuse_if(
                light.min(initial=0) < 0,
                f"lasers = {laser.id()}: a surface that it lights has a negative reflectance; it must be at least 0",
            )
            total += np.sqrt(light) * np.exp(2j * math.pi * self._path(laser, sample, positions))
        return np.abs(total) ** 2

    def _path(self, laser: Any, sample: Any, positions: Doubles) -> Doubles:
        """Return the path from a laser to points (n, 3) of the world, in waves modulo 1."""
        if mi.has_flag(laser.flags(), mi.EmitterFlags.DeltaDirection):
            towards = np.broadcast_to(sample.d.numpy().T.astype(np.float64), positions.shape)
            path = -(positions * towards).sum(1)
        else:
            path = np.linalg.norm(positions - sample.p.numpy().T.astype(np.float64), axis=1)
        return np.fmod(path / in_millimetres(self.system.wavelength), 1)


def named_lasers(scene: Any, names: Sequence[str], plugin: str) -> list:
    """Return the emitters with given ids; refuse emitters that cannot be lasers."""
    emitters = {emitter.id(): emitter for emitter in scene.emitters()}
    lasers = []
    for name in names:
        refuse_if(names.count(name) > 1, f"{plugin}: lasers = {name}: it is given more than once")
        if name not in emitters:
            raise InputError(
                f"{plugin}: lasers = {name}: the scene has no emitter of this id ({', '.join(sorted(emitters))})"
                f"{did_you_mean(name, emitters)}"
            )
        flags = emitters[name].flags()
        delta = mi.has_flag(flags, mi.EmitterFlags.DeltaPosition) or mi.has_flag(flags, mi.EmitterFlags.DeltaDirection)
        # Mitsuba cannot sample the directional ones among the surfaces that radiate.
        extended = mi.has_flag(flags, mi.EmitterFlags.Surface)
        refuse_if(
            extended or not delta,
            f"{plugin}: lasers = {name}: an emitter of type {emitters[name].class_name()} is extended; a laser is a "
            "point, spot, projector or directional emitter",
        )
        lasers.append(emitters[name])
    return lasers
