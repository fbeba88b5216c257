r"""Wave captures of scenes from the rays of a ray capture: signed coefficients of each ray, and convolutions.

Rays start from each cell of the detector's grid, pass points around a lens that lights the cell, and continue through
the pupil into the scene. `phase_space` gives the light that arrives with each ray, and the light's distribution on the
detector. The scene only has to provide the radiance along rays. The estimate of a cell and a lens is, for each function
n, with the control variate c (`control_variate`),

.. math:: \frac{1}{N} \sum_k \left[ w_k A_n(m_k, P_k)\, (L_k - c) + \delta_{n0}\, c \right] ,

because the integrals of the coefficients over m are known. `SignedRaySum.estimate` is this formula.
"""

import functools
import itertools
import math
import weakref
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera
from ..rays import Walk, walks_of
from ..runtime import (
    Array,
    Box,
    Doubles,
    Flags,
    Numbers,
    Pair,
    PartialSum,
    Shape,
    Triple,
    active_backend,
    begin_step,
    count_lanes,
    drjit_array,
    fft,
    interleaved,
    lanes_reported,
    on_cuda,
    prepared,
    quotient,
    single_threaded_blas,
)
from ..scene import require_finite
from .control_variate import at_rays, means_of_halves, of_other_half
from .convolution import TILE, Block, Convolution, blocks_of, box_of, margin_of
from .phase_space import coefficients_of
from .pixel_kernels import PixelKernels
from .pupil_sampler import PupilSampler
from .ray_sampler import LensSampler, Pixels, RaySamples, lit
from .scheme import Plan
from .spectral_nodes import Node, RayWavelengths, WavelengthSampler, chances, mixed, span

_BLOCK_BYTES = 2**27
"""Bytes of the images of one block of the detector: few, for memory, and as progress is counted in blocks."""

_BLOCK_RAYS = 2**23
"""Approximate most rays of a block: some two seconds', as the first checkpoint waits for the end of two."""

_BLOCK_PIXELS = 2**8
"""Approximate fewest pixels of a block with many rays for each."""

_LANES = 2**22
"""Approximate count of rays that are traced at once."""

_THINNED = 2
"""Width in pixels of the squares, farther from the recorded pixels, of which one random pixel stands for all."""


class RayBatch(NamedTuple):
    """Pixels, each paired with a lens that lights it, whose rays are traced together."""

    # Their indices among all pixels.
    index: Any
    # The kind of all of the lenses.
    kind: int
    pixels: Pixels
    # Wavelengths that are drawn for them, for each group of nodes.
    wavelengths: list[RayWavelengths | None]
    seed: int
    # The fraction of its block's rays.
    share: float

    @property
    def key(self) -> Any:
        """Random seed of the rays' points, whose lowest bits number the points."""
        return dr.opaque(mi.UInt32, self.seed & ~15)


class CellMeans(NamedTuple):
    """Mean values over the rays of the cells of the pixels of a batch that see light of one node."""

    # Indices of these pixels among all pixels, and direction cosines of their light.
    index: Any
    cosines: Pair
    # For each image the values, cell by cell.
    values: list


class RaySum:
    """A sum over rays of either sign, computed by blocks of the detector; a `runtime.batches.LongSum`."""

    def __init__(
        self,
        # The camera, whose recorded window may be a crop.
        camera: PlenopticCamera,
        # Radiance along rays, a `SceneLight`.
        light: Any,
        # The wavelengths at which diffraction is computed, and the channels that record each.
        nodes: Sequence[Node],
        seed: int,
    ):
        self._camera = camera
        self._light = light
        self._nodes = nodes
        self._seed = seed
        self._groups = walks_of(node.plan.system for node in nodes)
        self._channels = [channel for node in nodes for channel in node.channels]
        self.channels = max(self._channels) + 1
        rows, columns = camera.shape
        self.box = Box(0, 0, columns, rows)

    def image(self, total: PartialSum) -> Array:
        """Return the image, the sum of all blocks."""
        return np.ascontiguousarray(np.moveaxis(active_backend().to_host(total.sums), 0, -1))

    @staticmethod
    def _scene_rays(walk: Walk, pupil: Pair, position: Pair, valid: Any, height: Any = 0.0) -> tuple[Any, Any, Any]:
        """Return the starts in the scene and the slopes of rays through pupil and array points, and a mask."""
        start, slope, _ = walk.through_pupil(pupil, position, height)
        # Outside the aperture, surfaces may reflect rays totally, whose values are not finite then.
        return start, slope, valid & dr.all([dr.isfinite(value) for value in (*start, *slope)], axis=0)


class SignedRaySum(RaySum):
    """A signed-ray capture: images of rays' coefficients, which are convolved."""

    _sets = 1
    """Values of a ray for each coefficient: 1, except for derivatives."""

    def __init__(
        self,
        camera: PlenopticCamera,
        light: Any,
        nodes: Sequence[Node],
        # The distribution of the rays' wavelengths, if rays have wavelengths of their own.
        wavelengths: WavelengthSampler | None = None,
        *,
        # Count of grid cells across a pixel.
        parts: int,
        # Most rays per pixel, divided among the lenses that light it. Each of its cells gets at least one through each
        # lens, and each pixel two.
        spp: int,
        seed: int,
        # Called with the count of items whose rays have been traced since the last call.
        traced: Callable[[float], None] | None = None,
    ):
        super().__init__(camera, light, nodes, seed)
        self._traced = traced
        self.arrays: Any = active_backend().arrays
        self._wavelengths = wavelengths
        self._parts = parts
        self._step = camera.pixel_size / parts
        plans = [node.plan for node in nodes]
        self._sampler: Any = _sampler_of(camera)(camera, plans, parts)
        # 2: Rays from each pixel through each lens at the least, as two halves of them correct each other.
        least = -(-2 // parts**2)
        rays = max(least, round(spp / (parts**2 * max(1.0, self._sampler.lit_lenses))))
        # Rays of a cell through each lens. With drawn wavelengths, a pass has only the fewest that correct each other
        # and share these.
        self._spp = rays if wavelengths is None else least
        self._passes = round(rays / self._spp)
        # Rays of a pixel and a lens in a pass.
        self._together = self._spp * parts**2
        # Tables and kernels are computed before the images, so that the peaks of their memory do not add up.
        self._coefficients = coefficients_of(plans)
        # Kernels of each node, each kind of lenses and each set of values of a ray, and their rows in a node's images.
        self._kernels = [self._pixel_kernels(plan) for plan in plans]
        self._rows = [_rows_of(kinds) for kinds in self._kernels]
        self._ranks = [kinds[-1][-1].stop for kinds in self._rows]
        flat = [kernel for kinds in self._kernels for sets in kinds for of_set in sets for kernel in of_set.kernels]
        # Micro-images of some lenses are in a part of the detector alone.
        self._bins: Box = getattr(plans[0], "pixels", None) or box_of(camera, margin_of(flat))
        values = sum(rank * len(node.channels) for rank, node in zip(self._ranks, nodes, strict=True))
        rays_of_pixel = self._together * self._passes * max(1, round(self._sampler.lit_lenses))
        self._blocks = blocks_of(
            self._bins, min(_BLOCK_BYTES // (4 * values), max(_BLOCK_PIXELS, _BLOCK_RAYS // rays_of_pixel))
        )
        self.items = np.array([block.rows * block.columns for block in self._blocks])

    def batches(self, first: int) -> Iterator[Block]:
        """Yield the images of the blocks from index `first`, which are to be convolved, after tracing their rays."""
        # Arrays of convolved blocks serve again: new ones take longer to fill, as the system has yet to map them.
        free: list[list[Array]] = []
        for block_index, bins in enumerate(self._blocks[first:], first):
            seeds = np.random.SeedSequence([self._seed, block_index])
            sums = free.pop() if free else self._empty(int(self.items[0]))
            traced = self._trace(bins, dr.arange(mi.UInt32, bins.rows * bins.columns), seeds, sums, self._traced)
            images = [image.reshape(-1, bins.rows, bins.columns) for image in traced]
            if (far := self._far(bins)).any():
                all_light = self.arrays.asarray(np.where(far, np.float32(_THINNED**2), np.float32(1)))
                for image in images:
                    image *= all_light
            block = Block(bins, images, self._convolutions, self._channels)
            weakref.finalize(block, free.append, sums)
            yield block
            del block

    def _pixel_kernels(self, plan: Plan) -> list[list[PixelKernels]]:
        """Return the kernels of a plan for each kind of lenses and each set of values of a ray."""
        sampler = self._sampler
        kinds = []
        for kind, larger in enumerate(sampler.enlargements):
            steps = tuple(map(tuple, sampler.cosine_steps(kind).tolist()))
            grid = _Grid(self._parts, larger, steps, sampler.order)
            further = [grid.for_pixels(plan, kernels, False) for kernels in self._further_kernels(plan, kind)]
            kinds.append([_kernels_of(plan, grid, kind), *further])
        return kinds

    def _further_kernels(self, plan: Plan, kind: int) -> list[Doubles]:
        """Return the kernels (values, k, k) of cells for a kind of lenses, for sets of values after the first."""
        return []

    @cached_property
    def _convolutions(self) -> list[Convolution]:
        """Convolution of each image; the channels of a node share one."""
        size = self._blocks[0].rows, self._blocks[0].columns
        # Those of derivatives are used once.
        of_nodes = [
            _convolution_of(self._camera, (*itertools.chain(*kinds),), size, self._sets == 1) for kinds in self._kernels
        ]
        return [of_node for node, of_node in zip(self._nodes, of_nodes, strict=True) for _ in node.channels]

    def _trace(
        self,
        box: Box,
        pixels: Any,
        seeds: np.random.SeedSequence,
        images: list[Array] | None = None,
        traced: Callable[[float], None] | None = None,
    ) -> list[Array]:
        """Return images (kernels, pixels) of each channel of each node, in `images` if given, from rays of a box."""
        count = dr.width(pixels)
        sums = [image[:, :count] for image in images or self._empty(count)]
        for image in sums:
            image[:] = 0
        dr.eval(pixels)
        before: tuple[RayBatch, list[CellMeans | None]] | None = None
        # Dr.Jit's own threads rest while others convolve; here they are needed, but for the last batch.
        with fft.busy_drjit():
            for batch in self._ray_batches(box, pixels, seeds):
                report = traced and _portions(traced, batch.share * count)
                rays = dr.width(batch.index) * self._together * len(self._groups)
                with lanes_reported(report, rays):
                    means = self.estimate(batch)
                # While a batch is added to the images, other threads sum the rays of the next one.
                if before:
                    self._add(*before, sums)
                before = batch, means
                if report:
                    report(1.0)
            dr.sync_thread()
        if before:
            self._add(*before, sums)
        return sums

    def _empty(self, pixels: int) -> list[Array]:
        """Return arrays for the images of each channel of each node, not yet written."""
        counts = [rank for rank, node in zip(self._ranks, self._nodes, strict=True) for _ in node.channels]
        return [self.arrays.empty((count, pixels), np.float32) for count in counts]

    @single_threaded_blas()
    def _add(self, batch: RayBatch, means: list[CellMeans | None], sums: list[Array]) -> None:
        """Add the light of a batch of rays to the images."""
        libraries = active_backend()
        arrays = self.arrays
        shared = libraries.from_drjit
        images = iter(sums)
        for node_index, node in enumerate(means):
            of_node = [next(images) for _ in self._nodes[node_index].channels]
            if node is None:
                continue
            kernels = self._kernels[node_index][batch.kind]
            rows = self._rows[node_index][batch.kind]
            index = shared(node.index).astype(np.intp)
            cosines = arrays.stack([shared(s) for s in node.cosines])
            # The pixels of a lens are in order, and each is contained once until the next lens; a device adds them all.
            starts = [] if libraries.is_cuda else (1 + np.flatnonzero(index[1:] <= index[:-1])).tolist()
            totals = [image[rows[0].start : rows[-1].stop] for image in of_node]
            values_of_images = [shared(values).reshape(len(index), self._parts**2, -1) for values in node.values]
            for few in kernels[0].portions([0, *starts, len(index)]):
                terms = self._nodes[node_index].plan.oblique.terms(cosines[:, few])
                for total, values in zip(totals, values_of_images, strict=True):
                    light = self._combined(kernels, values[few], terms, cosines[:, few], node_index)
                    if libraries.is_cuda:
                        arrays.add.at(total, (slice(None), index[few]), light)
                    else:
                        # Row by row, which takes a fraction of the time of a sum with columns of a matrix.
                        for row, light_of_row in zip(total, light, strict=True):
                            arrays.add.at(row, index[few], light_of_row)

    def _combined(
        self, kernels: list[PixelKernels], values: Array, terms: Array, cosines: Array, node_index: int
    ) -> Array:
        """Return the images (n, pixels) from a node's values (pixels, places, values) of cells, for all sets of values.

        `terms` (terms, pixels) are those of the direction cosines (2, pixels) of the pixels' light.
        """
        sets = zip(kernels, self.arrays.split(values, len(kernels), axis=-1), strict=True)
        return self.arrays.concatenate([of_set.combined(values, terms) for of_set, values in sets])

    def _ray_batches(self, box: Box, pixels: Any, seeds: np.random.SeedSequence) -> Iterator[RayBatch]:
        """Yield, in batches, the pixels of a box with each lens that lights them."""
        size = max(1, _LANES // self._together)
        sampler = self._sampler
        has_rays: Any = True
        if (far := self._far(box)).any():
            # Near pixels, and one of each square of the others, have rays.
            shape = -(-box.rows // _THINNED), -(-box.columns // _THINNED)
            chosen = np.random.default_rng(seeds).integers(_THINNED**2, size=shape)
            row, column = np.ogrid[: box.rows, : box.columns]
            within = row % _THINNED * _THINNED + column % _THINNED
            near = ~far | (chosen[row // _THINNED, column // _THINNED] == within)
            has_rays = drjit_array(mi.UInt32, near.ravel()[pixels.numpy()]) != 0
        kinds = lit(sampler, box, pixels, has_rays)
        rays = self._passes * sum(dr.width(index) for of_kind in kinds for index, _ in of_kind)
        for kind, of_kind in enumerate(kinds):
            if not of_kind:
                continue
            # Batches of all lenses together, since those at the rims of micro-images light few pixels.
            lit_pixels, lenses = (dr.concat(list(arrays)) for arrays in zip(*of_kind, strict=True))
            for start in range(0, dr.width(lit_pixels), size):
                lane = dr.opaque(mi.UInt32, start) + dr.arange(mi.UInt32, min(size, dr.width(lit_pixels) - start))
                index = dr.gather(mi.UInt32, lit_pixels, lane)
                pairs = Pixels(box, dr.gather(mi.UInt32, pixels, index), dr.gather(mi.UInt32, lenses, lane))
                seed, *others = seeds.spawn(1)[0].generate_state(1 + self._passes).tolist()
                for number, of_pass in enumerate(others):
                    wavelengths = self._drawn_wavelengths(pairs, number, seed)
                    yield RayBatch(index, kind, pairs, wavelengths, of_pass, dr.width(index) / rays)

    def _far(self, box: Box) -> Flags:
        """Return a mask (rows, columns) of the pixels of a box that are far from the recorded ones."""
        window = box_of(self._camera, 0)
        # 8: Pixels from the recorded ones beyond which a coarse pixel, wider than spots of microlenses, brings these
        # little light.
        near = 8 if self._parts > 1 else math.inf
        rows, columns = (
            np.abs(first + np.arange(count) - low - (size - 1) / 2) - (size - 1) / 2 > near
            for first, count, low, size in (
                (box.top, box.rows, window.top, window.rows),
                (box.left, box.columns, window.left, window.columns),
            )
        )
        return rows[:, None] | columns

    def propagate(self, gradient: Sequence[Array]) -> Iterator[None]:
        """Propagate the gradient of the sum, by channel (rows, columns), to what `estimate` depends on.

        None is yielded after each part of the rays.
        """
        for number, bins in enumerate(self._blocks):
            convolutions = iter(self._convolutions)
            count = bins.rows * bins.columns
            adjoint = [
                [
                    np.stack(
                        [
                            active_backend().to_host(image)
                            for image in next(convolutions).adjoint(gradient[channel], bins)
                        ]
                    ).reshape(-1, count)
                    for channel in node.channels
                ]
                for node in self._nodes
            ]
            far = self._far(bins).ravel()
            for images in itertools.chain.from_iterable(adjoint):
                images[:, far] *= _THINNED**2
            seeds = np.random.SeedSequence([self._seed, number])
            for batch in self._ray_batches(bins, dr.arange(mi.UInt32, count), seeds):
                for group in range(len(self._groups)):
                    with dr.resume_grad():
                        means = self.estimate(batch, group)
                        products = [
                            self._product(image[:, node.index.numpy()], values, number, batch.kind, node)
                            for number, node in enumerate(means)
                            if node
                            for image, values in zip(adjoint[number], node.values, strict=True)
                        ]
                        if products:
                            dr.backward(sum(products))
                    if products:
                        yield

    def _product(self, images: Array, values: list, node_index: int, kind: int, node: CellMeans) -> Any:
        """Return the product of adjoint images (kernels, pixels) with the images of a node's values, with gradients."""
        terms = self._nodes[node_index].plan.oblique.terms(np.array([cosine.numpy() for cosine in node.cosines]))
        sets = zip(self._kernels[node_index][kind], self._rows[node_index][kind], strict=True)
        adjoint = np.concatenate([kernels.adjoint(images[rows], terms) for kernels, rows in sets], axis=-1)
        return dr.sum(mixed([drjit_array(mi.Float, column) for column in adjoint.reshape(-1, len(values)).T], values))

    def probe(self) -> Array:
        """Return the light of some pixels, a fingerprint of a scene and its camera."""
        count = self._bins.rows * self._bins.columns
        # 2**10: Count of cells whose light identifies a capture.
        pixels = drjit_array(mi.UInt32, np.linspace(0, count - 1, min(2**10 // self._parts**2, count)))
        traced = self._trace(self._bins, pixels, np.random.SeedSequence(0))
        return np.concatenate([active_backend().to_host(image).ravel() for image in traced])

    def _drawn_wavelengths(self, pixels: Pixels, number: int, seed: int) -> list[RayWavelengths | None]:
        """Return the wavelengths of the rays of pixels in one pass, for each group of nodes."""
        if self._wavelengths is None:
            return [None for _ in self._groups]
        chance = chances(dr.opaque(mi.UInt32, pixels.box.columns), pixels.index, number, seed)
        spans = [span([self._nodes[number] for number in group]) for _, group in self._groups]
        groups = [self._wavelengths.draw(chance, strata) for strata in spans]
        # Dr.Jit does not look into named tuples.
        dr.eval([tuple(of_group) for of_group in groups])
        return list(groups)

    def samples(self, pixels: Pixels, key: Any) -> RaySamples:
        """Return all rays of pixels, one per lane."""
        lane = dr.arange(mi.UInt32, dr.width(pixels.index) * self._together)
        pixel = quotient(lane, self._together)
        number = lane - pixel * dr.opaque(mi.UInt32, self._together)
        return self._sampler.draw(pixels, pixel, number, quotient(number, self._spp), key)

    def estimate(self, batch: RayBatch, only: int | None = None) -> list[CellMeans | None]:
        """Return each node's mean values over the rays of the cells of a batch, to be evaluated; None without light.

        The nodes may be `only` those of one group, which have their rays in common: their values are lists of arrays
        that are not evaluated and may have gradients.
        """
        samples = self.samples(batch.pixels, batch.key)
        power = self._sampler.power(samples)
        ray = samples.ray
        counted = dr.select(ray.valid, mi.Float(1), 0)
        means: list[CellMeans | None] = [None for _ in self._nodes]
        for group in range(len(self._groups)) if only is None else [only]:
            walk, nodes = self._groups[group]
            colours = batch.wavelengths[group]
            scene_rays = self._scene_rays(walk, ray.P, ray.m, ray.valid, samples.lens.height)
            wavelengths = (
                [[dr.gather(mi.Float, value, samples.pixel) for value in colours.wavelengths]] if colours else []
            )
            # The radiance along the rays, as far as the pixels receive it.
            radiance = [light * power for light in self._light(*scene_rays, batch.seed, *wavelengths)]
            count_lanes(dr.width(power))
            # What the coefficients depend on, once for nodes that have those of a ray at the same place of tables.
            alike: dict[Any, list[int]] = {}
            for number in nodes:
                alike.setdefault(self._coefficients[number].layout, []).append(number)
            arguments = [
                [dr.select(ray.valid, ray.weight, 0), *self._arguments(samples, walk, numbers[0])]
                for numbers in alike.values()
            ]
            # Any function may be the light; derivatives and band-limited light may be negative.
            require_finite(radiance, counted, arguments, signed=not getattr(self._light, "is_radiance", False))
            # The control variate, and the pixels that see light.
            controls, lit = means_of_halves(radiance, counted, dr.width(batch.index), self._together)
            pixels = dr.compress(lit)
            if not dr.width(pixels):
                continue
            index = dr.gather(mi.UInt32, batch.index, pixels)
            cosines = self._sampler.cosines(batch.pixels.take(pixels))
            for numbers, of_rays in zip(alike.values(), arguments, strict=True):
                mixtures = [self._nodes[number].mixture(colours) for number in numbers]
                sums = self._cell_means(pixels, of_rays, radiance, controls, mixtures, numbers)
                for number, images in zip(numbers, sums, strict=True):
                    values = [interleaved(of_image) for of_image in images] if only is None else images
                    means[number] = CellMeans(index, cosines, values)
            if only is None:
                dr.eval(index, cosines, [node.values for node in means if node])
        return means

    def _cell_means(
        self,
        pixels: Any,
        of_rays: list,
        radiance: list,
        controls: list[Pair],
        mixtures: Sequence[tuple[list[int], list]],
        numbers: Sequence[int],
    ) -> list[list]:
        """Return the mean values over the rays of each cell of some pixels, for each image of some nodes.

        `of_rays` are the rays' weights and the arguments of their coefficients.
        """
        # Computed before the recorded loop, so as not to become a part of it.
        pixel, first, start = self._cells_of(pixels)
        lights = [
            (
                [radiance[i] for i in indices],
                _of_cells([controls[i] for i in indices], pixel),
                _of_cells(weights, pixel),
            )
            for indices, weights in mixtures
        ]

        def add(k: Any, means: list[list]) -> tuple[Any, list[list]]:
            weight, *arguments = (at_rays(values, first + k) for values in of_rays)
            even = ((start + k) & 1) == 0
            result = []
            for number, (light, halves, weights), images in zip(numbers, lights, means, strict=True):
                controls = [of_other_half(even, pair) * self._sampler.control_factor for pair in halves]
                residuals = [
                    at_rays(value, first + k) - control for value, control in zip(light, controls, strict=True)
                ]
                sets = self._values(number, arguments)
                of_node = []
                for row, before in zip(weights, images, strict=True):
                    residual = weight * mixed(row, residuals)
                    control = dr.select(weight > 0, mixed(row, controls), 0)
                    sums = iter(before)
                    after = [[dr.fma(value, residual, next(sums)) for value in values] for values, _ in sets]
                    for values, (_, of_control) in zip(after, sets, strict=True):
                        values[0] += control if of_control is None else control * of_control
                    of_node.append([value for values in after for value in values])
                result.append(of_node)
            return k + 1, result

        nodes = [self._nodes[number] for number in numbers]
        cells = dr.width(pixel)
        nothing = [
            [[dr.zeros(mi.Float, cells) for _ in range(self._sets * node.plan.functions.count)] for _ in node.channels]
            for node in nodes
        ]
        end = dr.opaque(mi.UInt32, self._spp)
        # Loops that only add up are differentiated in reverse without their states.
        state = mi.UInt32(0), nothing
        _, sums = dr.while_loop(state, lambda k, _: k < end, add, label="signed rays", max_iterations=-1)
        rays = mi.Float(dr.opaque(mi.UInt32, self._spp * self._passes))
        return [[[value / rays for value in values] for values in images] for images in sums]

    def _arguments(self, samples: RaySamples, walk: Walk, node_index: int) -> list:
        """Return the arguments of `_values` for rays."""
        ray = samples.ray
        return self._coefficients[node_index].places(samples.lens_point, samples.round_pupil, samples.chance, ray.valid)

    def _values(self, node_index: int, arguments: list) -> list[tuple[list, Any]]:
        """Return sets of values of a ray for each function, and the known mean of the first one; None for 1."""
        return [(self._coefficients[node_index].read(*arguments), None)]

    def _cells_of(self, pixels: Any) -> Triple:
        """Return, for each cell of some pixels, its pixel and its first ray, among all rays and among the pixel's."""
        cells, spp, together = (dr.opaque(mi.UInt32, n) for n in (self._parts**2, self._spp, self._together))
        lane = dr.arange(mi.UInt32, dr.width(pixels) * self._parts**2)
        number = quotient(lane, self._parts**2)
        pixel = dr.gather(mi.UInt32, pixels, number)
        start = (lane - number * cells) * spp
        return pixel, pixel * together + start, start


def memory_of(pixels: float, rays: float, channels: Sequence[int]) -> float:
    """Return the approximate bytes of a capture with a count of pixels and rays, and of channels of each node."""
    # 15: Usual count of the values of a ray, each with an image and a kernel.
    values = 15 * sum(channels)
    # At a time two blocks are convolved, one waits and one is traced.
    blocks = 4 * min(_BLOCK_BYTES, 4 * values * pixels)
    spectra = 4 * values * min(TILE**2, 4 * pixels)
    # 40 * 2**20 and 100: Approximate bytes of a wavelength's table, and of a ray.
    return blocks + spectra + len(channels) * 40 * 2**20 + 100 * min(_LANES, rays) + 8 * pixels


def _sampler_of(camera: PlenopticCamera) -> type:
    """Return the kind of sampler of a camera's rays."""
    if camera.lens_data.images_stop:
        from .stop_image import StopSampler

        return StopSampler
    return LensSampler if camera.has_array else PupilSampler


def _portions(traced: Callable[[float], None], items: float) -> Callable[[float], None]:
    """Return a function of the fraction of items that is done; `traced` is called with the increases."""
    reached = 0.0

    def report(fraction: float) -> None:
        nonlocal reached
        traced(items * (fraction - reached))
        reached = fraction

    return report


def _of_cells(values: Any, pixel: Any) -> Any:
    """Return values of pixels, in nested sequences, for the pixel of each cell; single values are for all pixels."""
    if isinstance(values, Sequence):
        return [_of_cells(value, pixel) for value in values]
    return values if dr.width(values) == 1 else dr.gather(type(values), values, pixel)


def _rows_of(kinds: list[list[PixelKernels]]) -> list[list[slice]]:
    """Return, for each kind of lenses and set of values, the slice of a node's images that the set fills."""
    ends = itertools.accumulate((len(of_set.kernels) for sets in kinds for of_set in sets), initial=0)
    slices = (slice(*pair) for pair in itertools.pairwise(ends))
    return [[next(slices) for _ in sets] for sets in kinds]


class _Grid(NamedTuple):
    """Conversion of kernels of cells into kernels of pixels, for one kind of lenses."""

    # Count of cells across a pixel, and factor by which micro-images are larger than by rays through lens centres.
    parts: int
    larger: float
    # Changes of the direction cosines from a pixel to its cells, and the order of B-splines of collected rays.
    steps: tuple[Numbers, ...]
    order: int

    def for_pixels(self, plan: Plan, kernels: Doubles, keeps_light: bool) -> PixelKernels:
        """Return the kernels of pixel images from kernels (values, k, k) of cells."""
        steps = np.array(self.steps) / plan.oblique.largest
        # A pixel is the mean of its cells. Larger micro-images are darker.
        mean = kernels / (self.parts * self.larger) ** 2
        random_light = plan.covariance, plan.tolerance
        return PixelKernels(mean, plan.oblique, self.parts, steps, self.order, *random_light, keeps_light)


@functools.lru_cache(maxsize=64)
def _kernels_of(plan: Plan, grid: _Grid, kind: int) -> PixelKernels:
    """Return the kernels of a plan for one kind of lenses, cached for further captures of the camera."""
    begin_step("kernels of diffraction", 4.0)
    camera = plan.camera
    # A plan that is expanded about another one is another one.
    cameras = [of_plan.camera.to_dict() for of_plan in (plan, getattr(plan, "start", plan))]
    kernels = prepared.get()(
        [type(plan).__name__, cameras, repr((plan.wavelength, plan.options)), grid.parts, kind],
        lambda: plan.kernels(camera.pixel_size / grid.parts, plan.reach, kind),
    )
    return grid.for_pixels(plan, kernels, keeps_light=True)


_convolutions: dict[Any, Convolution] = {}
"""Convolutions that are kept for further captures, the latest last."""


def _convolution_of(camera: PlenopticCamera, sets: tuple[PixelKernels, ...], size: Shape, keep: bool) -> Convolution:
    """Return the convolution with kernels, whose spectra are kept if asked for, on CUDA there."""
    key = camera, sets, size, on_cuda()
    if (convolution := _convolutions.pop(key, None)) is None:
        begin_step("convolutions", 0.1)
        convolution = Convolution(camera, [kernel for of_set in sets for kernel in of_set.kernels], size)
    if keep:
        _convolutions[key] = convolution
        # Four, and more within a gibibyte, such as those of a microscope's kinds of lenses.
        while len(_convolutions) > 4 and sum(each.bytes for each in _convolutions.values()) > 2**30:
            del _convolutions[next(iter(_convolutions))]
    return convolution
