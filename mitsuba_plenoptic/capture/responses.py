"""Wave captures of scenes by the responses of photodiodes under lenses of a few wavelengths.

From the cell of each lens rays are drawn to the pupil, evenly over both. A ray contributes to the photodiodes of all
lenses around, with the signed response W of each (`system.response_tables`): the sum over the lenses of the near window
is complete, and lenses of the far window are drawn at random. So each photodiode sums over the rays of many lenses, and
rays are traced once. As in `signed_rays`, the mean radiance of independent rays around the lens is subtracted, and its
light, whose response is known, is added as a whole.
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
from ..system.photodiodes import NEAR, lens_centre, lens_range
from ..system.response_tables import PhotodiodeResponses, Window
from .noise import Mended
from .scene_light import SceneLight, require_finite
from .signed_capture import SignedCapture
from .signed_colours import FINE, Node, mixed
from .signed_draws import chances_of

_LANES = 2**23
"""Approximate count of rays that are traced at once."""

_RAY_BYTES = 120
"""Approximate bytes of a ray."""

_LEAST_RAYS = 8
"""Rays of a lens that are traced at once at the least, if it has as many."""

_DRAWN = 8
"""Lenses of the far window that each ray of a lens draws."""

_TURNS = tuple(int(step * 2**32) for step in 1.1673039782614187 ** -np.arange(1.0, 5.0))
"""Steps, in units of 2^-32, of an additive sequence that fills four dimensions evenly."""

_PROBES, _TIMED = 2**8, 2**6
"""Count of lenses whose light identifies a capture, and the sides in lenses of a block that is timed."""


class Aimed(NamedTuple):
    """Rays that are drawn for lenses."""

    pupil: Pair
    # Points on the array in the camera frame.
    place: Pair
    open: Any
    # Indices of the samples of the near and far tables of each wavelength, in the first cell of their windows.
    near: list[Any]
    far: list[Any]
    # Nodes of the wavelength for which lenses of the far window are drawn, counted over zones.
    node: Any


class Rays(NamedTuple):
    """The light of the rays of lenses."""

    # Light for each image of a channel at a wavelength.
    lights: list[Any]
    # Indices as in `Aimed`; rays that do not pass the pupil have those of a node without response.
    near: list[Any]
    far: list[Any]
    node: Any
    # Sums of the light, and counts of the rays that passed, of the two halves of the rays of each lens.
    sums: list[Any]
    counts: Any


class Grid(NamedTuple):
    """A rectangle of lenses."""

    # Lattice indices of the first lens.
    left: int
    top: int
    columns: int
    rows: int

    def within(self, margin: int) -> Grid:
        """Return the rectangle with a margin around it."""
        return Grid(self.left - margin, self.top - margin, self.columns + 2 * margin, self.rows + 2 * margin)

    def lenses(self) -> tuple[Pair, Any]:
        """Return the lattice indices of the lenses, row by row, and a number of each that no other lens has."""
        lens = dr.arange(mi.UInt32, self.rows * self.columns)
        row = lens // dr.opaque(mi.UInt32, self.columns)
        x = mi.Int(lens - row * self.columns) + dr.opaque(mi.Int, self.left)
        y = mi.Int(row) + dr.opaque(mi.Int, self.top)
        return (x, y), (mi.UInt32(y + 2**15) << 16) | mi.UInt32(x + 2**15)


class Tables:
    """The tables of all wavelengths on the device of the active variant."""

    def __init__(self, camera: PlenopticCamera, plans: Sequence[PhotodiodeResponses]) -> None:
        self.camera, self.plans, self.count = camera, plans, plans[0].count
        self._packets = -(-(self.count**2) // 4)
        self._index = [mi.Int(plan.table.nodes.ravel()) for plan in plans]
        self._near, self._far = (
            [self._packed(table) for table in part] for part in zip(*(p.table[1:3] for p in plans), strict=True)
        )
        self._means = [[mi.Float(column) for column in plan.table.means.T] for plan in plans]
        # Lenses of the far window are drawn for the wavelength with the widest one.
        self._widest = widest = max(range(len(plans)), key=lambda number: plans[number].far.lenses)
        self._drawn = mi.UInt32(_quantiles(plans[widest]).ravel())

    @property
    def margin(self) -> int:
        """Lenses around a lens whose rays it receives."""
        return self.plans[self._widest].far.lenses // 2

    def _packed(self, table: NDArray[np.float16]) -> Any:
        """Return a table (zones, nodes, y, x, photodiodes) in packets of four, and a node without response."""
        flat = table.reshape(-1, *table.shape[2:])
        flat = np.pad(flat, [(0, 1), (0, 0), (0, 0), (0, 4 * self._packets - self.count**2)])
        return mi.UInt32(np.ascontiguousarray(flat).view(np.uint32).ravel())

    def draw(self, index: Pair, lens: Any, half: Any, number: Any, seed: Any) -> Aimed:
        """Return rays of lenses with the given lattice indices; those of both halves are independent."""
        system = self.plans[0].system
        # Integers keep the sequence exact for any count of samples.
        words = [mi.sample_tea_32(lens, seed ^ (half * 8 + axis + 1))[0] for axis in range(4)]
        random = [mi.Float((word + number * turn) >> 8) * 2.0**-24 for word, turn in zip(words, _TURNS, strict=True)]
        chances = [chances_of(lens, seed ^ ((2 * number + half) << 5) ^ word) for word in (24, 25, 26)]
        pupil = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(random[0], random[1])) * float(system.lens.reach)
        centre = lens_centre(self.camera, *index)
        slope = [-system.lens.slope_to(P, c) for P, c in zip(pupil, centre, strict=True)]
        chief = [-system.lens.slope_to(0.0, c) for c in centre]
        cosine, middle = (dr.rsqrt(1 + dr.square(t[0]) + dr.square(t[1])) for t in (slope, chief))
        inner = RayPupil(system).inner(tuple(pupil), centre)
        is_open = dr.square(inner[0]) + dr.square(inner[1]) <= system.camera.pupil_radius**2
        zone, drawn = self._zone(index, chances[0][:2]), mi.UInt32(0)
        near: list[Any] = []
        far: list[Any] = []
        for number_of, (plan, table) in enumerate(zip(self.plans, self._index, strict=True)):
            n = 2 * plan.across + 1
            column, row = (
                mi.Int(dr.floor((t * cosine - c * middle) / plan.step + plan.across + chance))
                for t, c, chance in zip(slope, chief, chances[0][2:], strict=True)
            )
            within = (dr.minimum(column, row) >= 0) & (dr.maximum(column, row) < n)
            node = dr.gather(mi.Int, table, mi.UInt(row * n + column), within)
            is_open &= within & (node >= 0)
            nodes = plan.table.near.shape[1]
            node = dr.select(is_open, mi.UInt(node) + zone * nodes, len(plan.zones) * nodes)
            drawn = node if number_of == self._widest else drawn
            for window, chance, indices in ((plan.near, chances[1][:2], near), (plan.far, chances[1][2:], far)):
                x, y = (
                    mi.UInt(dr.floor(r * window.samples + part)) for r, part in zip(random[2:], chance, strict=True)
                )
                indices.append((node * window.across + y) * window.across + x)
        place = tuple(c + (r - 0.5) * self.camera.mla_pitch for c, r in zip(centre, random[2:], strict=True))
        return Aimed(tuple(pupil), place, is_open, near, far, drawn)

    def drawn(self, node: Any, random: Any) -> tuple[Pair, Any]:
        """Draw cells of the far window for nodes; return also reciprocal probabilities."""
        plan = self.plans[self._widest]
        window, quantiles = plan.far, _quantiles_of(plan.far)
        entry = dr.gather(
            mi.UInt32, self._drawn, node * quantiles + mi.UInt32(dr.minimum(random * quantiles, quantiles - 1))
        )
        cell = entry >> 16
        row = cell // window.lenses
        place = tuple(mi.Int(part) + window.first for part in (cell - row * window.lenses, row))
        return place, quantiles / mi.Float(entry & 0xFFFF)

    def near_values(self, number: int, first: Any, cell: Pair) -> list[Any]:
        """Return the responses of the photodiodes of a lens to rays from a lens of the near window."""
        return self._values(self._near[number], self.plans[number].near, first, cell, True)

    def far_values(self, number: int, first: Any, cell: Pair) -> list[Any]:
        """Return the responses of the photodiodes of a lens to rays from a lens of the far window."""
        window = self.plans[number].far
        low, high = dr.minimum(*cell) - window.first, dr.maximum(*cell) - window.first
        return self._values(self._far[number], window, first, cell, (low >= 0) & (high < window.lenses))

    def _values(self, table: Any, window: Window, first: Any, cell: Pair, active: Any) -> list[Any]:
        x, y = (mi.UInt32((each - window.first) * window.samples) for each in cell)
        index, result = first + y * window.across + x, []
        for packet in range(self._packets):
            words = dr.gather(mi.Vector2u, table, index * self._packets + packet, active)
            result += [_from_half(part) for word in words for part in (word << 16, word)]
        return result[: self.count**2]

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

    def _along(self, axis: int, index: Any) -> Any:
        """Return positions among the zones along an axis."""
        zones = self.plans[0].zones.y if axis else self.plans[0].zones.x
        if len(zones) == 1:
            return mi.Float(0)
        scale = (len(zones) - 1) / (zones[-1] - zones[0])
        return dr.clip((mi.Float(index) - float(zones[0])) * float(scale), 0, len(zones) - 1)

    def _zone(self, index: Pair, chance: Pair) -> Any:
        """Return one of the zones around lenses, at random."""
        zones = self.plans[0].zones
        x, y = (
            mi.UInt(dr.minimum(dr.floor(self._along(axis, each) + part), count - 1))
            for axis, (each, part, count) in enumerate(zip(index, chance, (len(zones.x), len(zones.y)), strict=True))
        )
        return y * len(zones.x) + x


def _quantiles_of(window: Window) -> int:
    """Return the count of quantiles from which cells of a window are drawn, more than it has cells."""
    return 1 << math.ceil(math.log2(2 * window.lenses**2))


def _quantiles(plan: PhotodiodeResponses) -> NDArray[np.uint32]:
    """Return quantiles of the distribution over the cells of the far window of each node (nodes of all zones + 1, n).

    The density of a cell is about the magnitude of its responses. Each quantile is the index of a cell, and in its
    lower 16 bits the count of the quantiles of this cell.
    """
    window, count = plan.far, _quantiles_of(plan.far)
    lenses, low = window.lenses, -window.first - NEAR // 2
    nodes = plan.table.far.reshape(-1, *plan.table.far.shape[2:])
    result = np.full((len(nodes) + 1, count), 1, np.uint32)
    for node, values in enumerate(nodes):
        square = np.square(values[:-1, :-1], dtype=np.float32).mean(-1)
        density = np.sqrt(square.reshape(lenses, window.samples, lenses, window.samples).mean((1, 3)))
        density[low : low + NEAR, low : low + NEAR] = 0
        # Each cell has one quantile at least.
        share = density.ravel() / max(float(density.sum()), 1e-30)
        upto = np.round(np.cumsum(share) * (count - lenses**2))
        counts = 1 + np.diff(upto, prepend=0).astype(np.uint32)
        counts[-1] += count - counts.sum()
        result[node] = np.repeat((np.arange(lenses**2, dtype=np.uint32) << 16) | counts, counts)
    return result


def _from_half(word: Any) -> Any:
    """Return the half-precision numbers in the upper 16 bits of words."""
    bits = ((word & 0x7FFF0000) >> 3) | (word & 0x80000000)
    # The exponents of half precision are biased by 15, and those of single precision by 127.
    return dr.reinterpret_array(mi.Float, bits) * 2.0**112


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
        # The images: the wavelength and the channel of each.
        self._images = [
            (n, channel) for _, numbers in self._pupils.values() for n in numbers for channel in nodes[n].channels
        ]
        self.channels = max(channel for _, channel in self._images) + 1
        rows, columns = camera.shape
        self.box = Box(0, 0, columns, rows)
        self._columns, self._rows = (lens_range(camera, across, axis) for axis in (0, 1))
        plan = nodes[0].plan
        lens = plan.system.lens
        # A pixel is the mean over its area and the lens's aperture of the radiance of all rays by way of the pupil.
        scale = camera.detector_distance / (camera.mla_medium * plan.camera.pupil_distance)
        self._scale = (scale / (camera.pixel_size * camera.mla_fill)) ** 2 * math.pi * float(lens.reach) ** 2
        # Of the rays of a ray capture, those that pass the pupil. Two halves of them correct each other.
        rays = max(1, spp * across**2 * self._scale * (camera.pixel_size / camera.mla_pitch) ** 2 / 2)
        lenses, margin = self._columns[1] - self._columns[0], self._tables.margin
        row = lenses + 2 * margin
        at_once = max(_LEAST_RAYS, _LANES // (row * (self._rows[1] - self._rows[0] + 2 * margin))) / 2
        self._rounds = max(1, round(rays / at_once))
        self._rays = 2 * max(1, round(rays / self._rounds))
        height = max(2 * margin, _LANES // (row * self._rays) - 2 * margin)
        self._blocks = list(range(*self._rows, height))
        self.items = np.diff([*self._blocks, self._rows[1]]) * lenses

    def batches(self, first: int) -> Iterator[LensRows]:
        """Trace the rays of the blocks from index `first`, and yield their pixels."""
        size, columns = self._across, self._columns[1] - self._columns[0]
        for number in range(first, len(self._blocks)):
            top, rows = self._blocks[number], int(self.items[number]) // columns
            seeds = np.random.SeedSequence([self._seed]).generate_state(self._rounds).tolist()
            with busy_drjit():
                sums = self._captured(Grid(self._columns[0], top, columns, rows), seeds)
            pixels = np.stack([np.stack([value.numpy() for value in diodes], -1) for diodes in sums])
            pixels = pixels.reshape(-1, rows, columns, size, size).swapaxes(2, 3)
            camera = self._camera
            left, up = (
                low * size + count // 2 - crop
                for low, count, crop in zip((self._columns[0], top), camera.resolution, camera.crop_offset, strict=True)
            )
            box = Box(left, up, int(columns * size), int(rows * size))
            yield LensRows(box, np.ascontiguousarray(pixels.reshape(-1, rows * size, columns * size), np.float32))

    def image(self, total: PartialSum) -> NDArray[np.float32]:
        """Return the sum of all blocks."""
        return np.ascontiguousarray(np.moveaxis(total.sums, 0, -1))

    def probe(self) -> NDArray[np.float32]:
        """Return the light of the rays of some lenses, which identifies a scene and its camera."""
        columns, every = self._columns[1] - self._columns[0], int(self.items.sum())
        lens = np.linspace(0, every - 1, min(_PROBES, every)).astype(int)
        index = mi.Int(lens % columns + self._columns[0]), mi.Int(lens // columns + self._rows[0])
        rays = self._traced(index, mi.UInt32(lens), 0)
        return np.stack([light.numpy() for light in rays.sums])

    def cost(self) -> tuple[float, float]:
        """Estimate from some of the lenses the time in seconds and the bytes that the sum takes."""
        seconds = []
        (left, right), (top, bottom) = self._columns, self._rows
        columns, rows = min(_TIMED, right - left), min(_TIMED, bottom - top)
        grid = Grid((left + right - columns) // 2, (top + bottom - rows) // 2, columns, rows)
        for seed in range(3):
            start = time.perf_counter()
            with busy_drjit():
                dr.eval(self._captured(grid, [seed]))
                dr.sync_thread()
            around = grid.within(self._tables.margin)
            seconds.append((time.perf_counter() - start) / (around.columns * around.rows))
        tables = sum(2 * node.plan.nbytes for node in self._nodes)
        # The first run compiles the kernels, and is left out.
        return min(seconds[1:]) * self._rounds * float(self.items.sum()), tables + _RAY_BYTES * _LANES

    def _traced(self, index: Pair, lens: Any, seed: int) -> Rays:
        """Trace the rays of lenses with the given lattice indices and numbers."""
        rays = self._rays
        dr.eval(index, lens)
        lane = dr.arange(mi.UInt32, dr.width(lens) * rays)
        count = dr.opaque(mi.UInt32, rays)
        own = lane // count
        # The two halves of the rays of a lens follow each other.
        turn = lane - own * count
        half = dr.select(turn >= count // 2, mi.UInt32(1), 0)
        each = tuple(dr.gather(mi.Int, part, own) for part in index)
        word = dr.gather(mi.UInt32, lens, own)
        key = dr.opaque(mi.UInt32, seed & ~31)
        aimed = self._tables.draw(each, word, half, turn - half * (count // 2), key)
        lights, counted = [], mi.Float(0)
        for pupil, numbers in self._pupils.values():
            start, slope = pupil.trace(aimed.place, aimed.pupil, 0.0)
            seen = aimed.open & dr.all([dr.isfinite(value) for value in (*start, *slope)], axis=0)
            radiance = self._light(start, slope, seen, seed)
            counted = dr.select(seen, mi.Float(1), 0)
            require_finite(radiance, counted)
            for number in numbers:
                used, weights = self._nodes[number].mixture()
                lights += [dr.select(seen, mixed(row, [radiance[i] for i in used]), 0) for row in weights]
        dr.eval(lights, counted, aimed.near, aimed.far, aimed.node)
        sums, counts = [dr.block_sum(light, rays // 2) for light in lights], dr.block_sum(counted, rays // 2)
        dr.eval(sums, counts)
        return Rays(lights, aimed.near, aimed.far, aimed.node, sums, counts)

    def _captured(self, grid: Grid, seeds: Sequence[int]) -> list[list[Any]]:
        """Return the values of the photodiodes of each lens for each channel, means of a capture for each seed."""
        result = [[mi.Float(0)] * self._across**2 for _ in range(self.channels)]
        for seed in seeds:
            around = grid.within(self._tables.margin)
            rays = self._traced(*around.lenses(), seed)
            for (_, channel), values in zip(self._images, self._gathered(grid, rays, seed), strict=True):
                parts = zip(result[channel], values, strict=True)
                result[channel] = [old + value * (self._scale / len(seeds)) for old, value in parts]
            dr.eval(result)
        return result

    def _gathered(self, grid: Grid, rays: Rays, seed: int) -> list[list[Any]]:
        """Return the values of the photodiodes of each lens for each image, from the rays of all lenses around."""
        tables, count, size = self._tables, self._rays, self._across**2
        around = grid.within(tables.margin)
        lens, (index, _) = dr.arange(mi.UInt32, grid.rows * grid.columns), grid.lenses()
        line = dr.opaque(mi.UInt32, around.columns)

        def at(lens: Any, cell: Pair) -> Any:
            """Return the indices of lenses in the surrounding grid, displaced by cells."""
            row = lens // dr.opaque(mi.UInt32, grid.columns)
            x, y = lens - row * grid.columns + tables.margin, row + tables.margin
            return (y + mi.UInt32(mi.Int(cell[1]))) * line + x + mi.UInt32(mi.Int(cell[0]))

        # Means of the light of the lens and its eight neighbours, in each half of the rays.
        cells: list[Pair] = [(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)]
        counts, sums = (
            [
                [
                    sum((dr.gather(mi.Float, part, at(lens, cell) * 2 + half) for cell in cells), mi.Float(0))
                    for half in (0, 1)
                ]
                for part in parts
            ]
            for parts in ([rays.counts], rays.sums)
        )
        means = [
            [dr.select(number > 0, light / number, 0) for light, number in zip(each, counts[0], strict=True)]
            for each in sums
        ]
        dr.eval(means, counts)
        near = self._near_sums(grid, rays, means, at)
        far = self._far_sums(grid, rays, means, seed)
        part = (counts[0][0] + counts[0][1]) / (len(cells) * count)
        result = []
        for image, (number, _) in enumerate(self._images):
            mean = (means[image][0] + means[image][1]) / 2 * part
            known = tables.zone_means(number, index)
            own = slice(image * size, (image + 1) * size)
            parts = zip(near[own], far[own], known, strict=True)
            result.append([(close + wide) / count + mean * whole for close, wide, whole in parts])
        dr.eval(result)
        return result

    def _near_sums(self, grid: Grid, rays: Rays, means: list[list[Any]], at: Callable[[Any, Pair], Any]) -> list[Any]:
        """Return the sums over all rays of the near windows of lenses, for each image and photodiode."""
        tables, size = self._tables, self._across**2
        count = dr.opaque(mi.UInt32, self._rays)
        lane = dr.arange(mi.UInt32, grid.rows * grid.columns * self._rays)
        own = lane // count
        turn = lane - own * count
        held = [dr.select(turn >= count // 2, *(dr.gather(mi.Float, half, own) for half in each)) for each in means]

        def add(k: Any, *totals: Any) -> tuple[Any, ...]:
            row = mi.Int(k) // NEAR
            cell = mi.Int(k) - row * NEAR - NEAR // 2, row - NEAR // 2
            other = at(own, cell) * count + turn
            change = [dr.gather(mi.Float, light, other) - mean for light, mean in zip(rays.lights, held, strict=True)]
            first = [dr.gather(mi.UInt32, index, other) for index in rays.near]
            made = self._products(change, lambda number: tables.near_values(number, first[number], cell))
            return k + 1, *(total + part for total, part in zip(totals, made, strict=True))

        state = (mi.UInt32(0), *[mi.Float(0)] * (size * len(self._images)))
        _, *totals = dr.while_loop(state, lambda k, *_: k < NEAR**2, add, label="near photodiodes")
        return [dr.block_sum(total, self._rays) for total in totals]

    def _far_sums(self, grid: Grid, rays: Rays, means: list[list[Any]], seed: int) -> list[Any]:
        """Return estimates of the sums over all rays of the far windows of lenses, for each image and photodiode."""
        tables, size, margin = self._tables, self._across**2, self._tables.margin
        around = grid.within(margin)
        count, columns = dr.opaque(mi.UInt32, self._rays), dr.opaque(mi.UInt32, around.columns)
        width, height = dr.opaque(mi.Int, grid.columns), dr.opaque(mi.Int, grid.rows)
        lane = dr.arange(mi.UInt32, around.rows * around.columns * self._rays)
        lens = lane // count
        later = lane - lens * count >= count // 2
        row = lens // columns
        x, y = mi.Int(lens - row * columns) - margin, mi.Int(row) - margin
        key = dr.opaque(mi.UInt32, seed)
        totals = [dr.zeros(mi.Float, grid.rows * grid.columns) for _ in range(size * len(self._images))]

        def add(k: Any) -> tuple[Any]:
            random = mi.sample_tea_float32(lane, key + k)
            cell, weight = tables.drawn(rays.node, (mi.Float(k) + random) * (1 / _DRAWN))
            target = x - cell[0], y - cell[1]
            active = (dr.minimum(*target) >= 0) & (target[0] < width) & (target[1] < height)
            active &= dr.maximum(*(dr.abs(part) for part in cell)) > NEAR // 2
            index = mi.UInt32(target[1] * width + target[0])
            change = [
                (light - dr.select(later, *(dr.gather(mi.Float, half, index, active) for half in each))) * weight
                for light, each in zip(rays.lights, means, strict=True)
            ]
            made = self._products(change, lambda number: tables.far_values(number, rays.far[number], cell))
            for total, part in zip(totals, made, strict=True):
                dr.scatter_add(total, part * (1 / _DRAWN), index, active)
            return (k + 1,)

        dr.while_loop((mi.UInt32(0),), lambda k: k < _DRAWN, add, label="far photodiodes")
        dr.eval(totals)
        return totals

    def _products(self, change: list[Any], values_of: Callable[[int], list[Any]]) -> list[Any]:
        """Return the light of rays for each image times the responses of the photodiodes at its wavelength."""
        responses = {number: values_of(number) for number in {number for number, _ in self._images}}
        return [
            value * light
            for light, (number, _) in zip(change, self._images, strict=True)
            for value in responses[number]
        ]


@functools.lru_cache(maxsize=4)
def _plan(camera: PlenopticCamera, wavelength: float, fine: bool) -> PhotodiodeResponses:
    """Return the responses of a camera, which are cached for further captures."""
    return PhotodiodeResponses(camera, wavelength, fine=fine)


@dataclass(frozen=True)
class ResponseCapture(SignedCapture):
    """A capture by the responses of photodiodes: the camera, the light, the channels' responses and the accuracy."""

    has_gradients = False

    @cached_property
    def nodes(self) -> list[Node]:
        """Return the nodes, the wavelengths of the tables."""
        found = self.colours.shared(self.camera, self.accuracy)
        nodes = [
            Node(_plan(self.camera.at_wavelength(place), place, self.accuracy < FINE), channels, weights)
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
