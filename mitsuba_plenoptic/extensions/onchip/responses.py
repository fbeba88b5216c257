"""Wave captures of scenes by the responses of photodiodes under lenses of a few wavelengths.

For the cell of each lens, rays are drawn to the pupil, evenly over cell and pupil. A ray contributes to the photodiodes
of all surrounding lenses, with the signed response W of each (`onchip.response_tables`): the sum over the lenses of the
near window is complete, and lenses of the far window are drawn at random. Each photodiode thus sums over the rays of
many lenses, while rays are traced once. As in `signed_rays`, the mean radiance of independent rays around the lens is
subtracted, and its light, whose response is known, is added in closed form.
"""

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ...camera import PlenopticCamera
from ...detector import NonNegative
from ...errors import refuse_if
from ...runtime import Box, Floats, Pair, Part, drjit_array, fft
from ...scene import require_finite
from ...waves import FINE, Node, RaySum, SignedCapture, mean_of_half, mixed, of_other_half
from .plane_waves import NEAR, lens_range
from .response_draws import Tables
from .response_tables import PhotodiodeResponses

_LANES = 2**23
"""Approximate count of rays that are traced at once."""

_DRAWN = 8
"""Lenses of the far window that each ray of a lens draws."""


class Rays(NamedTuple):
    """The light of traced rays, by lens."""

    # Light for each image of a channel at a wavelength.
    lights: list
    # Indices as in `Aimed`; rays that do not pass the pupil have those of a node without response.
    near: list
    far: list
    node: Any
    # Sums of the light, and counts of the rays that passed, of the two halves of the rays of each lens.
    sums: list
    counts: Any


class LensCells(Box):
    """A rectangle of lenses, by lattice indices."""

    def lenses(self) -> tuple[Pair, Any]:
        """Return the lattice indices of the lenses, row by row, and a unique number of each lens."""
        lens = dr.arange(mi.UInt32, self.rows * self.columns)
        row = lens // dr.opaque(mi.UInt32, self.columns)
        x = mi.Int(lens - row * self.columns) + dr.opaque(mi.Int, self.left)
        y = mi.Int(row) + dr.opaque(mi.Int, self.top)
        return (x, y), (mi.UInt32(y + 2**15) << 16) | mi.UInt32(x + 2**15)

    def displaced(self, margin: int, lens: Any, cell: Pair) -> Any:
        """Return the indices, in the rectangle with a margin around it, of lenses displaced by a cell."""
        row = lens // dr.opaque(mi.UInt32, self.columns)
        x = lens - row * self.columns + margin
        line = dr.opaque(mi.UInt32, self.columns + 2 * margin)
        return (row + margin + mi.UInt32(mi.Int(cell[1]))) * line + x + mi.UInt32(mi.Int(cell[0]))


class ResponseSum(RaySum):
    """A capture by photodiode responses, computed by rows of lenses, whose plans are `PhotodiodeResponses`."""

    arrays: Any = np

    def __init__(
        self,
        camera: PlenopticCamera,
        light: Callable[..., list],
        nodes: Sequence[Node],
        *,
        # Rays per pixel as in a ray capture, of which only those that pass the pupil are drawn.
        spp: int,
        seed: int,
    ):
        super().__init__(camera, light, nodes, seed)
        self._tables = Tables(camera, [node.plan for node in nodes])
        self._across = across = self._tables.count
        # The images: the wavelength and the channel of each.
        self._images = [(n, channel) for _, numbers in self._groups for n in numbers for channel in nodes[n].channels]
        self._columns, self._rows = (lens_range(camera, across, axis) for axis in (0, 1))
        plan = nodes[0].plan
        # A pixel is the mean over its area and the lens's aperture of the radiance of all rays by way of the pupil.
        scale = camera.detector_distance / (camera.mla_medium * plan.camera.pupil_distance)
        self._scale = (
            (scale / (camera.pixel_size * camera.mla_fill)) ** 2 * math.pi * float(plan.system.lens.reach) ** 2
        )
        # Of the rays of a ray capture, those that pass the pupil. Two halves of them correct each other.
        rays = max(1, spp * across**2 * self._scale * (camera.pixel_size / camera.row_pitch) ** 2 / 2)
        lenses = self._columns[1] - self._columns[0]
        margin = self._tables.margin
        row = lenses + 2 * margin
        # 8: Rays of a lens that are traced at once at the least, if it has as many.
        at_once = max(8, _LANES // (row * (self._rows[1] - self._rows[0] + 2 * margin))) / 2
        self._rounds = max(1, round(rays / at_once))
        self._rays = 2 * max(1, round(rays / self._rounds))
        height = max(2 * margin, _LANES // (row * self._rays) - 2 * margin)
        self._blocks = list(range(*self._rows, height))
        self.items = np.diff([*self._blocks, self._rows[1]]) * lenses

    def batches(self, first: int) -> Iterator[Part]:
        """Yield the pixels of each block from index `first` on, after tracing its rays in several rounds."""
        camera = self._camera
        size = self._across
        left, right = self._columns
        for top, items in zip(self._blocks[first:], self.items[first:].tolist(), strict=True):
            grid = LensCells(left, top, right - left, items // (right - left))
            around = grid.within(self._tables.margin)
            sums = [[mi.Float(0)] * size**2 for _ in range(self.channels)]
            with fft.busy_drjit():
                for seed in np.random.SeedSequence([self._seed]).generate_state(self._rounds).tolist():
                    values = self._gathered(grid, self._traced(*around.lenses(), seed), seed)
                    for (_, channel), of_image in zip(self._images, values, strict=True):
                        pairs = zip(sums[channel], of_image, strict=True)
                        sums[channel] = [old + value * (self._scale / self._rounds) for old, value in pairs]
                    dr.eval(sums)
            pixels = np.stack([np.stack([value.numpy() for value in diodes], -1) for diodes in sums])
            pixels = pixels.reshape(-1, grid.rows, grid.columns, size, size).swapaxes(2, 3)
            x, y = (
                low * size + count // 2 - crop
                for low, count, crop in zip((left, top), camera.resolution, camera.crop_offset, strict=True)
            )
            box = Box(x, y, grid.columns * size, grid.rows * size)
            yield Part(box, np.ascontiguousarray(pixels.reshape(-1, box.rows, box.columns), np.float32))

    def probe(self) -> Floats:
        """Return the light of the rays of some lenses, a fingerprint of a scene and its camera."""
        columns = self._columns[1] - self._columns[0]
        count = int(self.items.sum())
        # 2**8: Count of lenses whose light identifies a capture.
        lens = np.linspace(0, count - 1, min(2**8, count)).astype(int)
        index = (lens % columns + self._columns[0], lens // columns + self._rows[0])
        rays = self._traced(
            tuple(drjit_array(mi.Int, coordinate) for coordinate in index), drjit_array(mi.UInt32, lens), 0
        )
        return np.stack([light.numpy() for light in rays.sums])

    def _traced(self, index: Pair, lens: Any, seed: int) -> Rays:
        """Return traced rays of lenses with given lattice indices and numbers."""
        rays = self._rays
        dr.eval(index, lens)
        lane = dr.arange(mi.UInt32, dr.width(lens) * rays)
        count = dr.opaque(mi.UInt32, rays)
        of_lens = lane // count
        # The two halves of the rays of a lens follow each other.
        ray = lane - of_lens * count
        half = dr.select(ray >= count // 2, mi.UInt32(1), 0)
        indices = tuple(dr.gather(mi.Int, coordinate, of_lens) for coordinate in index)
        word = dr.gather(mi.UInt32, lens, of_lens)
        key = dr.opaque(mi.UInt32, seed & ~31)
        aimed = self._tables.draw(indices, word, half, ray - half * (count // 2), key)
        lights = []
        counted = mi.Float(0)
        for walk, numbers in self._groups:
            start, slope, valid = self._scene_rays(walk, aimed.pupil, aimed.place, aimed.open)
            radiance = self._light(start, slope, valid, seed)
            counted = dr.select(valid, mi.Float(1), 0)
            require_finite(radiance, counted)
            for node_index in numbers:
                lit, weights = self._nodes[node_index].mixture()
                lights += [dr.select(valid, mixed(row, [radiance[i] for i in lit]), 0) for row in weights]
        dr.eval(lights, counted, aimed.near, aimed.far, aimed.node)
        sums = [dr.block_sum(light, rays // 2) for light in lights]
        counts = dr.block_sum(counted, rays // 2)
        dr.eval(sums, counts)
        return Rays(lights, aimed.near, aimed.far, aimed.node, sums, counts)

    def _gathered(self, grid: LensCells, rays: Rays, seed: int) -> list:
        """Return the values of each lens's photodiodes for each image, from the rays of all surrounding lenses."""
        tables = self._tables
        size = self._across**2
        lens = dr.arange(mi.UInt32, grid.rows * grid.columns)
        # Sums of the light of the lens and its eight neighbours, in each half of the rays.
        cells = [grid.displaced(tables.margin, lens, (x, y)) * 2 for x in (-1, 0, 1) for y in (-1, 0, 1)]
        counts, *sums = (
            [sum((dr.gather(mi.Float, light, cell + half) for cell in cells), mi.Float(0)) for half in (0, 1)]
            for light in (rays.counts, *rays.sums)
        )
        means = [mean_of_half(pair, counts) for pair in sums]
        dr.eval(means, counts)
        near = self._near_sums(grid, rays, means)
        far = self._far_sums(grid, rays, means, seed)
        passed = (counts[0] + counts[1]) / (len(cells) * self._rays)
        index, _ = grid.lenses()
        result = []
        for image, (node_index, _) in enumerate(self._images):
            mean = (means[image][0] + means[image][1]) / 2 * passed
            diodes = slice(image * size, (image + 1) * size)
            of_diodes = zip(near[diodes], far[diodes], tables.zone_means(node_index, index), strict=True)
            result.append([(close + wide) / self._rays + mean * total for close, wide, total in of_diodes])
        dr.eval(result)
        return result

    def _near_sums(self, grid: LensCells, rays: Rays, means: list[Pair]) -> list:
        """Return the sums over all rays of the near windows of lenses, for each image and photodiode."""
        count = dr.opaque(mi.UInt32, self._rays)
        lane = dr.arange(mi.UInt32, grid.rows * grid.columns * self._rays)
        of_lens = lane // count
        ray = lane - of_lens * count
        others = [
            of_other_half(ray < count // 2, [dr.gather(mi.Float, half, of_lens) for half in halves]) for halves in means
        ]

        def add(k: Any, *totals: Any) -> tuple:
            row = mi.Int(k) // NEAR
            cell = mi.Int(k) - row * NEAR - NEAR // 2, row - NEAR // 2
            address = grid.displaced(self._tables.margin, of_lens, cell) * count + ray
            change = [
                dr.gather(mi.Float, light, address) - mean for light, mean in zip(rays.lights, others, strict=True)
            ]
            first = [dr.gather(mi.UInt32, index, address) for index in rays.near]
            products = self._products(change, self._tables.near, first, cell)
            return k + 1, *(total + product for total, product in zip(totals, products, strict=True))

        state = (mi.UInt32(0), *[mi.Float(0)] * (self._across**2 * len(self._images)))
        _, *totals = dr.while_loop(state, lambda k, *_: k < NEAR**2, add, label="near photodiodes")
        return [dr.block_sum(total, self._rays) for total in totals]

    def _far_sums(self, grid: LensCells, rays: Rays, means: list[Pair], seed: int) -> list:
        """Return estimates of the sums over all rays of the far windows of lenses, for each image and photodiode."""
        tables = self._tables
        margin = tables.margin
        around = grid.within(margin)
        count = dr.opaque(mi.UInt32, self._rays)
        columns = dr.opaque(mi.UInt32, around.columns)
        width, height = (dr.opaque(mi.Int, size) for size in (grid.columns, grid.rows))
        lane = dr.arange(mi.UInt32, around.rows * around.columns * self._rays)
        lens = lane // count
        is_first = lane - lens * count < count // 2
        row = lens // columns
        x = mi.Int(lens - row * columns) - margin
        y = mi.Int(row) - margin
        key = dr.opaque(mi.UInt32, seed)
        # Sums of integers do not depend on the order in which threads add them.
        integer = dr.int64_array_t(mi.Float)
        double = dr.float64_array_t(mi.Float)
        brightest = float(max(dr.max(dr.abs(light))[0] for light in rays.lights))
        # 36: Bits after the point of integers that add up light, in units of the brightest ray; 27 remain before it.
        unit = dr.opaque(double, 2.0 ** (math.frexp(brightest)[1] - 36))
        totals = [dr.zeros(integer, grid.rows * grid.columns) for _ in range(self._across**2 * len(self._images))]

        def add(k: Any) -> tuple[Any]:
            random = mi.sample_tea_float32(lane, key + k)
            cell, weight = tables.drawn(rays.node, (mi.Float(k) + random) * (1 / _DRAWN))
            target = x - cell[0], y - cell[1]
            active = (dr.minimum(*target) >= 0) & (target[0] < width) & (target[1] < height)
            active &= dr.maximum(*(dr.abs(coordinate) for coordinate in cell)) > NEAR // 2
            index = mi.UInt32(target[1] * width + target[0])
            change = [
                (light - of_other_half(is_first, [dr.gather(mi.Float, half, index, active) for half in halves]))
                * weight
                for light, halves in zip(rays.lights, means, strict=True)
            ]
            for total, product in zip(totals, self._products(change, tables.far, rays.far, cell), strict=True):
                dr.scatter_add(total, integer(double(product * (1 / _DRAWN)) / unit), index, active)
            return (k + 1,)

        dr.while_loop((mi.UInt32(0),), lambda k: k < _DRAWN, add, label="far photodiodes")
        dr.eval(totals)
        return [mi.Float(double(total) * unit) for total in totals]

    def _products(self, change: list, tables: list, first: list, cell: Pair) -> list:
        """Return the light of rays for each image times the responses of the photodiodes at its wavelength.

        `first` are the indices of the rays' samples in the first cells of the tables.
        """
        responses = {n: self._tables.values(tables[n], first[n], cell) for n in {n for n, _ in self._images}}
        return [value * light for light, (n, _) in zip(change, self._images, strict=True) for value in responses[n]]


_plan = functools.lru_cache(maxsize=4)(PhotodiodeResponses)
"""The photodiode responses of a camera, cached for further captures."""


@dataclass(frozen=True)
class ResponseCapture(SignedCapture):
    """A capture by photodiode responses: camera, light, spectrum, and accuracy."""

    has_gradients = False

    def __post_init__(self) -> None:
        refuse_if(
            mi.is_spectral,
            f"plenoptic_wave: variant {mi.variant()}: responses of photodiodes under lenses of "
            "a few wavelengths are computed in mono and rgb variants only",
        )

    @cached_property
    def nodes(self) -> list[Node]:
        """Return the wavelengths at which the response tables are computed."""
        nodes = [
            Node(_plan(self.camera.at_wavelength(wavelength), wavelength, fine=self.accuracy < FINE), channels, weights)
            for wavelength, channels, weights in self.weights
        ]
        nodes[0].plan.require_memory(len(nodes))
        return nodes

    def _sum(self, kind: Callable) -> Callable:
        """Return the only kind of sum."""
        return ResponseSum

    def projections(self, image: Floats) -> dict[int, NonNegative]:
        """Return no channels to mend: negative pixels stay, as the noise of few rays exceeds the light around them."""
        return {}
