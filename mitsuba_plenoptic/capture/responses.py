r"""Wave captures of scenes by the responses of photodiodes under lenses of a few wavelengths.

For each lens, rays are drawn through uniformly distributed points of the pupil to points x of a window around the lens.
The points x are drawn from the nodes of the table of responses W (`system.photodiodes`) about in proportion to their
magnitude, and a few of them from the light beyond the window. All photodiodes under the lens add the radiance of each
ray with their own signed weights. As in `signed_rays`, the mean radiance of independent rays of the same lens is
subtracted, and its light, whose response is known, is added as a whole. A pixel is a sum over the rays of its own lens,
without convolutions.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..lenses.base import Pair
from ..runtime.batches import Box, Part, PartialSum
from ..runtime.fft import busy_drjit
from ..system.optical_system import RayPupil
from ..system.photodiodes import PhotodiodeResponses, lens_centre, lens_range
from .noise import Mended
from .scene_light import SceneLight, require_finite
from .signed_capture import SignedCapture
from .signed_colours import FINE, Node, mixed
from .signed_draws import chances_of, tent

_LANES = 2**22
"""Approximate count of rays that are traced at once."""

_RAY_BYTES = 150
"""Approximate bytes of a ray."""

_FAR = 0.08
"""Fraction of the rays that are drawn from the light beyond the window."""

_LEAST = 0.05
"""Part of the mean magnitude of the table that is added to the density of points."""

_TURNS = tuple(int(step * 2**32) for step in 1.2207440846057596 ** -np.arange(1.0, 4.0))
"""Steps, in units of 2^-32, of an additive sequence that fills three dimensions evenly."""

_PROBES, _TIMED = 2**8, 2**12
"""Count of lenses whose light identifies a capture, and of lenses that are timed for an estimate."""


class Aimed(NamedTuple):
    """Rays that are drawn for lenses."""

    pupil: Pair
    # Points on the array, relative to the centre of the lens, and in the camera frame.
    point: Pair
    place: Pair
    open: Any
    # Node of the table of each ray, counted over zones; sample of the window; whether the point is beyond the window.
    node: Any
    sample: Any
    is_far: Any
    # Reciprocal of the density of the point.
    weight: Any
    # Random numbers by which shorter wavelengths choose a sample of their windows.
    chance: Pair


class Tables:
    """The tables of all nodes on the device of the active variant, and the distribution from which points are drawn."""

    def __init__(self, camera: PlenopticCamera, plans: Sequence[PhotodiodeResponses]) -> None:
        # The longest wavelength has the largest window.
        self.longest = longest = max(plans, key=lambda plan: plan.wavelength)
        self.camera, self.plans, self.count = camera, plans, longest.count
        index, table, _ = longest.table
        self._width, self._nodes = len(index), table.shape[1]
        self._index = mi.Int(index.ravel())
        self._packets = -(-(self.count**2) // 4)
        self._tables = [self._packed(plan.table[1]) for plan in plans]
        self._means = [[mi.Float(column) for column in plan.table[2].T] for plan in plans]
        # The integral of each node, by which light beyond the window is distributed to the photodiodes.
        self._wholes = [
            self._packed(plan.table[1].sum(2, keepdims=True) * ((plan.window / plan.samples) ** 2 / (1 - plan.tail)))
            for plan in plans
        ]
        density = np.sqrt((table**2).mean(-1))
        density += _LEAST * density.mean(-1, keepdims=True)
        # Nodes of other zones, which have no light in this one, are drawn near the pupil's rim.
        density[~density.any(-1)] = 1
        upto = np.cumsum(density, axis=-1, dtype=np.float64)
        self._upto = mi.Float((upto / upto[..., -1:]).astype(np.float32).ravel())

    def _packed(self, table: NDArray[np.float32]) -> Any:
        """Return a table (..., photodiodes) as a flat array in packets of four photodiodes."""
        return mi.Float(np.pad(table, [(0, 0)] * 3 + [(0, 4 * self._packets - self.count**2)]).ravel())

    def draw(self, index: Pair, lens: Any, sample: Any, seed: Any) -> Aimed:
        """Return rays of lenses with the given lattice indices; those of even and of odd samples are independent."""
        plan, system = self.longest, self.longest.system
        half, number = sample & 1, sample >> 1
        # Integers keep the sequence exact for any count of samples.
        words = [mi.sample_tea_32(lens, seed ^ (half * 8 + axis + 1))[0] for axis in range(3)]
        random = [mi.Float((word + number * turn) >> 8) * 2.0**-24 for word, turn in zip(words, _TURNS, strict=True)]
        one, other = (chances_of(lens, seed ^ (sample << 4) ^ word) for word in (12, 13))
        pupil = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(random[0], random[1])) * float(system.lens.reach)
        centre = lens_centre(self.camera, *index)
        slope = [-system.lens.slope_to(P, c) for P, c in zip(pupil, centre, strict=True)]
        chief = [-system.lens.slope_to(0.0, c) for c in centre]
        cosine, middle = (dr.rsqrt(1 + dr.square(t[0]) + dr.square(t[1])) for t in (slope, chief))
        column, row = (
            mi.Int(dr.floor((t * cosine - c * middle) / plan.step + plan.across + chance))
            for t, c, chance in zip(slope, chief, one[:2], strict=True)
        )
        within = (dr.minimum(column, row) >= 0) & (dr.maximum(column, row) < self._width)
        node = dr.gather(mi.Int, self._index, mi.UInt(row * self._width + column), within)
        inner = RayPupil(system).inner(tuple(pupil), centre)
        is_open = dr.square(inner[0]) + dr.square(inner[1]) <= plan.camera.pupil_radius**2
        is_open &= within & (node >= 0)
        node = mi.UInt(dr.maximum(node, 0)) + self._zone(index, one[2:]) * self._nodes
        is_far = random[2] < _FAR
        place, density = self._sample(node, dr.maximum(random[2] - _FAR, 0) / (1 - _FAR))
        step = plan.window / plan.samples
        tents = [tent(part) for part in other[:2]]
        down = place // plan.samples
        near = [
            (mi.Float(each) - plan.samples // 2 + t) * step
            for each, t in zip((place - down * plan.samples, down), tents, strict=True)
        ]
        far, thin = self._beyond(random[2] * (1 / _FAR), other[:2])
        point = tuple(dr.select(is_far, a, b) for a, b in zip(far, near, strict=True))
        weight = dr.select(is_far, thin / _FAR, step * step / (density * (1 - _FAR)))
        position = tuple(c + x for c, x in zip(centre, point, strict=True))
        return Aimed(tuple(pupil), point, position, is_open, node, place, is_far, weight, other[2:])

    def zone_means(self, number: int, index: Pair) -> list[Any]:
        """Return the mean responses of the photodiodes of lenses, interpolated between zones."""
        corners = []
        for chance in ((0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)):
            parts = [self._along(axis, each) for axis, each in enumerate(index)]
            share = mi.Float(1)
            for part, end in zip(parts, chance, strict=True):
                aside = part - dr.floor(part)
                share *= aside if end else 1 - aside
            corners.append((self._zone(index, chance), share))
        return [
            sum((dr.gather(mi.Float, mean, zone) * share for zone, share in corners), mi.Float(0))
            for mean in self._means[number]
        ]

    def values(self, number: int, aimed: Aimed, active: Any) -> list[Any]:
        """Return the responses of the photodiodes to rays at one of the wavelengths."""
        plan, longest = self.plans[number], self.longest
        if plan is longest:
            is_far, place = aimed.is_far, aimed.sample
        else:
            half = plan.window / 2
            is_far = dr.maximum(dr.abs(aimed.point[0]), dr.abs(aimed.point[1])) > half
            x, y = (
                mi.Int(dr.floor(x * (plan.samples / plan.window) + plan.samples // 2 + chance))
                for x, chance in zip(aimed.point, aimed.chance, strict=True)
            )
            x, y = (dr.select(each >= plan.samples, each - plan.samples, dr.maximum(each, 0)) for each in (x, y))
            place = mi.UInt(y * plan.samples + x)
        square = dr.square(aimed.point[0]) + dr.square(aimed.point[1])
        density = plan.tail_density * dr.rsqrt(square) / square
        result = []
        for packet in range(self._packets):
            near = (aimed.node * plan.samples**2 + place) * self._packets + packet
            own = dr.gather(mi.Vector4f, self._tables[number], near, active & ~is_far)
            far = aimed.node * self._packets + packet
            own += dr.gather(mi.Vector4f, self._wholes[number], far, active & is_far) * density
            result += list(own)
        return result[: self.count**2]

    def _along(self, axis: int, index: Any) -> Any:
        """Return positions among the zones along an axis."""
        zones = self.longest.zones.y if axis else self.longest.zones.x
        if len(zones) == 1:
            return mi.Float(0)
        scale = (len(zones) - 1) / (zones[-1] - zones[0])
        return dr.clip((mi.Float(index) - float(zones[0])) * float(scale), 0, len(zones) - 1)

    def _zone(self, index: Pair, chance: Pair) -> Any:
        """Return one of the zones around lenses, at random."""
        zones = self.longest.zones
        x, y = (
            mi.UInt(dr.minimum(dr.floor(self._along(axis, each) + part), count - 1))
            for axis, (each, part, count) in enumerate(zip(index, chance, (len(zones.x), len(zones.y)), strict=True))
        )
        return y * len(zones.x) + x

    def _sample(self, node: Any, random: Any) -> tuple[Any, Any]:
        """Draw a sample of the window of a node; return also its probability."""
        size = self.longest.samples**2
        first = node * size
        place = dr.binary_search(0, size - 1, lambda index: dr.gather(mi.Float, self._upto, first + index) <= random)
        upper = dr.gather(mi.Float, self._upto, first + place)
        lower = dr.gather(mi.Float, self._upto, first + dr.maximum(place, 1) - 1, place > 0)
        return place, dr.maximum(upper - lower, 1e-9)

    def _beyond(self, first: Any, chance: Pair) -> tuple[Pair, Any]:
        """Draw points beyond the window with the density of the light there; return the reciprocal of the density."""
        plan = self.longest
        sine = (2 * first - 1) * math.sqrt(0.5)
        cosine = dr.sqrt(1 - sine * sine)
        radius = plan.window / 2 / (cosine * dr.maximum(chance[0], 1e-4))
        x, y = radius * cosine, radius * sine
        turn = mi.UInt(chance[1] * 4)
        x, y = dr.select((turn & 1) == 0, x, -y), dr.select((turn & 1) == 0, y, x)
        x, y = (dr.select(turn < 2, each, -each) for each in (x, y))
        return (x, y), radius * radius * radius * (plan.tail / plan.tail_density)


@dataclass(frozen=True)
class LensRows:
    """The pixels of a block of rows of lenses, which are finished."""

    box: Box
    sums: NDArray[np.float32]

    @property
    def samples(self) -> int:
        """Count of pixels."""
        return self.sums.size

    def prepare(self) -> Callable[[], Part]:
        """Return the function that returns the pixels."""
        return partial(Part, self.box, self.sums)


class ResponseSum:
    """A capture by the responses of photodiodes, computed by rows of lenses; a `runtime.jobs.LongSum`."""

    arrays: Any = np

    def __init__(
        self,
        camera: PlenopticCamera,
        # Radiance along rays.
        light: Callable[..., list[Any]],
        # The wavelengths of the tables, and the channels that record each; their plans are `PhotodiodeResponses`.
        nodes: Sequence[Node],
        *,
        # Rays per pixel as in a ray capture, of which only those that pass the pupil are drawn.
        spp: int,
        seed: int,
    ) -> None:
        self._camera, self._light, self._nodes, self._seed = camera, light, nodes, seed
        self._tables = Tables(camera, [node.plan for node in nodes])
        self._across = across = self._tables.count
        self._pupils: dict[float, tuple[RayPupil, list[int]]] = {}
        for number, node in enumerate(nodes):
            pupil = RayPupil(node.plan.system)
            self._pupils.setdefault(pupil.system.lens.refraction, (pupil, []))[1].append(number)
        self.channels = max(channel for node in nodes for channel in node.channels) + 1
        rows, columns = camera.shape
        self.box = Box(0, 0, columns, rows)
        self._columns, self._rows = (lens_range(camera, across, axis) for axis in (0, 1))
        plan, lens = self._tables.longest, self._tables.longest.system.lens
        # A pixel is the mean over its area and the lens's aperture of the radiance of all rays by way of the pupil.
        scale = camera.detector_distance / (camera.mla_medium * plan.camera.pupil_distance)
        self._scale = (
            scale**2 * math.pi * float(lens.reach) ** 2 / (camera.pixel_size * camera.mla_fill * camera.mla_pitch) ** 2
        )
        # Two halves of the rays of a lens correct each other.
        self._rays = 2 * max(1, round(spp * across**2 * self._scale * camera.pixel_size**2 / 2))
        lenses = self._columns[1] - self._columns[0]
        height = max(1, _LANES // (self._rays * lenses))
        self._blocks = list(range(*self._rows, height))
        self.items = np.diff([*self._blocks, self._rows[1]]) * lenses

    def batches(self, first: int) -> Iterator[LensRows]:
        """Trace the rays of the blocks from index `first`, and yield their pixels."""
        size, columns = self._across, self._columns[1] - self._columns[0]
        for number in range(first, len(self._blocks)):
            top = self._blocks[number]
            rows = self.items[number] // columns
            lens = dr.arange(mi.UInt32, int(self.items[number]))
            row = lens // columns
            index = mi.Int(lens - row * columns) + self._columns[0], mi.Int(row) + int(top)
            seed = int(np.random.SeedSequence([self._seed, number]).generate_state(1)[0])
            with busy_drjit():
                sums = self._trace(index, lens, seed)
            pixels = np.stack([np.stack([value.numpy() for value in diodes], -1) for diodes in sums])
            pixels = pixels.reshape(-1, rows, columns, size, size).swapaxes(2, 3)
            camera = self._camera
            left, up = (
                low * size + count // 2 - crop
                for low, count, crop in zip(
                    (self._columns[0], int(top)), camera.resolution, camera.crop_offset, strict=True
                )
            )
            box = Box(left, up, int(columns * size), int(rows * size))
            yield LensRows(box, np.ascontiguousarray(pixels.reshape(-1, rows * size, columns * size), np.float32))

    def image(self, total: PartialSum) -> NDArray[np.float32]:
        """Return the sum of all blocks."""
        return np.ascontiguousarray(np.moveaxis(total.sums, 0, -1))

    def probe(self) -> NDArray[np.float32]:
        """Return the pixels of some lenses, which identify a scene and its camera."""
        return np.stack([value.numpy() for diodes in self._some(_PROBES, 0) for value in diodes])

    def cost(self) -> tuple[float, float]:
        """Estimate from some of the lenses the time in seconds and the bytes that the sum takes."""
        seconds = []
        for seed in range(3):
            start = time.perf_counter()
            with busy_drjit():
                dr.eval(self._some(_TIMED, seed))
                dr.sync_thread()
            seconds.append((time.perf_counter() - start) / min(_TIMED, self.items.sum()))
        tables = sum(2 * node.plan.nbytes for node in self._nodes)
        # The first run compiles the kernels, and is left out.
        return min(seconds[1:]) * float(self.items.sum()), tables + _RAY_BYTES * _LANES

    def _some(self, count: int, seed: int) -> list[list[Any]]:
        """Return the pixels of `count` lenses, evenly spaced over all."""
        every = int(self.items.sum())
        lens = mi.UInt32(np.linspace(0, every - 1, min(count, every)).astype(np.uint32))
        columns = self._columns[1] - self._columns[0]
        row = lens // columns
        return self._trace((mi.Int(lens - row * columns) + self._columns[0], mi.Int(row) + self._rows[0]), lens, seed)

    def _trace(self, index: Pair, lens: Any, seed: int) -> list[list[Any]]:
        """Trace the rays of lenses; return for each channel the values of the photodiodes of each lens."""
        tables, rays = self._tables, self._rays
        dr.eval(index, lens)
        lane = dr.arange(mi.UInt32, dr.width(lens) * rays)
        count = dr.opaque(mi.UInt32, rays)
        own = lane // count
        # The two halves of the rays of a lens follow each other.
        turn = lane - own * count
        later = turn >= count // 2
        sample = dr.select(later, 2 * turn - count + 1, 2 * turn)
        each = tuple(dr.gather(mi.Int, part, own) for part in index)
        word = dr.gather(mi.UInt32, lens, own)
        key = dr.opaque(mi.UInt32, seed & ~15)
        aimed = tables.draw(each, word, sample, key)
        result = [[mi.Float(0)] * self._across**2 for _ in range(self.channels)]
        for pupil, numbers in self._pupils.values():
            start, slope = pupil.trace(aimed.place, aimed.pupil, 0.0)
            seen = aimed.open & dr.all([dr.isfinite(value) for value in (*start, *slope)], axis=0)
            radiance = self._light(start, slope, seen, seed)
            counted = dr.select(seen, mi.Float(1), 0)
            require_finite(radiance, counted)
            counts = dr.block_sum(counted, rays // 2)
            means = [dr.select(counts > 0, dr.block_sum(light, rays // 2) / counts, 0) for light in radiance]
            dr.eval(means)
            other = own * 2 + dr.select(later, mi.UInt32(0), 1)
            held = [dr.gather(mi.Float, mean, other) for mean in means]
            whole = [dr.block_sum(mean, 2) / 2 for mean in means]
            for number in numbers:
                used, weights = self._nodes[number].mixture()
                responses = tables.values(number, aimed, seen)
                known = tables.zone_means(number, index)
                for channel, row in zip(self._nodes[number].channels, weights, strict=True):
                    change = mixed(row, [radiance[i] - held[i] for i in used]) * aimed.weight
                    parts = [
                        dr.block_sum(dr.select(seen, change * value, 0), rays) * (self._scale / rays)
                        for value in responses
                    ]
                    mean = mixed(row, [whole[i] for i in used])
                    share = dr.block_sum(counted, rays) / rays
                    result[channel] = [
                        old + part + mean * each * share * self._scale
                        for old, part, each in zip(result[channel], parts, known, strict=True)
                    ]
        dr.eval(result)
        return result


@functools.lru_cache(maxsize=4)
def _plan(camera: PlenopticCamera, wavelength: float, shortest: float, fine: bool) -> PhotodiodeResponses:
    """Return the responses of a camera, which are cached for further captures."""
    return PhotodiodeResponses(camera, wavelength, shortest, fine)


@dataclass(frozen=True)
class ResponseCapture(SignedCapture):
    """A capture by the responses of photodiodes: the camera, the light, the channels' responses and the accuracy."""

    has_gradients = False

    @cached_property
    def nodes(self) -> list[Node]:
        """Return the nodes, the wavelengths of the tables."""
        found = self.colours.shared(self.camera, self.accuracy)
        shortest = min(place for place, _, _ in found)
        nodes = [
            Node(_plan(self.camera.at_wavelength(place), place, shortest, self.accuracy < FINE), channels, weights)
            for place, channels, weights in found
        ]
        nodes[0].plan.require_memory(len(nodes))
        return nodes

    def _sum(
        self, kind: Callable[..., Any], light: SceneLight, nodes: list[Node], *, spp: int, seed: int
    ) -> Callable[[], Any]:
        """Return a function that constructs one sum, which is of one kind only."""
        return partial(ResponseSum, self.camera, light, nodes, spp=spp, seed=seed)

    def mended(self, image: NDArray[np.float32]) -> dict[int, Mended]:
        """Return no channels: the noise of few rays exceeds the light around, so that pixels remain as they are."""
        return {}
