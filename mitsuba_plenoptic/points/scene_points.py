r"""Incoherent points on a scene's surfaces where the camera's rays first hit, for the reference method.

A ray through a point q of the microlens array and a point P of the pupil hits a surface at X, where the child
integrator finds the radiance L. The surface is assumed to radiate uniformly in all directions; shadow rays find the
parts of the pupil that it lights. With n such rays from each lens, all pixels together record from a point

.. math:: L \, \frac{A_c}{n} \frac{A_{pupil} z^2}{b^2 A_{lens} A_{pixel} f}

where A_c is the area of a lens's cell, and f the fraction of the light to the visible pupil that lands in the lenses
from which rays start: only rays of this fraction could have found the point.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import refuse_if, warn
from ..fields import OpticalSystem
from ..io import digest
from ..lenses import RealLens
from ..optics import Spectrum
from ..rays import Entrances, LensWindow
from ..runtime import Array, Doubles, Floats, Integers, Job, Pair, Triple, drjit_array, require_memory_for
from ..scene import SceneLight, refuse_negative, world_ray
from .operator import CaptureOperator
from .pupil_weights import PupilWeights, slants
from .units import radiance_weight

PATHS = 64
"""Light paths averaged for each point: this reduces their noise to an eighth in less time than a point spread takes."""

_CELLS = 32
"""Cells across the pupil's bounding square, each with one shadow ray. Shadow borders are blurred by a few cells."""

_MIDDLES = [axis.ravel() for axis in np.meshgrid(*[(np.arange(_CELLS) + 0.5) * 2 / _CELLS - 1] * 2)]
"""x and y of the cells' centres for a pupil of radius 1, row by row."""

_LANES = 2**22
"""Approximate count of rays that are traced at once."""


@dataclass(frozen=True)
class ScenePoints:
    """Points that emit or reflect light, in the camera frame, with their radiance."""

    # Positions (x, y, z), an array (n, 3).
    positions: Doubles
    # The light that all pixels together record from each point, an array (n, channels).
    weights: Doubles
    # Visibility of the pupil from each point, and the slant of its surface; None if all points see all of it evenly.
    pupil_weights: PupilWeights | None


def sample_pairs(count: int, seed: int = 0) -> Doubles:
    """Return low-discrepancy points (count, 4) of the unit 4-cube: lens coordinates (2), pupil coordinates (2)."""
    # Imported here because it would take a third of the package's import time.
    from scipy.stats import qmc

    # The sequence is drawn to the next power of two, where it is balanced.
    return qmc.Sobol(4, scramble=True, rng=seed).random_base2(math.ceil(math.log2(count)))[:count]


def require_matte(scene: Any, sensor: Any, integrator: Any) -> None:
    """Refuse a scene unless all light comes directly from matte or emitting surfaces."""
    label = "method = points"
    shutter = sensor.shutter_open_time()
    hides = getattr(integrator, "hide_emitters", False) and integrator.class_name()
    sky = scene.environment() and scene.environment().id()
    for fault, reason in (
        (shutter > 0, f"the shutter is open for {shutter:g}: it needs a scene at rest"),
        (hides, f"nested {hides}: hide_emitters lets rays pass emitters; leave it out"),
        (sky is not None, f"emitter {sky} is infinitely far: it needs surfaces"),
        (sensor.get_medium() is not None, "the sensor is in a medium: it needs empty space"),
    ):
        refuse_if(fault, f"{label}: {reason}")
    require_matte_surfaces(scene, label)


def require_matte_surfaces(scene: Any, label: str) -> None:
    """Refuse a scene with surfaces that are not matte, with media or with instances."""
    bent = mi.BSDFFlags.Glossy, mi.BSDFFlags.Delta, mi.BSDFFlags.Delta1D
    for shape in scene.shapes():
        fault = None
        if shape.class_name() == "Instance":
            fault = "is an instance, whose materials are not known: place the shapes themselves"
        elif shape.interior_medium() is not None or shape.exterior_medium() is not None:
            fault = "bounds a medium: it needs empty space"
        elif any(mi.has_flag(shape.bsdf().flags(), lobes) for lobes in bent):
            fault = f"of type {shape.bsdf().class_name()} is not matte: it needs diffuse surfaces"
        refuse_if(fault, f"{label}: surface {shape.id()} {fault}")


def find_points(
    lights: Sequence[SceneLight], camera: PlenopticCamera, count: int, *, seed: int, paths: int = PATHS
) -> ScenePoints:
    """Return the points where the rays of all lenses first hit a surface, with the weights of their light."""
    camera.require_resolved()
    system = OpticalSystem.by_design(camera)
    window = LensWindow.of(system)
    lenses = len(window.index)
    label = f"spp = {count}: {count} points in each of {lenses} lenses"
    # Approximate memory of a point and its visibility mask, if every third mask is different.
    require_memory_for(lambda number: 1500.0 * number * lenses, count, label, "spp = {}".format, computed=True)
    pairs = sample_pairs(count, seed)
    finder = _Finder(lights, system, window, pairs, paths)
    total = len(window.index) * count
    step = max(1, _LANES // max(paths, _CELLS**2))
    seeds = np.random.SeedSequence(seed).generate_state(-(-total // step)).tolist()
    batches = [
        finder.find(np.arange(start, min(start + step, total)), seed_of_batch)
        for start, seed_of_batch in zip(range(0, total, step), seeds, strict=True)
    ]
    positions, radiance, slant, bits, cell, tried = (np.concatenate(parts) for parts in zip(*batches, strict=True))
    weights = None
    # Slant below which a surface counts as facing the lens.
    if len(positions) and not ((bits == 255).all() and (np.abs(slant) < 1e-3).all()):
        masks = PupilWeights.from_bits(bits, _CELLS)
        weights = PupilWeights(masks.table, masks.index, slant, sampled=True)
    area = system.lattice.cell_area / count
    scale = radiance_weight(camera, system.lens, area) / _landing(system, positions, weights, window)
    if not system.lens.is_uniform:
        # With few rays per lens, the fraction that passes differs from the pupil's open fraction by some percent.
        x, y = window.position(*(window.index + 0.5).T)
        open_rays = np.bincount(tried, minlength=len(x))
        scale = scale * (count * cast(RealLens, system.lens).open_fraction(x, y) / np.maximum(open_rays, 1))[cell]
    return ScenePoints(positions, radiance * scale[:, None], weights)


@dataclass(frozen=True)
class _Finder:
    """Tracer of rays that are numbered lens by lens."""

    lights: Sequence[SceneLight]
    system: OpticalSystem
    window: LensWindow
    pairs: Doubles
    paths: int

    def find(self, numbers: Integers, seed: int) -> tuple[Array, ...]:
        """Return the points where traced rays, given by their numbers, meet the scene.

        For lit points that rays hit, the positions, radiance, slants, visible pupil cells as bits, and lenses are
        returned; also the lenses of all rays that pass the main lens.
        """
        cell, pair = np.divmod(numbers, len(self.pairs))
        u, v, s, t = self.pairs[pair].T
        lens = self.system.lens
        radius = self.system.lens.reach
        square = mi.Point2f(drjit_array(mi.Float, s), drjit_array(mi.Float, t))
        P = mi.warp.square_to_uniform_disk_concentric(square) * radius
        i, j = self.window.index[cell].T
        q = tuple(drjit_array(mi.Float, x) for x in self.window.position(i + u, j + v))
        point, slope, is_open = lens.ray((P.x, P.y), q)
        # Thin lenses return scalars for the starting plane and the mask; they are widened to one value per ray.
        point = point[0], point[1], point[2] + dr.zeros(mi.Float, len(numbers))
        is_open = mi.Bool(is_open) & dr.full(mi.Bool, True, len(numbers))
        tried = cell[is_open.numpy()]
        hit = self.lights[0].scene.ray_intersect(world_ray(self.lights[0].sensor, point, slope), is_open)
        met = dr.compress(hit.is_valid())
        bits = np.empty((0, _CELLS**2 // 8), np.uint8)
        if not dr.width(met):
            channels = 1 if mi.is_spectral else dr.size_v(mi.UnpolarizedSpectrum)
            radiance = np.empty((0, channels * len(self.lights)))
            slant = np.empty((0, 2))
            return np.empty((0, 3)), radiance, slant, bits, cell[:0], tried
        P, point, slope = (tuple(dr.gather(mi.Float, x, met) for x in xs) for xs in (P, point, slope))
        hit = dr.gather(type(hit), hit, met)
        cell = cell[met.numpy()]
        radiance = self._radiance(point, slope, seed)
        lit = np.flatnonzero(radiance.max(axis=1) > 0)
        P, o, slopes = (np.stack([x.numpy() for x in xs], 1)[lit].astype(np.float64) for xs in (P, point, slope))
        ahead = hit.t.numpy()[lit] / np.sqrt(1 + (slopes**2).sum(1))
        positions = np.column_stack([o[:, :2] + slopes * ahead[:, None], o[:, 2] + ahead])
        normals = (self.lights[0].sensor.world_transform().inverse() @ mi.Normal3f(hit.n)).numpy().T[lit]
        front = lens.entrance
        slant = slants(normals, positions - np.array([0, 0, front.pupil]), radius / front.magnification)
        if len(lit):
            hit = dr.gather(type(hit), hit, drjit_array(mi.UInt32, lit))
            bits = self._visible(hit, Entrances(front, P, positions, slopes), radius)
        return positions, radiance[lit], slant, bits, cell[lit], tried

    def _radiance(self, point: Triple, slope: Pair, seed: int) -> Doubles:
        """Return the mean radiance of the light paths of each ray, an array (rays, channels)."""
        lane = dr.arange(mi.UInt32, dr.width(point[0]) * self.paths) // self.paths
        start, direction = (tuple(dr.gather(mi.Float, x, lane) for x in xs) for xs in (point, slope))
        # The same random numbers give light of all wavelengths the same paths.
        channels = [
            channel_light for light in self.lights for channel_light in light(start, direction, mi.Bool(True), seed)
        ]
        means = [dr.block_sum(channel, self.paths).numpy() / self.paths for channel in channels]
        radiance = np.stack(means, axis=1).astype(np.float64)
        refuse_if(
            not np.isfinite(radiance).all(), "scene: the radiance of some points is NaN or infinite: all must be finite"
        )
        refuse_negative(-float(np.minimum(radiance, 0).sum()), float(np.abs(radiance).sum()))
        return radiance

    def _visible(self, hit: Any, entrances: Entrances, radius: float) -> NDArray[np.uint8]:
        """Return the pupil cells that see points as bits (n, bytes); the cell of the point's own ray always does."""
        x, y = _MIDDLES
        # Cells whose centre is outside the pupil are sampled at the nearest point inside.
        inward = np.minimum(1, 0.999 / np.hypot(x, y)) * radius
        x = drjit_array(mi.Float, x * inward)
        y = drjit_array(mi.Float, y * inward)
        count = len(entrances.pupil)
        lane = dr.arange(mi.UInt32, count * _CELLS**2)
        point = lane // _CELLS**2
        cell = lane % _CELLS**2
        target = entrances.at(dr.gather(mi.Float, x, cell), dr.gather(mi.Float, y, cell), point)
        towards = dr.gather(type(hit), hit, point).spawn_ray_to(self.lights[0].sensor.world_transform() @ target)
        visible = ~self.lights[0].scene.ray_test(towards).numpy().reshape(count, -1)
        column, row = np.clip(((entrances.pupil.T / radius + 1) / 2 * _CELLS).astype(int), 0, _CELLS - 1)
        visible[np.arange(count), row * _CELLS + column] = True
        return np.packbits(visible, axis=1)


def _landing(system: OpticalSystem, positions: Doubles, weights: PupilWeights | None, window: LensWindow) -> Doubles:
    """Return the fraction of each point's light through the visible pupil that lands in the lenses of a window."""
    fraction = np.ones(len(positions))
    if not len(positions):
        return fraction
    # The wave model's own lens states where light lands, so that it agrees with the point spreads.
    lens = system.waves_of(positions)
    radius = system.lens.reach
    # The fraction differs from 1 only where rays from the pupil's edge land outside these lenses.
    rim = np.arange(8) * (math.pi / 4)
    edges = lens.bind(positions).land((radius * np.cos(rim), radius * np.sin(rim)), tuple(positions.T[..., None]))
    within = [(low < edge) & (edge < high) for edge, low, high in zip(edges, window.low, window.high, strict=True)]
    partial = np.flatnonzero(~(within[0] & within[1]).all(axis=1))
    x, y = _MIDDLES
    inside = np.flatnonzero(np.hypot(x, y) <= 1)
    x = x[inside]
    y = y[inside]
    pupil = x * radius, y * radius
    for some in np.array_split(partial, max(1, len(partial) * len(x) // 2**24)):
        light = lens.bind(positions[some])
        landed = window.contains(*light.land(pupil, tuple(positions[some].T[..., None])))
        power = np.broadcast_to(light.is_open(pupil), landed.shape).astype(float)
        if weights is not None:
            power *= 1 + weights.slant[some] @ np.stack([x, y])
            power *= weights.table.reshape(-1, _CELLS**2)[weights.index[some]][:, inside]
        # At least the ray that found the point has landed.
        fraction[some] = np.maximum((landed * power).sum(1), 1) / np.maximum(power.sum(1), 1)
    return fraction


@dataclass(frozen=True)
class PointsCapture:
    """A capture by method ``points``: camera, light, spectrum, and accuracy."""

    camera: PlenopticCamera
    # Radiance along rays; the channels of the light are those of all entries, one after another.
    lights: Sequence[SceneLight]
    # Wavelengths and the channels' responses.
    spectrum: Spectrum
    # Matrix (channels of light, wavelengths) from radiance to spectra; None if the light has a value per wavelength.
    upsampling: Doubles | None
    # Tolerance as in `CaptureOperator`.
    accuracy: float

    def compute(self, *, seed: int, spp: int, job: Job, noise: bool) -> Floats:
        """Return the capture of the scene, an array (rows, columns, channels)."""
        refuse_if(noise, "noise: method = points does not state it; compare seeds, or use signed_rays")
        points = find_points(self.lights, self.camera, spp, seed=seed)
        if not len(points.positions):
            warn("plenoptic_wave: no ray from the pupil meets anything that shines")
        pupil = points.pupil_weights
        operator = CaptureOperator(
            self.camera, points.positions, spectrum=self.spectrum, accuracy=self.accuracy, pupil_weights=pupil
        )
        weights = points.weights if self.upsampling is None else points.weights @ self.upsampling
        masks = [] if pupil is None else [pupil.table, pupil.index, pupil.slant]
        facts = {
            "points": len(points.positions),
            "scene_digest": lambda: digest(points.positions, points.weights, *masks),
            "responses": self.spectrum.responses,
        }
        shape = (*self.camera.shape, self.spectrum.channels)
        items = len(points.positions) * operator.sums
        image = job.run(operator.tasks(weights, job), shape, items, facts)
        if np.min(self.spectrum.responses) >= 0:
            # Negative values are errors of interpolation, unless responses are negative (colours outside of a gamut).
            np.maximum(image, 0, out=image)
        return image
