r"""A scene's capture by waves from the rays of a capture by rays: signed coefficients a ray, and convolutions.

Each cell of the detector's grid looks, through a lens that lights it, at points about that lens, and on through the
pupil into the scene; `optics.phase_space` says how much light of each ray arrives, and how it is spread. Nothing need
be known of the scene but the radiance along rays.

Coefficients change sign and size within a lens, so that their sum is uneven even for a scene of one radiance. Taken
is therefore, with the mean c of radiances that other, independent rays of the same cell and lens have found,

.. math:: \frac{1}{N} \sum_k \left[ w_k A_n(m_k, P_k)\, (L_k - c) + \delta_{n0}\, c \right] ,

which has the same mean, as the coefficients' integral over m is known, and no noise where the radiance is the same
(a control variate: Owen, "Monte Carlo theory, methods and examples", section 8.9).
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError
from ..optics.phase_space import Polynomials, RayCoefficients
from ..optics.pixel_response import angular_response
from ..optics.ray_pupil import RayPupil
from ..runtime.batches import Box, PartialSum
from ..runtime.fft import busy_drjit
from . import radiance as along
from .convolution import Block, Convolution, blocks_of, box_of, cost_of, margin_of
from .signed_colours import DrawnWavelengths, Lanes, Node, chances, span
from .signed_draws import ORDER, Cells, Draws, Pair, jitter

_BLOCK_BYTES = 2**29
"""Memory of the images of one block of the detector."""

_LANES = 2**22
"""Rays that are traced at once, about."""

_RAY_BYTES = 100
"""Memory of a ray, about."""

_PROBES, _CELLS = 2**10, 2**16
"""Cells whose light a capture is known by, and those that are timed for an estimate."""

_LEAST = 2
"""Rays from each cell through each lens at least: two halves of them correct each other."""

_REACH = 1.25
"""Distance in lenses to which kernels are computed."""


@dataclass(frozen=True)
class SceneLight:
    """The radiance along rays from the main lens into a scene.

    Attributes
    ----------
    scene, sensor : mitsuba.Scene, mitsuba.Sensor
        The scene, and the plenoptic sensor that says where the main lens is and when the shutter is open.
    integrator : mitsuba.SamplingIntegrator
        Finds the radiance.
    wavelength : float, optional
        For spectral variants, in nanometres.
    """

    scene: Any
    sensor: Any
    integrator: Any
    wavelength: float | None = None

    def __call__(
        self, point: tuple[Any, Any, Any], slope: Pair, active: Any, seed: int, wavelengths: list[Any] | None = None
    ) -> list[Any]:
        """Return the radiance along rays from points of the camera frame, by channel or at wavelengths of theirs."""
        to_world = self.sensor.world_transform()
        ray = mi.Ray3f(to_world @ mi.Point3f(*point), to_world @ dr.normalize(mi.Vector3f(*slope, 1)))
        if wavelengths is not None:
            ray.wavelengths = type(ray.wavelengths)(*wavelengths)
        elif self.wavelength is not None:
            ray.wavelengths = self.wavelength
        sampler = along.random_numbers(seed, dr.width(ray))
        ray.time = self.sensor.shutter_open()
        if self.sensor.shutter_open_time() > 0:
            ray.time += sampler.next_1d(active) * self.sensor.shutter_open_time()
        found = along.sample(self.integrator, self.scene, sampler, ray, self.sensor.get_medium(), active)
        return along.channels(found) if wavelengths is None else list(found)


class SignedRaySum:
    """A capture by signed rays, block of the detector by block; a `runtime.jobs.LongSum`.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera; its recorded window may be a crop.
    light : SceneLight or another function like it
        Finds the radiance along rays.
    nodes : sequence of Node
        The wavelengths at which the radiance is diffracted, and the channels that record it.
    drawn : DrawnWavelengths, optional
        From which rays have wavelengths of their own.
    parts : int
        Cells of the grid across a pixel.
    spp : int
        Rays of a pixel, shared by its cells and by the lenses that light them: each pair of these gets two at least.
    seed : int
        Of the random numbers.
    """

    arrays: Any = np

    def __init__(
        self,
        camera: PlenopticCamera,
        light: Any,
        nodes: Sequence[Node],
        drawn: DrawnWavelengths | None = None,
        *,
        parts: int,
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
        # Of drawn wavelengths, the least that correct each other have the same.
        self._spp = rays if drawn is None else _LEAST
        self._passes = round(rays / self._spp)
        self._channels = [channel for node in nodes for channel in node.channels]
        self.channels = max(self._channels) + 1
        rows, columns = camera.shape
        self.box = Box(0, 0, columns, rows)
        # Kernels are made before the images, whose memory they would add to.
        self._bins = box_of(camera, self._step, max(margin_of(kernels) for kernels in self._kernels))
        values = sum(len(kernels) * len(node.channels) for kernels, node in zip(self._kernels, nodes, strict=True))
        self._blocks = blocks_of(self._bins, _BLOCK_BYTES // (4 * values))
        self.items = np.array([block.rows * block.columns for block in self._blocks])

    def batches(self, first: int) -> Iterator[Block]:
        """Trace the rays of the blocks from one on, and yield what is left to do."""
        for number, bins in enumerate(self._blocks[first:], first):
            seeds = np.random.SeedSequence([self._seed, number])
            # The threads that compute the batches have put Dr.Jit's own to rest.
            with busy_drjit():
                sums = self._trace(bins, dr.arange(mi.UInt32, bins.rows * bins.columns), seeds)
            images = [part.numpy().reshape(-1, bins.rows, bins.columns) for part in sums]
            yield Block(bins, images, self._convolutions, self._channels)

    def image(self, total: PartialSum) -> NDArray[np.float32]:
        """Return the sum of all blocks."""
        return np.ascontiguousarray(np.moveaxis(total.sums, 0, -1))

    @cached_property
    def _kernels(self) -> list[list[NDArray[np.float32]]]:
        """Those of each node, for each type of lenses. A pixel is the mean of its cells."""
        reach = _REACH * max(self._camera.mla_pitches)
        return [
            [
                (kernel / self._parts**2).astype(np.float32)
                for kind in range(len(node.plan.kinds))
                for kernel in node.plan.kernels(self._step, reach, kind)
            ]
            for node in self._nodes
        ]

    @cached_property
    def _convolutions(self) -> list[Convolution]:
        """That of each image: those of a node's channels share one."""
        size = self._blocks[0].rows, self._blocks[0].columns
        order = 0 if self._draws.by_points else ORDER - 1
        made = [Convolution(self._camera, kernels, self._step, order, size) for kernels in self._kernels]
        return [each for node, each in zip(self._nodes, made, strict=True) for _ in node.channels]

    @cached_property
    def _coefficients(self) -> list[RayCoefficients | Polynomials]:
        return [node.plan.bind() for node in self._nodes]

    def _trace(self, box: Box, cells: Any, seeds: np.random.SeedSequence) -> list[Any]:
        """Trace the rays of some cells of a box.

        Return for each image what they bring of each kernel, (values, cells) flat.
        """
        kinds = len(self._draws.kinds.every)
        sums = [
            dr.zeros(mi.Float, dr.width(cells) * kinds * len(node.plan.exponents))
            for node in self._nodes
            for _ in node.channels
        ]
        dr.eval(cells, sums)
        for steps in self._draws.candidates:
            aims = self._draws.aims(Cells(box, cells, steps))
            pupil = self._draws.seen(aims.middle, aims)
            lit = dr.compress(dr.square(pupil[0]) + dr.square(pupil[1]) <= self._draws.widest**2)
            size = max(1, _LANES // self._spp)
            for start in range(0, dr.width(lit), size):
                some = dr.gather(
                    mi.UInt32, lit, dr.opaque(mi.UInt32, start) + dr.arange(mi.UInt32, min(size, dr.width(lit) - start))
                )
                every = dr.opaque(mi.UInt32, dr.width(cells))
                chosen = Cells(box, dr.gather(mi.UInt32, cells, some), steps)
                own = seeds.spawn(1)[0].generate_state(1 + self._passes).tolist()
                for turn, seed in enumerate(own[1:]):
                    lanes = self._lanes(chosen, turn, own[0])
                    for total, parts in zip(sums, self._collect(chosen, seed, lanes), strict=True):
                        first = (
                            some if kinds == 1 else some + every * (dr.gather(mi.UInt32, aims.kind, some) * len(parts))
                        )
                        for number, part in enumerate(parts):
                            # Every cell is in it once.
                            dr.scatter_reduce(
                                dr.ReduceOp.Add, total, part, first + every * number, mode=dr.ReduceMode.NoConflicts
                            )
                    dr.eval(sums)
        return sums

    def probe(self) -> NDArray[np.float32]:
        """Return what some cells' rays bring, by which a scene and its camera are known as the same."""
        cells = self._some(_PROBES)
        return np.concatenate([part.numpy() for part in self._trace(self._bins, cells, np.random.SeedSequence(0))])

    def cost(self) -> tuple[float, float]:
        """Estimate the time, in seconds, from some of the cells and tiles, and the bytes that the sum takes."""
        start = time.perf_counter()
        convolutions = self._convolutions
        made = time.perf_counter() - start
        count = self._bins.rows * self._bins.columns
        convolved, memory = cost_of(convolutions, self._blocks[0], count)
        # The first compiles the kernels.
        seconds = [self._timed(self._some(_CELLS), seed) for seed in range(3)]
        # Tables are held by their plans and on the device.
        tables = 2 * sum(part.nbytes for node in self._nodes for part in node.plan.table)
        return made + convolved + min(seconds[1:]) * count, memory + tables + _RAY_BYTES * _LANES

    def _some(self, count: int) -> Any:
        """Return some cells, evenly over all."""
        every = self._bins.rows * self._bins.columns
        return mi.UInt32(np.linspace(0, every - 1, min(count, every)).astype(np.uint32))

    def _timed(self, cells: Any, seed: int) -> float:
        """Time the rays of some cells; return the seconds a cell."""
        with busy_drjit():
            dr.sync_thread()
            start = time.perf_counter()
            self._trace(self._bins, cells, np.random.SeedSequence(seed))
            dr.sync_thread()
            return (time.perf_counter() - start) / dr.width(cells)

    def _lanes(self, cells: Cells, turn: int, seed: int) -> list[Lanes | None]:
        """Return the wavelengths of the rays of some cells in one of the passes, for each group of nodes."""
        if self._drawn is None:
            return [None for _ in self._groups]
        chance = chances(dr.opaque(mi.UInt32, cells.box.columns), cells.index, turn, seed)
        lanes: list[Lanes | None] = [
            self._drawn.draw(chance, span([self._nodes[number] for number in group])) for _, group in self._groups
        ]
        dr.eval(lanes)
        return lanes

    def _collect(self, cells: Cells, seed: int, lanes: Sequence[Lanes | None]) -> list[list[Any]]:
        """Trace the rays of some cells through a lens of each; return for each image what they bring."""
        spp = dr.opaque(mi.UInt32, self._spp)
        count, key = dr.width(cells.index), dr.opaque(mi.UInt32, seed & ~15)
        lane = dr.arange(mi.UInt32, count * self._spp)
        own = lane // spp
        drawn = self._draws.draw(replace(cells, index=dr.gather(mi.UInt32, cells.index, own)), lane - own * spp, key)
        counted = dr.select(drawn.open, mi.Float(1), 0)
        brought = []
        for (pupil, nodes), some in zip(self._groups, lanes, strict=True):
            start, direction = pupil.trace(drawn.place, drawn.pupil, drawn.height)
            # Beside a lens, surfaces may send rays back.
            seen = drawn.open & dr.all([dr.isfinite(value) for value in (*start, *direction)], axis=0)
            own_light = [] if some is None else [[dr.gather(mi.Float, each, own) for each in some.wavelengths]]
            radiance = self._light(start, direction, seen, seed, *own_light)
            if self._response is not None:
                response = self._response(self._draws.incidence(drawn))
                radiance = [light * response for light in radiance]
            finite = dr.all([dr.isfinite(light) for light in radiance], axis=0)
            dr.eval(finite, radiance, counted)
            if not dr.all(finite):
                raise InputError("scene: the radiance of some rays is NaN or infinite: all must be finite")
            known = self._known(radiance, counted, count)
            for number in nodes:
                brought += self._bring(cells, key, radiance, known, number, some)
        return brought

    def _known(self, radiance: list[Any], seen: Any, count: int) -> list[Pair]:
        """Return, for each of its values, the mean radiance that the rays of even and of odd numbers have found."""
        spp, first = dr.opaque(mi.UInt32, self._spp), dr.arange(mi.UInt32, count) * dr.opaque(mi.UInt32, self._spp)

        def add(k: Any, totals: list[Any]) -> tuple[Any, list[Any]]:
            values = [dr.gather(mi.Float, each, first + k) for each in (seen, *radiance)]
            even = (k & 1) == 0
            return k + 1, [total + dr.select(even == (i % 2 == 0), values[i // 2], 0) for i, total in enumerate(totals)]

        nothing = [mi.Float(0) for _ in range(2 * (1 + len(radiance)))]
        _, totals = dr.while_loop((mi.UInt32(0), nothing), lambda k, _: k < spp, add, label="means")
        result = [
            tuple(dr.select(totals[side] > 0, totals[2 + 2 * i + side] / totals[side], 0) for side in range(2))
            for i in range(len(radiance))
        ]
        dr.eval(result)
        return result

    def _bring(
        self, cells: Cells, key: Any, radiance: list[Any], known: list[Pair], number: int, lanes: Lanes | None
    ) -> list[list[Any]]:
        """Return, for each image of a node, what rays bring of each kernel."""
        spp = dr.opaque(mi.UInt32, self._spp)
        first = dr.arange(mi.UInt32, dr.width(cells.index)) * spp
        # Made before the loop, of which they are no part.
        node, coefficients = self._nodes[number], self._coefficients[number]
        used, weights = node.mixture(lanes)
        radiance, known = [radiance[i] for i in used], [known[i] for i in used]
        lit = mi.Bool(False)
        for even, odd in known:
            lit |= (even != 0) | (odd != 0)

        def bring(k: Any, brought: list[list[Any]]) -> tuple[Any, list[list[Any]]]:
            drawn, chance, even = self._draws.draw(cells, k, key), jitter(cells.index, key ^ (k << 4)), (k & 1) == 0
            others = [dr.select(even, pair[1], pair[0]) * self._known_part for pair in known]
            changes = [
                dr.gather(mi.Float, light, first + k) - other for light, other in zip(radiance, others, strict=True)
            ]
            active = drawn.open & dr.any([change != 0 for change in changes], axis=0)
            values = coefficients(drawn.point, drawn.inner, chance, active)
            result = []
            for row, before in zip(weights, brought, strict=True):
                change = drawn.weight * _mixed(row, changes)
                after = [old + dr.select(active, value * change, 0) for old, value in zip(before, values, strict=True)]
                after[0] += dr.select(drawn.open, _mixed(row, others), 0)
                result.append(after)
            return k + 1, result

        nothing = [[mi.Float(0) for _ in node.plan.exponents] for _ in node.channels]
        end = dr.select(lit, spp, 0)
        _, brought = dr.while_loop((mi.UInt32(0), nothing), lambda k, _: k < end, bring, label="signed rays")
        rays = mi.Float(dr.opaque(mi.UInt32, self._spp * self._passes))
        return [[part / rays for part in parts] for parts in brought]


def _groups(nodes: Sequence[Node]) -> list[tuple[RayPupil, list[int]]]:
    """Return the main lens of nodes whose rays go the same ways, and their numbers."""
    found: dict[float, tuple[RayPupil, list[int]]] = {}
    for number, node in enumerate(nodes):
        pupil = RayPupil(node.plan.camera, node.plan.wavelength)
        found.setdefault(pupil.refraction, (pupil, []))[1].append(number)
    return list(found.values())


def _mixed(weights: Sequence[Any], values: Sequence[Any]) -> Any:
    """Return the sum of the products."""
    return sum((weight * value for weight, value in zip(weights, values, strict=True)), start=mi.Float(0))
