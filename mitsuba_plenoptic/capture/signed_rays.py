r"""Wave captures of scenes from the rays of a ray capture: signed coefficients for each ray, and convolutions.

Rays start from each cell of the detector's grid, pass points around a lens that lights the cell, and continue through
the pupil into the scene. `system.phase_space` gives the light that arrives with each ray, and its distribution on the
detector. Only the radiance along rays is needed of the scene.

Coefficients vary in sign and magnitude within a lens, so that their plain sum is noisy even for a uniform scene. With
the mean c of the radiances that other, independent rays of the same cell and lens have found, the sum is therefore

.. math:: \frac{1}{N} \sum_k \left[ w_k A_n(m_k, P_k)\, (L_k - c) + \delta_{n0}\, c \right] ,

which has the same mean, because the coefficients' integral over m is known, and no noise where the radiance is uniform
(a control variate: Owen, "Monte Carlo theory, methods and examples", section 8.9).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..lenses.base import Pair
from ..optics.rays import angular_response, transmittance
from ..runtime.backend import drjit_array
from ..runtime.batches import Box, PartialSum
from ..runtime.fft import busy_drjit
from ..system.array_kernels import REACH
from ..system.convolution import Block, Convolution, blocks_of, box_of, cost_of, margin_of
from ..system.oblique import ObliqueImages
from ..system.optical_system import RayPupil
from ..system.phase_space import PhaseSpace, Polynomials, RayCoefficients, coefficients_of
from .control_variate import known_means
from .scene_light import require_finite, require_light
from .signed_colours import DrawnWavelengths, Lanes, Node, chances, mixed, span
from .signed_draws import ORDER, Cells, Drawn, Draws, Lot

_BLOCK_BYTES = 2**29
"""Bytes of the images of one block of the detector."""

_LANES = 2**22
"""Approximate count of rays that are traced at once."""

_RAY_BYTES = 100
"""Approximate bytes of a ray."""

_PROBES, _CELLS = 2**10, 2**16
"""Count of cells whose light identifies a capture, and of cells that are timed for an estimate."""

_LEAST = 2
"""Smallest count of rays from each cell through each lens: two halves of them correct each other."""


class SignedRaySum:
    """A signed-ray capture, computed by blocks of the detector; a `runtime.jobs.LongSum`."""

    arrays: Any = np
    _sets = 1
    """Values of a ray for each coefficient: 1, except for derivatives."""

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
        # Rays per pixel, divided among its cells and the lenses that light them; each pair of these gets at least two.
        spp: int,
        seed: int,
    ) -> None:
        self._camera, self._light, self._nodes, self._drawn = camera, light, nodes, drawn
        self._parts, self._seed = parts, seed
        self._step = camera.pixel_size / parts
        plans = [node.plan for node in nodes]
        self._groups = _groups(nodes)
        self._draws = Draws(camera, plans, self._step)
        # The coefficients' integral is known where all rays of a cell and lens pass one point of the pupil.
        self._known_part = 0.0 if self._draws.by_points else 1.0
        self._response = angular_response(camera.pixel_response)
        rays = max(_LEAST, round(spp / (parts**2 * max(1.0, self._draws.lit_lenses))))
        # With drawn wavelengths, a pass has only the fewest rays that correct each other and share their wavelengths.
        self._spp = rays if drawn is None else _LEAST
        self._passes = round(rays / self._spp)
        self._channels = [channel for node in nodes for channel in node.channels]
        self.channels = max(self._channels) + 1
        rows, columns = camera.shape
        self.box = Box(0, 0, columns, rows)
        # Kernels are computed before the images, so that the peaks of their memory do not add up.
        self._bins = box_of(camera, self._step, max(margin_of(kernels) for kernels in self._kernels))
        values = sum(len(kernels) * len(node.channels) for kernels, node in zip(self._kernels, nodes, strict=True))
        self._blocks = blocks_of(self._bins, _BLOCK_BYTES // (4 * values))
        self.items = np.array([block.rows * block.columns for block in self._blocks])

    def batches(self, first: int) -> Iterator[Block]:
        """Trace the rays of the blocks from index `first`, and yield their images, which are to be convolved."""
        for number, bins in enumerate(self._blocks[first:], first):
            seeds = np.random.SeedSequence([self._seed, number])
            # Dr.Jit's own threads rest while others compute the batches; here they are needed.
            with busy_drjit():
                sums = self._trace(bins, dr.arange(mi.UInt32, bins.rows * bins.columns), seeds)
            images = [part.numpy().reshape(-1, bins.rows, bins.columns) for part in sums]
            yield Block(bins, images, self._convolutions, self._channels)

    def image(self, total: PartialSum) -> NDArray[np.float32]:
        """Return the sum of all blocks."""
        return np.ascontiguousarray(np.moveaxis(total.sums, 0, -1))

    @cached_property
    def _kernels(self) -> list[list[NDArray[np.float32]]]:
        """Return the kernels of each node for each kind of lenses, scaled so that a pixel is the mean of its cells."""
        return [
            [
                # Larger micro-images are darker.
                (kernel / (self._parts * larger) ** 2).astype(np.float32)
                for kind, larger in enumerate(self._draws.enlargements)
                for kernel in self._kernels_of(node.plan, kind)
            ]
            for node in self._nodes
        ]

    def _kernels_of(self, plan: PhaseSpace, kind: int) -> list[NDArray[np.float64]]:
        """Return the kernels of a kind of lenses, one for each value of a ray."""
        return list(plan.kernels(self._step, REACH * max(self._camera.mla_pitches), kind))

    @cached_property
    def _convolutions(self) -> list[Convolution]:
        """Return the convolution of each image; the channels of a node share one."""
        size = self._blocks[0].rows, self._blocks[0].columns
        order = 0 if self._draws.by_points else ORDER - 1
        made = [Convolution(self._camera, kernels, self._step, order, size) for kernels in self._kernels]
        return [each for node, each in zip(self._nodes, made, strict=True) for _ in node.channels]

    @cached_property
    def _oblique(self) -> list[ObliqueImages]:
        return [ObliqueImages(node.plan.oblique) for node in self._nodes]

    @cached_property
    def _coefficients(self) -> list[RayCoefficients | Polynomials]:
        return [coefficients_of(node.plan) for node in self._nodes]

    def _trace(self, box: Box, cells: Any, seeds: np.random.SeedSequence) -> list[Any]:
        """Trace the rays of cells of a box.

        Return each image's coefficients, an array (kinds * values, cells) that is flattened.
        """
        kinds = len(self._draws.kinds.every)
        sums = [
            dr.zeros(mi.Float, dr.width(cells) * kinds * self._values_of(node))
            for node in self._nodes
            for _ in node.channels
        ]
        dr.eval(cells, sums)
        every = dr.opaque(mi.UInt32, dr.width(cells))
        for lot in self._lots(box, cells, seeds):
            for total, parts in zip(sums, self._collect(lot), strict=True):
                first = lot.first(every, len(parts))
                for number, part in enumerate(parts):
                    # No conflicts, because a lot contains each cell at most once.
                    dr.scatter_reduce(
                        dr.ReduceOp.Add, total, part, first + every * number, mode=dr.ReduceMode.NoConflicts
                    )
            dr.eval(sums)
        return sums

    def _values_of(self, node: Node) -> int:
        """Return the count of values that a ray has for each image of a node."""
        return self._sets * node.plan.values

    def _lots(self, box: Box, cells: Any, seeds: np.random.SeedSequence) -> Iterator[Lot]:
        """Yield cells of a box with each lens that lights them, in lots."""
        for steps in self._draws.candidates:
            aims = self._draws.aims(Cells(box, cells, steps))
            pupil = self._draws.seen(aims.middle, aims)
            lit = dr.compress(dr.square(pupil[0]) + dr.square(pupil[1]) <= self._draws.widest**2)
            size = max(1, _LANES // self._spp)
            for start in range(0, dr.width(lit), size):
                some = dr.gather(
                    mi.UInt32, lit, dr.opaque(mi.UInt32, start) + dr.arange(mi.UInt32, min(size, dr.width(lit) - start))
                )
                several = len(self._draws.kinds.every) > 1
                kind = dr.gather(mi.UInt32, aims.kind, some) if several else mi.UInt32(0)
                chosen = Cells(box, dr.gather(mi.UInt32, cells, some), steps)
                own = seeds.spawn(1)[0].generate_state(1 + self._passes).tolist()
                for turn, seed in enumerate(own[1:]):
                    yield Lot(some, kind, chosen, self._lanes(chosen, turn, own[0]), seed)

    def _back(self, gradient: Sequence[NDArray[np.float32]]) -> Iterator[tuple[Lot, list[list[Any]]]]:
        """Yield the lots of all blocks, and the gradients with respect to the images of their coefficients.

        `gradient` is that with respect to the sum, by channel (rows, columns). A gradient is yielded for each image of
        each node, in the flat layout in which `_trace` returns the images.
        """
        for number, bins in enumerate(self._blocks):
            convolutions, felt = iter(self._convolutions), []
            for node in self._nodes:
                images = [next(convolutions).adjoint(gradient[channel], bins) for channel in node.channels]
                flat = [np.concatenate([part.ravel() for part in image]) for image in images]
                felt.append([drjit_array(mi.Float, each) for each in flat])
            seeds = np.random.SeedSequence([self._seed, number])
            for lot in self._lots(bins, dr.arange(mi.UInt32, bins.rows * bins.columns), seeds):
                yield lot, felt

    def _felt(self, images: Any, number: int, lot: Lot, some: Any) -> list[list[Any]]:
        """Return the gradients with respect to the functions' values of some cells of a lot, for each set of values.

        They follow from `images`, those with respect to a node's images for one channel; see `_back`.
        """
        count, cosines = self._nodes[number].plan.values, self._cosines_of(lot, some)
        gathered = self._gathered(images, number, lot, some, range(self._sets * count))
        felt = [
            self._oblique[number].reduced(gathered[first : first + count], cosines)
            for first in range(0, len(gathered), count)
        ]
        dr.eval(felt)
        return felt

    def _gathered(self, images: Any, number: int, lot: Lot, some: Any, values: Iterable[int]) -> list[Any]:
        """Return values of some cells of a lot from a node's images for one channel."""
        every = dr.opaque(mi.UInt32, lot.cells.box.rows * lot.cells.box.columns)
        first = dr.gather(mi.UInt32, lot.first(every, self._values_of(self._nodes[number])), some)
        return [dr.gather(mi.Float, images, first + every * n) for n in values]

    def _cosines_of(self, lot: Lot, some: Any) -> Pair:
        """Return the direction cosines of the light of some cells of a lot."""
        return self._draws.cosines(replace(lot.cells, index=dr.gather(mi.UInt32, lot.cells.index, some)))

    def probe(self) -> NDArray[np.float32]:
        """Return the coefficients of some cells, which identify a scene and its camera."""
        cells = self._some(_PROBES)
        return np.concatenate([part.numpy() for part in self._trace(self._bins, cells, np.random.SeedSequence(0))])

    def cost(self) -> tuple[float, float]:
        """Estimate from some of the cells and tiles the time in seconds and the bytes that the sum takes."""
        start = time.perf_counter()
        convolutions = self._convolutions
        made = time.perf_counter() - start
        count = self._bins.rows * self._bins.columns
        convolved, memory = cost_of(convolutions, self._blocks[0], count)
        # The first run compiles the kernels, and is left out.
        seconds = [self._timed(self._some(_CELLS), seed) for seed in range(3)]
        # Tables are in memory twice: in their plans and in Dr.Jit's arrays.
        plans = [node.plan for node in self._nodes if not node.plan.by_points]
        tables = 2 * sum(part.nbytes for plan in plans for part in plan.table)
        return made + convolved + min(seconds[1:]) * count, memory + tables + _RAY_BYTES * _LANES

    def _some(self, count: int) -> Any:
        """Return the indices of `count` cells, evenly spaced over all."""
        every = self._bins.rows * self._bins.columns
        return drjit_array(mi.UInt32, np.linspace(0, every - 1, min(count, every)))

    def _timed(self, cells: Any, seed: int) -> float:
        """Time the rays of cells; return the seconds per cell."""
        with busy_drjit():
            dr.sync_thread()
            start = time.perf_counter()
            self._trace(self._bins, cells, np.random.SeedSequence(seed))
            dr.sync_thread()
            return (time.perf_counter() - start) / dr.width(cells)

    def _lanes(self, cells: Cells, turn: int, seed: int) -> list[Lanes | None]:
        """Return the wavelengths of the rays of cells in one of the passes, for each group of nodes."""
        if self._drawn is None:
            return [None for _ in self._groups]
        chance = chances(dr.opaque(mi.UInt32, cells.box.columns), cells.index, turn, seed)
        lanes: list[Lanes | None] = [
            self._drawn.draw(chance, span([self._nodes[number] for number in group])) for _, group in self._groups
        ]
        dr.eval(lanes)
        return lanes

    def _collect(self, lot: Lot) -> list[list[Any]]:
        """Trace the rays of a lot; return the coefficients for each image."""
        count, key = dr.width(lot.cells.index), dr.opaque(mi.UInt32, lot.seed & ~15)
        drawn, own = self._drawn_rays(lot.cells, key)
        counted = dr.select(drawn.open, mi.Float(1), 0)
        brought = []
        for (pupil, nodes), lanes in zip(self._groups, lot.lanes, strict=True):
            radiance = self._light(*self._asked(pupil, drawn, own, lanes, lot.seed))
            radiance = [light * self._answer(drawn) for light in radiance]
            require_finite(radiance, counted)
            # Any function may be the light; derivatives and band-limited light may be negative.
            if getattr(self._light, "is_radiance", False):
                require_light(radiance)
            known, lit = known_means(radiance, counted, count, self._spp)
            for number in nodes:
                brought += self._bring(lot.cells, key, radiance, known, lit, number, lanes)
        return brought

    def _drawn_rays(self, cells: Cells, key: Any) -> tuple[Drawn, Any]:
        """Return all rays of cells, one per lane, and for each ray the position of its cell among these."""
        spp = dr.opaque(mi.UInt32, self._spp)
        lane = dr.arange(mi.UInt32, dr.width(cells.index) * self._spp)
        own = lane // spp
        each = replace(cells, index=dr.gather(mi.UInt32, cells.index, own))
        return self._draws.draw(each, lane - own * spp, key), own

    def _asked(self, pupil: RayPupil, drawn: Drawn, own: Any, lanes: Lanes | None, seed: int) -> tuple[Any, ...]:
        """Return the arguments of the light: see `SceneLight`."""
        start, direction = pupil.trace(drawn.place, drawn.pupil, drawn.height)
        # Outside the aperture, surfaces may reflect rays totally, whose values are not finite then.
        seen = drawn.open & dr.all([dr.isfinite(value) for value in (*start, *direction)], axis=0)
        if lanes is None:
            return start, direction, seen, seed
        return start, direction, seen, seed, [dr.gather(mi.Float, each, own) for each in lanes.wavelengths]

    def _answer(self, drawn: Drawn) -> Any:
        """Return the pixels' response to rays by their paths behind the lenses, times the rays' weights in a medium."""
        absorption, even = self._camera.mla_absorption, self._draws.evenness(drawn)
        if self._response is None and not absorption:
            return even
        aside, depth = self._draws.crossed(drawn)
        response = 1 if self._response is None else self._response(dr.atan(aside / depth))
        return response * transmittance(absorption, aside, depth) * even

    def _bring(
        self,
        cells: Cells,
        key: Any,
        radiance: list[Any],
        known: list[Pair],
        lit: Any,
        number: int,
        lanes: Lanes | None,
    ) -> list[list[Any]]:
        """Return, for each image of a node, the rays' mean coefficients of each kernel."""
        spp = dr.opaque(mi.UInt32, self._spp)
        first = dr.arange(mi.UInt32, dr.width(cells.index)) * spp
        # Computed before the recorded loop, so as not to become a part of it.
        node, coefficients = self._nodes[number], self._coefficients[number]
        used, weights = node.mixture(lanes)
        radiance, known = [radiance[i] for i in used], [known[i] for i in used]

        def bring(k: Any, brought: list[list[Any]]) -> tuple[Any, list[list[Any]]]:
            drawn, even = self._draws.draw(cells, k, key), (k & 1) == 0
            others = [dr.select(even, pair[1], pair[0]) * self._known_part for pair in known]
            changes = [
                dr.gather(mi.Float, light, first + k) - other for light, other in zip(radiance, others, strict=True)
            ]
            active = drawn.open & dr.any([change != 0 for change in changes], axis=0)
            values = coefficients(drawn.point, drawn.inner, drawn.chance, active)
            result = []
            for row, before in zip(weights, brought, strict=True):
                change = drawn.weight * mixed(row, changes)
                after = [old + dr.select(active, value * change, 0) for old, value in zip(before, values, strict=True)]
                after[0] += dr.select(drawn.open, mixed(row, others), 0)
                result.append(after)
            return k + 1, result

        return self._mean_of(bring, lit, number, cells)

    def _mean_of(self, bring: Callable[..., Any], lit: Any, number: int, cells: Cells) -> list[list[Any]]:
        """Return the mean values of each lit cell, over its rays in a loop, for each image of a node."""
        node, functions = self._nodes[number], self._nodes[number].plan.functions.count
        nothing = [[mi.Float(0) for _ in range(self._sets * functions)] for _ in node.channels]
        end = dr.select(lit, dr.opaque(mi.UInt32, self._spp), 0)
        _, brought = dr.while_loop((mi.UInt32(0), nothing), lambda k, _: k < end, bring, label="signed rays")
        rays = mi.Float(dr.opaque(mi.UInt32, self._spp * self._passes))
        cosines = self._draws.cosines(cells)
        return [
            [
                value
                for first in range(0, len(parts), functions)
                for value in self._oblique[number].extended(
                    [part / rays for part in parts[first : first + functions]], cosines
                )
            ]
            for parts in brought
        ]


def _groups(nodes: Sequence[Node]) -> list[tuple[RayPupil, list[int]]]:
    """Group the nodes whose rays follow the same paths; return the main lens and the node indices of each group."""
    found: dict[float, tuple[RayPupil, list[int]]] = {}
    for number, node in enumerate(nodes):
        pupil = RayPupil(node.plan.system)
        found.setdefault(pupil.system.lens.refraction, (pupil, []))[1].append(number)
    return list(found.values())
