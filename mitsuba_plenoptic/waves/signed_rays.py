r"""Wave captures of scenes from the rays of a ray capture: signed coefficients of each ray, and convolutions.

Rays start from each cell of the detector's grid, pass points around a lens that lights the cell, and continue through
the pupil into the scene. `light.phase_space` gives the light that arrives with each ray, and the light's distribution
on the detector. The scene only has to provide the radiance along rays.

Coefficients vary in sign and magnitude within a lens, so that their plain sum is noisy even for a uniform scene. With
the mean c of the radiances found by other, independent rays of the same cell and lens, the sum is therefore

.. math:: \frac{1}{N} \sum_k \left[ w_k A_n(m_k, P_k)\, (L_k - c) + \delta_{n0}\, c \right] ,

which has the same mean, because the coefficients' integral over m is known, and no noise where the radiance is uniform
(a control variate: Owen, "Monte Carlo theory, methods and examples", section 8.9).
"""

from __future__ import annotations

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
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..detector.noise import known_means
from ..lenses.pupil import Pair
from ..optics.rays import second_leg
from ..rays.tracer import PupilWalk, walks_of
from ..runtime import (
    Box,
    PartialSum,
    active_backend,
    drjit_array,
    fft,
    interleaved,
    on_cuda,
    quotient,
    single_threaded_blas,
)
from ..scene.radiance import require_finite
from .array_field import Array
from .convolution import TILE, Block, Convolution, blocks_of, box_of, margin_of
from .phase_space import coefficients_of
from .pixel_kernels import PixelKernels
from .scheme import Plan, scheme_of
from .signed_colours import DrawnWavelengths, Lanes, Node, chances, mixed, span
from .signed_draws import Drawn, Pixels

_BLOCK_BYTES = 2**27
"""Bytes of the images of one block of the detector: few, for memory, and as progress is counted in blocks."""

_LANES = 2**22
"""Approximate count of rays that are traced at once."""

_RAY_BYTES = 100
"""Approximate bytes of a ray."""

_VALUES, _TABLE_BYTES = 15, 40 * 2**20
"""Usual count of the values of a ray, each with an image and a kernel, and bytes of a wavelength's table."""

_PROBES = 2**10
"""Count of cells whose light identifies a capture."""

_NEAR = 8
"""Pixels from the recorded ones beyond which a coarse pixel, wider than spots of microlenses, brings these little
light."""

_THINNED = 2
"""Width in pixels of the squares, farther from the recorded pixels, of which one random pixel stands for all."""

_LEAST = 2
"""Smallest count of rays from each pixel through each lens: two halves of them correct each other."""

_MASKS = 5
"""Count of lenses for which masks of the pixels that they light are computed at once."""


class Lot(NamedTuple):
    """Pixels, each paired with a lens that lights it, whose rays are traced together."""

    # Their indices among all pixels.
    some: Any
    # The kind of all of the lenses.
    kind: int
    pixels: Pixels
    # Wavelengths that are drawn for them, for each group of nodes.
    lanes: list[Lanes | None]
    seed: int
    # The fraction of its block's rays.
    share: float

    @property
    def key(self) -> Any:
        """Random seed of the rays' points, whose lowest bits number the points."""
        return dr.opaque(mi.UInt32, self.seed & ~15)


class Brought(NamedTuple):
    """Sums over the rays of the pixels of a lot that see light of one node."""

    # Indices of these pixels among all pixels, and direction cosines of their light.
    some: Any
    cosines: Pair
    # For each image the mean values of the pixels' cells, cell by cell.
    values: list[Any]


class NodeLight(NamedTuple):
    """The light of rays that a node uses."""

    # Radiance values of each ray, and the known means of each pixel.
    radiance: list[Any]
    means: list[Pair]
    # Weights that mix the values for each image.
    weights: Sequence[Any]


class SignedRaySum:
    """A signed-ray capture, computed by blocks of the detector; a `runtime.batches.LongSum`."""

    _sets = 1
    """Values of a ray for each coefficient: 1, except for derivatives."""

    traced: Callable[[float], None] | None = None
    """Called with the count of items whose rays have been traced since the last call."""

    def __init__(
        self,
        # The camera, whose recorded window may be a crop.
        camera: PlenopticCamera,
        # Radiance along rays, a `SceneLight`.
        light: Any,
        # The wavelengths at which diffraction is computed, and the channels that record each.
        nodes: Sequence[Node],
        # The distribution of the rays' wavelengths, if rays have wavelengths of their own.
        drawn: DrawnWavelengths | None = None,
        *,
        # Count of grid cells across a pixel.
        parts: int,
        # Most rays per pixel, divided among the lenses that light it. Each of its cells gets at least one through each
        # lens, and each pixel two.
        spp: int,
        seed: int,
    ) -> None:
        self.arrays: Any = active_backend().arrays
        self._camera, self._light, self._nodes, self._drawn = camera, light, nodes, drawn
        self._parts, self._seed = parts, seed
        self._step = camera.pixel_size / parts
        plans = [node.plan for node in nodes]
        self._groups = walks_of(plan.system for plan in plans)
        self._draws = scheme_of(camera).draws(camera, plans, parts)
        # The coefficients' integral is known where all rays of a cell and lens pass one point of the pupil.
        self._known_part = 0.0 if self._draws.by_points else 1.0
        self._second_leg = second_leg(camera.pixel_response or (), camera.mla_absorption or 0.0)
        rays, least = rays_of_a_cell(spp, parts, self._draws.lit_lenses)
        # Rays of a cell. With drawn wavelengths, a pass has only the fewest that correct each other and share these.
        self._spp = rays if drawn is None else least
        self._passes = round(rays / self._spp)
        # Rays of a pixel and a lens in a pass.
        self._together = self._spp * parts**2
        self._channels = [channel for node in nodes for channel in node.channels]
        self.channels = max(self._channels) + 1
        rows, columns = camera.shape
        self.box = Box(0, 0, columns, rows)
        # Tables and kernels are computed before the images, so that the peaks of their memory do not add up.
        self._coefficients = coefficients_of(plans)
        self._bins = box_of(camera, max(map(margin_of, self._flat_kernels)))
        values = sum(len(each) * len(node.channels) for each, node in zip(self._flat_kernels, nodes, strict=True))
        self._blocks = blocks_of(self._bins, _BLOCK_BYTES // (4 * values))
        self.items = np.array([block.rows * block.columns for block in self._blocks])

    def batches(self, first: int) -> Iterator[Block]:
        """Yield the images of the blocks from index `first`, which are to be convolved, after tracing their rays."""
        # Arrays of convolved blocks serve again: new ones take longer to fill, as the system has yet to map them.
        free: list[list[Array]] = []
        for number, bins in enumerate(self._blocks[first:], first):
            seeds = np.random.SeedSequence([self._seed, number])
            sums = free.pop() if free else self._empty(int(self.items[0]))
            traced = self._trace(bins, dr.arange(mi.UInt32, bins.rows * bins.columns), seeds, sums, self.traced)
            images = [part.reshape(-1, bins.rows, bins.columns) for part in traced]
            if (far := self._far(bins)).any():
                all_light = self.arrays.asarray(np.where(far, np.float32(_THINNED**2), np.float32(1)))
                for image in images:
                    image *= all_light
            block = Block(bins, images, self._convolutions, self._channels)
            weakref.finalize(block, free.append, sums)
            yield block
            del block

    def image(self, total: PartialSum) -> Array:
        """Return the image, the sum of all blocks."""
        return np.ascontiguousarray(np.moveaxis(active_backend().to_host(total.sums), 0, -1))

    @cached_property
    def _kernels(self) -> list[list[list[PixelKernels]]]:
        """Kernels of each node, each kind of lenses and each set of values of a ray."""
        draws = self._draws
        grids = [
            _Grid(self._parts, larger, tuple(map(tuple, draws.turns(kind).tolist())), draws.order)
            for kind, larger in enumerate(draws.enlargements)
        ]
        return [
            [
                [
                    _kernels_of(plan, grid, kind),
                    *(grid.for_pixels(plan, each, keeps_light=False) for each in self._further_kernels(plan, kind)),
                ]
                for kind, grid in enumerate(grids)
            ]
            for plan in (node.plan for node in self._nodes)
        ]

    def _further_kernels(self, plan: Plan, kind: int) -> list[NDArray[np.float64]]:
        """Return the kernels (values, k, k) of cells for a kind of lenses, for sets of values after the first."""
        return []

    @cached_property
    def _flat_kernels(self) -> list[list[Array]]:
        """Flat list of the kernels of each node's images."""
        return [[kernel for sets in kinds for each in sets for kernel in each.kernels] for kinds in self._kernels]

    def _rows(self, number: int, kind: int) -> list[slice]:
        """Return, for each set of values of a kind of lenses, the slice of a node's images that it fills."""
        counts = [[len(each.kernels) for each in sets] for sets in self._kernels[number]]
        ends = sum(map(sum, counts[:kind])) + np.cumsum([0, *counts[kind]])
        return [slice(*pair) for pair in itertools.pairwise(ends.tolist())]

    @cached_property
    def _convolutions(self) -> list[Convolution]:
        """Convolution of each image; the channels of a node share one."""
        size = self._blocks[0].rows, self._blocks[0].columns
        # Those of derivatives are used once.
        make = _convolution_of if self._sets == 1 else _convolution_of.__wrapped__
        made = [make(self._camera, tuple(itertools.chain(*kinds)), size, on_cuda()) for kinds in self._kernels]
        return [each for node, each in zip(self._nodes, made, strict=True) for _ in node.channels]

    def _trace(
        self,
        box: Box,
        pixels: Any,
        seeds: np.random.SeedSequence,
        images: list[Array] | None = None,
        traced: Callable[[float], None] | None = None,
    ) -> list[Array]:
        """Return images (kernels, pixels) of each channel of each node, in `images` if given, from rays of a box."""
        every = dr.width(pixels)
        sums = [image[:, :every] for image in images or self._empty(every)]
        for image in sums:
            image[:] = 0
        dr.eval(pixels)
        before: tuple[Lot, list[Brought | None]] | None = None
        # Dr.Jit's own threads rest while others compute the batches; here they are needed, but for the last lot.
        with fft.busy_drjit():
            for lot in self._lots(box, pixels, seeds):
                brought = self._collect(lot)
                # While a lot is added to the images, other threads sum the rays of the next one.
                if before:
                    self._add(*before, sums)
                before = lot, brought
                if traced:
                    traced(lot.share * every)
            dr.sync_thread()
        if before:
            self._add(*before, sums)
        return sums

    def _empty(self, pixels: int) -> list[Array]:
        """Return arrays for the images of each channel of each node, not yet written."""
        counts = [len(each) for each, node in zip(self._flat_kernels, self._nodes, strict=True) for _ in node.channels]
        return [self.arrays.empty((count, pixels), np.float32) for count in counts]

    @single_threaded_blas()
    def _add(self, lot: Lot, brought: list[Brought | None], sums: list[Array]) -> None:
        """Add the light of a lot's rays to the images."""
        libraries = active_backend()
        arrays, held = self.arrays, libraries.from_drjit
        images = iter(sums)
        for number, node in enumerate(brought):
            own = [next(images) for _ in self._nodes[number].channels]
            if node is None:
                continue
            kernels, rows = self._kernels[number][lot.kind], self._rows(number, lot.kind)
            some, cosines = held(node.some).astype(np.intp), arrays.stack([held(value) for value in node.cosines])
            # The pixels of a lens are in order, and each is contained once until the next lens; a device adds them all.
            starts = [] if libraries.is_cuda else (1 + np.flatnonzero(some[1:] <= some[:-1])).tolist()
            totals = [image[rows[0].start : rows[-1].stop] for image in own]
            every = [held(values).reshape(len(some), self._parts**2, -1) for values in node.values]
            for few in kernels[0].portions([0, *starts, len(some)]):
                terms = self._nodes[number].plan.oblique.terms(cosines[:, few])
                for total, values in zip(totals, every, strict=True):
                    given = self._combined(kernels, values[few], terms, cosines[:, few], number)
                    if libraries.is_cuda:
                        arrays.add.at(total, (slice(None), some[few]), given)
                    else:
                        # Row by row, which takes a fraction of the time of a sum with columns of a matrix.
                        for row, part in zip(total, given, strict=True):
                            arrays.add.at(row, some[few], part)

    def _combined(self, kernels: list[PixelKernels], values: Array, terms: Array, cosines: Array, number: int) -> Array:
        """Return the images (n, pixels) from a node's values (pixels, places, values) of cells, for all sets of values.

        `terms` (terms, pixels) are those of the direction cosines (2, pixels) of the pixels' light.
        """
        parts = self.arrays.split(values, len(kernels), axis=-1)
        return self.arrays.concatenate([each.combined(part, terms) for each, part in zip(kernels, parts, strict=True)])

    def _lots(self, box: Box, pixels: Any, seeds: np.random.SeedSequence) -> Iterator[Lot]:
        """Yield, in lots, the pixels of a box with each lens that lights them."""
        size = max(1, _LANES // self._together)
        kept: Any = True
        if (far := self._far(box)).any():
            # Near pixels, and one of each square of the others, have rays.
            shape = -(-box.rows // _THINNED), -(-box.columns // _THINNED)
            drawn = np.random.default_rng(seeds).integers(_THINNED**2, size=shape)
            row, column = np.ogrid[: box.rows, : box.columns]
            place = row % _THINNED * _THINNED + column % _THINNED
            held = ~far | (drawn[row // _THINNED, column // _THINNED] == place)
            kept = drjit_array(mi.UInt32, held.ravel()[pixels.numpy()]) != 0
        found: list[list[Any]] = [[] for _ in self._draws.enlargements]
        count = len(self._draws.candidates)
        for first in range(0, count, _MASKS):
            # Always as many, as other numbers would compile kernels again.
            lenses = [dr.opaque(mi.UInt32, min(first + number, count - 1)) for number in range(_MASKS)]
            aims = [self._draws.aims(Pixels(box, pixels, lens)) for lens in lenses]
            seen = [kept & self._draws.lights(each) for each in aims]
            masks = [
                [mask & (each.kind == kind) for kind in range(len(found))]
                for mask, each in zip(seen, aims, strict=True)
            ]
            dr.eval(masks)
            for lens, kinds in zip(lenses[: count - first], masks, strict=False):
                for lit, mask in zip(found, kinds, strict=True):
                    some = dr.compress(mask)
                    if dr.width(some):
                        lit.append((some, lens + dr.zeros(mi.UInt32, dr.width(some))))
        rays = self._passes * sum(dr.width(some) for lit in found for some, _ in lit)
        for kind, lit in enumerate(found):
            if not lit:
                continue
            # Lots of all lenses together, since those at the rims of micro-images light few pixels.
            every, lenses = (dr.concat(list(parts)) for parts in zip(*lit, strict=True))
            for start in range(0, dr.width(every), size):
                lane = dr.opaque(mi.UInt32, start) + dr.arange(mi.UInt32, min(size, dr.width(every) - start))
                some = dr.gather(mi.UInt32, every, lane)
                chosen = Pixels(box, dr.gather(mi.UInt32, pixels, some), dr.gather(mi.UInt32, lenses, lane))
                own = seeds.spawn(1)[0].generate_state(1 + self._passes).tolist()
                for turn, seed in enumerate(own[1:]):
                    yield Lot(some, kind, chosen, self._lanes(chosen, turn, own[0]), seed, dr.width(some) / rays)

    def _far(self, box: Box) -> NDArray[np.bool_]:
        """Return a mask (rows, columns) of the pixels of a box that are far from the recorded ones; see `_NEAR`."""
        window, near = box_of(self._camera, 0), _NEAR if self._parts > 1 else math.inf
        rows, columns = (
            np.abs(first + np.arange(count) - low - (size - 1) / 2) - (size - 1) / 2 > near
            for first, count, low, size in (
                (box.top, box.rows, window.top, window.rows),
                (box.left, box.columns, window.left, window.columns),
            )
        )
        return np.asarray(rows[:, None] | columns)

    def _back(self, gradient: Sequence[Array]) -> Iterator[tuple[Lot, list[list[Array]]]]:
        """Yield the lots of all blocks, and the gradients with respect to the images made from the lots.

        `gradient` is the gradient with respect to the sum, by channel (rows, columns). A gradient (kernels, pixels) is
        yielded for each image of each node.
        """
        for number, bins in enumerate(self._blocks):
            convolutions, every = iter(self._convolutions), bins.rows * bins.columns
            felt = [
                [
                    np.stack(
                        [
                            active_backend().to_host(image)
                            for image in next(convolutions).adjoint(gradient[channel], bins)
                        ]
                    ).reshape(-1, every)
                    for channel in node.channels
                ]
                for node in self._nodes
            ]
            far = self._far(bins).ravel()
            for each in itertools.chain.from_iterable(felt):
                each[:, far] *= _THINNED**2
            seeds = np.random.SeedSequence([self._seed, number])
            for lot in self._lots(bins, dr.arange(mi.UInt32, every), seeds):
                yield lot, felt

    def _felt(self, images: Array, number: int, lot: Lot, some: Any) -> list[list[Any]]:
        """Return the gradients with respect to each set of the functions' values, for cells of pixels of a lot.

        They follow from `images`, the gradients with respect to a node's images for one channel; see `_back`.
        """
        terms = self._nodes[number].plan.oblique.terms(self._cosines(lot, some))
        own = images[:, dr.gather(mi.UInt32, lot.some, some).numpy()]
        return [
            # Pixel by pixel, as cells are.
            [drjit_array(mi.Float, part.T) for part in kernels.adjoint(own[rows], terms)]
            for kernels, rows in zip(self._kernels[number][lot.kind], self._rows(number, lot.kind), strict=True)
        ]

    def _cosines(self, lot: Lot, some: Any) -> Array:
        """Return the direction cosines (2, pixels) of the light of pixels of a lot."""
        return np.array([value.numpy() for value in self._draws.cosines(lot.pixels.take(some))])

    def probe(self) -> Array:
        """Return the light of some pixels, a fingerprint of a scene and its camera."""
        pixels = self._some(_PROBES // self._parts**2)
        traced = self._trace(self._bins, pixels, np.random.SeedSequence(0))
        return np.concatenate([active_backend().to_host(part).ravel() for part in traced])

    def _some(self, count: int) -> Any:
        """Return the indices of `count` evenly spaced pixels."""
        every = self._bins.rows * self._bins.columns
        return drjit_array(mi.UInt32, np.linspace(0, every - 1, min(count, every)))

    def _lanes(self, pixels: Pixels, turn: int, seed: int) -> list[Lanes | None]:
        """Return the wavelengths of the rays of pixels in one pass, for each group of nodes."""
        if self._drawn is None:
            return [None for _ in self._groups]
        chance = chances(dr.opaque(mi.UInt32, pixels.box.columns), pixels.index, turn, seed)
        lanes: list[Lanes | None] = [
            self._drawn.draw(chance, span([self._nodes[number] for number in group])) for _, group in self._groups
        ]
        # Dr.Jit does not look into named tuples.
        dr.eval([tuple(each) for each in lanes if each])
        return lanes

    def _collect(self, lot: Lot) -> list[Brought | None]:
        """Return each node's sums over the rays of a lot, traced and scheduled for evaluation; None without light."""
        drawn, own = self._drawn_rays(lot.pixels, lot.key)
        counted = dr.select(drawn.open, mi.Float(1), 0)
        brought: list[Brought | None] = [None for _ in self._nodes]
        for (walk, nodes), lanes in zip(self._groups, lot.lanes, strict=True):
            radiance = self._light(*self._asked(walk, drawn, own, lanes, lot.seed))
            radiance = [light * self._answer(drawn) for light in radiance]
            alike = self._alike(nodes)
            kept = [self._kept(drawn, numbers[0]) for numbers in alike]
            # Any function may be the light; derivatives and band-limited light may be negative.
            require_finite(radiance, counted, kept, signed=not getattr(self._light, "is_radiance", False))
            known, lit = known_means(radiance, counted, dr.width(lot.some), self._together)
            met = dr.compress(lit)
            if not dr.width(met):
                continue
            some, cosines = dr.gather(mi.UInt32, lot.some, met), self._draws.cosines(lot.pixels.take(met))
            for numbers, each in zip(alike, kept, strict=True):
                mixtures = [self._nodes[number].mixture(lanes) for number in numbers]
                lights = [
                    NodeLight([radiance[i] for i in used], [known[i] for i in used], weights)
                    for used, weights in mixtures
                ]
                for number, images in zip(numbers, self._bring(lot, met, each, lights, numbers), strict=True):
                    brought[number] = Brought(some, cosines, [interleaved(parts) for parts in images])
            dr.eval(some, cosines, [each.values for each in brought if each])
        return brought

    def _alike(self, nodes: Sequence[int]) -> list[list[int]]:
        """Return nodes divided into those that have the coefficients of a ray at the same place of their tables."""
        found: dict[Any, list[int]] = {}
        for number in nodes:
            found.setdefault(self._coefficients[number].layout, []).append(number)
        return list(found.values())

    def _drawn_rays(self, pixels: Pixels, key: Any) -> tuple[Drawn, Any]:
        """Return all rays of pixels, one per lane, and the index of each ray's pixel."""
        lane = dr.arange(mi.UInt32, dr.width(pixels.index) * self._together)
        own = quotient(lane, self._together)
        sample = lane - own * dr.opaque(mi.UInt32, self._together)
        return self._draws.draw(pixels, own, sample, quotient(sample, self._spp), key), own

    def _cell_of(self, own: Any, sample: Any) -> Any:
        """Return the index of each ray's cell among the cells of all pixels."""
        return own * dr.opaque(mi.UInt32, self._parts**2) + quotient(sample, self._spp)

    def _asked(self, walk: PupilWalk, drawn: Drawn, own: Any, lanes: Lanes | None, seed: int) -> tuple[Any, ...]:
        """Return the arguments of a call of the light: see `SceneLight`."""
        start, direction, _ = walk.through_pupil(drawn.pupil, drawn.place, drawn.height)
        # Outside the aperture, surfaces may reflect rays totally, whose values are not finite then.
        seen = drawn.open & dr.all([dr.isfinite(value) for value in (*start, *direction)], axis=0)
        if lanes is None:
            return start, direction, seen, seed
        return start, direction, seen, seed, [dr.gather(mi.Float, each, own) for each in lanes.wavelengths]

    def _answer(self, drawn: Drawn) -> Any:
        """Return the pixels' response to rays by their path behind the lenses, times the rays' weights in a medium."""
        return self._second_leg(*self._draws.crossed(drawn)) * self._draws.evenness(drawn)

    def _kept(self, drawn: Drawn, number: int) -> tuple[Any, ...]:
        """Return the data of rays that `_bring` needs for a node."""
        places = self._coefficients[number].places(drawn.point, drawn.inner, drawn.chance, drawn.open)
        return places, dr.select(drawn.open, drawn.weight, 0)

    def _bring(
        self, lot: Lot, met: Any, kept: tuple[Any, ...], lights: list[NodeLight], numbers: Sequence[int]
    ) -> list[list[list[Any]]]:
        """Return the mean coefficients of the rays of each cell of the pixels `met`, for each image of some nodes."""
        # Computed before the recorded loop, so as not to become a part of it.
        pixel, first, start = self._cells_of(met)
        (places, weight), coefficients = kept, [self._coefficients[number] for number in numbers]
        lights = [NodeLight(each.radiance, *of_cells((each.means, each.weights), pixel)) for each in lights]

        def bring(k: Any, brought: list[list[list[Any]]]) -> tuple[Any, list[list[list[Any]]]]:
            own, even = dr.gather(mi.Float, weight, first + k), ((start + k) & 1) == 0
            at = [dr.gather(type(place), place, first + k) for place in places]
            result = []
            for light, table, images in zip(lights, coefficients, brought, strict=True):
                others = [dr.select(even, pair[1], pair[0]) * self._known_part for pair in light.means]
                changes = [
                    dr.gather(mi.Float, each, first + k) - other
                    for each, other in zip(light.radiance, others, strict=True)
                ]
                values, made = table.read(*at), []
                for row, before in zip(light.weights, images, strict=True):
                    change = own * mixed(row, changes)
                    after = [dr.fma(value, change, old) for old, value in zip(before, values, strict=True)]
                    after[0] += dr.select(own > 0, mixed(row, others), 0)
                    made.append(after)
                result.append(made)
            return k + 1, result

        return self._mean_of(bring, dr.width(pixel), numbers)

    def _cells_of(self, met: Any) -> tuple[Any, Any, Any]:
        """Return, for each cell of pixels `met`, its pixel and its first ray, among all rays and among the pixel's."""
        places, spp, together = (dr.opaque(mi.UInt32, n) for n in (self._parts**2, self._spp, self._together))
        lane = dr.arange(mi.UInt32, dr.width(met) * self._parts**2)
        turn = quotient(lane, self._parts**2)
        pixel, start = dr.gather(mi.UInt32, met, turn), (lane - turn * places) * spp
        return pixel, pixel * together + start, start

    def _mean_of(self, bring: Callable[..., Any], cells: int, numbers: Sequence[int]) -> list[list[list[Any]]]:
        """Return the mean values over the rays of each of some cells, in a loop, for each image of some nodes."""
        nodes = [self._nodes[number] for number in numbers]
        nothing = [
            [[dr.zeros(mi.Float, cells) for _ in range(self._sets * node.plan.functions.count)] for _ in node.channels]
            for node in nodes
        ]
        end = dr.opaque(mi.UInt32, self._spp)
        _, brought = dr.while_loop((mi.UInt32(0), nothing), lambda k, _: k < end, bring, label="signed rays")
        rays = mi.Float(dr.opaque(mi.UInt32, self._spp * self._passes))
        return [[[part / rays for part in parts] for parts in images] for images in brought]


def rays_of_a_cell(spp: int, parts: int, lit_lenses: float) -> tuple[int, int]:
    """Return the rays of each cell through each lens that lights it, and the fewest that correct each other."""
    least = -(-_LEAST // parts**2)
    return max(least, round(spp / (parts**2 * max(1.0, lit_lenses)))), least


def memory_of(pixels: float, rays: float, nodes: Sequence[Node]) -> float:
    """Return the approximate bytes of a capture with a count of pixels and rays."""
    values = _VALUES * sum(len(node.channels) for node in nodes)
    # At a time two blocks are convolved, one waits and one is traced.
    blocks = 4 * min(_BLOCK_BYTES, 4 * values * pixels)
    spectra = 4 * values * min(TILE**2, 4 * pixels)
    return blocks + spectra + len(nodes) * _TABLE_BYTES + _RAY_BYTES * min(_LANES, rays) + 8 * pixels


def of_cells(values: Any, pixel: Any) -> Any:
    """Return values of pixels, in nested sequences, for the pixel of each cell; single values are for all pixels."""
    if isinstance(values, Sequence):
        return [of_cells(value, pixel) for value in values]
    return values if dr.width(values) == 1 else dr.gather(type(values), values, pixel)


class _Grid(NamedTuple):
    """Conversion of kernels of cells into kernels of pixels, for one kind of lenses."""

    # Count of cells across a pixel, and factor by which micro-images are larger than by rays through lens centres.
    parts: int
    larger: float
    # Changes of the direction cosines from a pixel to its cells, and the order of B-splines of collected rays.
    turns: tuple[tuple[float, ...], ...]
    order: int

    def for_pixels(self, plan: Plan, kernels: NDArray[np.float64], keeps_light: bool) -> PixelKernels:
        """Return the kernels of pixel images from kernels (values, k, k) of cells."""
        turns = np.array(self.turns) / plan.oblique.largest
        # A pixel is the mean of its cells. Larger micro-images are darker.
        mean = kernels / (self.parts * self.larger) ** 2
        random_light = plan.covariance, plan.tolerance
        return PixelKernels(mean, plan.oblique, self.parts, turns, self.order, *random_light, keeps_light)


@functools.lru_cache(maxsize=16)
def _kernels_of(plan: Plan, grid: _Grid, kind: int) -> PixelKernels:
    """Return the kernels of a plan for one kind of lenses, cached for further captures of the camera."""
    camera = plan.camera
    kernels = plan.kernels(camera.pixel_size / grid.parts, plan.reach, kind)
    return grid.for_pixels(plan, kernels, keeps_light=True)


@functools.lru_cache(maxsize=4)
def _convolution_of(
    camera: PlenopticCamera, sets: tuple[PixelKernels, ...], size: tuple[int, int], cuda: bool
) -> Convolution:
    """Return the convolution with kernels, whose spectra are cached, on CUDA there, for further captures."""
    return Convolution(camera, [kernel for each in sets for kernel in each.kernels], size)
