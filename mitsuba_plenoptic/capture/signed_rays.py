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
from ..optics.phase_space import PhaseSpace, RayCoefficients
from ..optics.thin import ThinLens
from ..runtime.batches import Box, PartialSum
from ..runtime.fft import busy_drjit
from . import child
from .bank.convolution import Convolution, cost_of
from .draws import channels
from .lens_rays import Block, blocks_of
from .signed_draws import ORDER, Cells, Drawn, Draws, Pair, jitter

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

REACH = 1.25
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

    def __call__(self, point: tuple[Any, Any, Any], slope: Pair, active: Any, seed: int) -> list[Any]:
        """Return the radiance, by channel, along rays from points of the camera frame."""
        sampler, ray = self.rays(point, slope, active, seed)
        return channels(child.sample(self.integrator, self.scene, sampler, ray, self.sensor.get_medium(), active))

    def rays(self, point: tuple[Any, Any, Any], slope: Pair, active: Any, seed: int) -> tuple[Any, Any]:
        """Return random numbers, and rays from points of the camera frame as the scene's integrators take them."""
        to_world = self.sensor.world_transform()
        ray = mi.Ray3f(to_world @ mi.Point3f(*point), to_world @ dr.normalize(mi.Vector3f(*slope, 1)))
        if self.wavelength is not None:
            ray.wavelengths = self.wavelength
        sampler = child.random_numbers(seed, dr.width(ray))
        ray.time = self.sensor.shutter_open()
        if self.sensor.shutter_open_time() > 0:
            ray.time += sampler.next_1d(active) * self.sensor.shutter_open_time()
        return sampler, ray


class SignedRaySum:
    """A capture by signed rays, block of the detector by block; a `runtime.jobs.LongSum`.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera; its recorded window may be a crop.
    light : SceneLight or another function like it
        Finds the radiance along rays.
    plans : sequence of PhaseSpace
        Of each channel of the radiance.
    parts : int
        Cells of the grid across a pixel.
    spp : int
        Rays of a pixel, shared by its cells and by the lenses that light them: each pair of these gets two at least.
    seed : int
        Of the random numbers.
    """

    arrays: Any = np
    _sets = 1
    """How often a ray has a value for each coefficient: once, but for derivatives."""

    def __init__(
        self, camera: PlenopticCamera, light: Any, plans: Sequence[PhaseSpace], *, parts: int, spp: int, seed: int
    ) -> None:
        self._camera, self._light, self._plans = camera, light, plans
        self._parts, self._seed = parts, seed
        self._step = camera.pixel_size / parts
        self._lens = ThinLens(camera.focal_length, camera.aperture_radius, camera.mla_distance, "parabolic")
        self._draws = Draws(camera, plans, self._step)
        self._spp = max(_LEAST, round(spp / (parts**2 * max(1.0, self._draws.lit_lenses))))
        self.channels = len(plans)
        rows, columns = camera.shape
        self.box = Box(0, 0, columns, rows)
        # Kernels are made before the images, whose memory they would add to.
        self._bins = self._convolutions[0].box
        values = sum(convolution.ranks for convolution in self._convolutions)
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
            yield Block(bins, images, self._convolutions)

    def image(self, total: PartialSum) -> NDArray[np.float32]:
        """Return the sum of all blocks."""
        return np.ascontiguousarray(np.moveaxis(total.sums, 0, -1))

    @cached_property
    def _convolutions(self) -> list[Convolution]:
        # Channels of the same wavelength share theirs. A pixel is the mean of its cells.
        made = {
            id(plan): Convolution(
                self._camera,
                [
                    (kernel / self._parts**2).astype(np.float32)
                    for kind in range(len(self._camera.mla_focal_lengths))
                    for kernel in self._kernels(plan, kind)
                ],
                self._step,
                order=ORDER - 1,
            )
            for plan in self._plans
        }
        return [made[id(plan)] for plan in self._plans]

    def _kernels(self, plan: PhaseSpace, kind: int) -> list[NDArray[np.float64]]:
        """Return the kernels of lenses of a type, for each value of a ray."""
        return list(plan.kernels(self._step, REACH * max(self._camera.mla_pitches), kind))

    @cached_property
    def _coefficients(self) -> list[RayCoefficients]:
        made = {id(plan): plan.bind() for plan in self._plans}
        return [made[id(plan)] for plan in self._plans]

    def _trace(self, box: Box, cells: Any, seeds: np.random.SeedSequence) -> list[Any]:
        """Trace the rays of some cells of a box.

        Return for each channel what they bring of each kernel, (values, cells) flat.
        """
        types = len(self._camera.mla_focal_lengths)
        values = types * self._sets
        sums = [dr.zeros(mi.Float, dr.width(cells) * values * len(plan.exponents)) for plan in self._plans]
        dr.eval(cells, sums)
        every = dr.opaque(mi.UInt32, dr.width(cells))
        for some, kind, own, seed in self._lots(box, cells, seeds):
            for total, parts in zip(sums, self._collect(own, seed), strict=True):
                first = some if types == 1 else some + every * (kind * len(parts))
                for number, part in enumerate(parts):
                    # Every cell is in it once.
                    dr.scatter_reduce(
                        dr.ReduceOp.Add, total, part, first + every * number, mode=dr.ReduceMode.NoConflicts
                    )
            dr.eval(sums)
        return sums

    def _lots(self, box: Box, cells: Any, seeds: np.random.SeedSequence) -> Iterator[tuple[Any, Any, Cells, int]]:
        """Yield cells with a lens that lights each, whose rays are traced at once.

        First come which of the given cells they are, and the types of their lenses; last a seed.
        """
        for steps in self._draws.candidates:
            middle, centre, kind = self._draws.centres(Cells(box, cells, steps))
            pupil = self._draws.through_centre(middle, centre)
            lit = dr.compress(dr.square(pupil[0]) + dr.square(pupil[1]) <= self._draws.widest**2)
            size = max(1, _LANES // self._spp)
            for start in range(0, dr.width(lit), size):
                some = dr.gather(
                    mi.UInt32, lit, dr.opaque(mi.UInt32, start) + dr.arange(mi.UInt32, min(size, dr.width(lit) - start))
                )
                seed = int(seeds.spawn(1)[0].generate_state(1)[0])
                own = Cells(box, dr.gather(mi.UInt32, cells, some), steps)
                yield some, dr.gather(mi.UInt32, kind, some), own, seed

    def back(self, gradient: Sequence[NDArray[np.float32]]) -> Iterator[tuple[Cells, Any, list[Any], int]]:
        """Yield the lots of all blocks, and what a figure changes by with what their rays bring.

        Parameters
        ----------
        gradient : sequence of float32 arrays (rows, columns)
            Of the figure with respect to the sum, for each channel.

        Yields
        ------
        cells : Cells
            Cells with a lens of each.
        first : UInt32
            Where in `felt` is what belongs to their first values; that of the next follows a block's cells later.
        felt : list of Float
            By how much the figure changes, for each channel.
        seed : int
            Of the rays.
        """
        for number, bins in enumerate(self._blocks):
            seeds, count = np.random.SeedSequence([self._seed, number]), bins.rows * bins.columns
            felt = [
                mi.Float(np.concatenate([image.ravel() for image in convolution.adjoint(channel, bins)]))
                for convolution, channel in zip(self._convolutions, gradient, strict=True)
            ]
            values = dr.opaque(mi.UInt32, count * self._sets * len(self._plans[0].exponents))
            for some, kind, own, seed in self._lots(bins, dr.arange(mi.UInt32, count), seeds):
                yield own, some + values * kind, felt, seed

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
        return made + convolved + min(seconds[1:]) * count, memory + _RAY_BYTES * _LANES

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

    def _collect(self, cells: Cells, seed: int) -> list[list[Any]]:
        """Trace the rays of some cells through a lens of each; return for each channel what they bring."""
        count, key = dr.width(cells.index), dr.opaque(mi.UInt32, seed & ~15)
        drawn, *ray = self._rays(cells, key)
        radiance = self._light(*ray, drawn.open, seed)
        seen = dr.select(drawn.open, mi.Float(1), 0)
        dr.eval(radiance, seen)
        require_finite(radiance)
        known, lit = self._known(radiance, seen, count)
        return self._bring(cells, key, radiance, known, lit)

    def _rays(self, cells: Cells, key: Any) -> tuple[Drawn, tuple[Any, Any, Any], Pair]:
        """Return all rays of some cells, a lane each, and where and how steeply they go on into the scene."""
        spp = dr.opaque(mi.UInt32, self._spp)
        lane = dr.arange(mi.UInt32, dr.width(cells.index) * self._spp)
        own = lane // spp
        drawn = self._draws.draw(replace(cells, index=dr.gather(mi.UInt32, cells.index, own)), lane - own * spp, key)
        slope = tuple((P - q) / self._camera.mla_distance for P, q in zip(drawn.pupil, drawn.place, strict=True))
        start, direction, _ = self._lens.trace(drawn.place, slope)
        return drawn, start, direction

    def _known(self, radiance: list[Any], seen: Any, count: int) -> tuple[list[Pair], Any]:
        """Return, for each channel, the mean radiance that the rays of even and those of odd numbers have found.

        Return, too, which cells have any; derivatives of radiance may cancel in the means.
        """
        (counts, *sums), lit = self._halves(seen, radiance, count)
        means = [
            tuple(dr.select(number > 0, total / number, 0) for total, number in zip(pair, counts, strict=True))
            for pair in sums
        ]
        dr.eval(means, lit)
        return means, lit

    def _halves(self, seen: Any, values: list[Any], count: int) -> tuple[list[Pair], Any]:
        """Return sums over the rays of even and those of odd numbers of cells: of `seen`, and of each of some values.

        Return, too, where any of these values is not zero.
        """
        spp, first = dr.opaque(mi.UInt32, self._spp), dr.arange(mi.UInt32, count) * dr.opaque(mi.UInt32, self._spp)

        def add(k: Any, totals: list[Pair], some: Any) -> tuple[Any, list[Pair], Any]:
            own = [dr.gather(mi.Float, each, first + k) for each in (seen, *values)]
            even = (k & 1) == 0
            totals = [
                (a + dr.select(even, value, 0), b + dr.select(even, 0, value))
                for (a, b), value in zip(totals, own, strict=True)
            ]
            return k + 1, totals, some | dr.any([value != 0 for value in own[1:]], axis=0)

        state = mi.UInt32(0), [(mi.Float(0), mi.Float(0)) for _ in range(1 + len(values))], mi.Bool(False)
        _, totals, some = dr.while_loop(state, lambda k, *_: k < spp, add, label="halves")
        return totals, some

    def _bring(self, cells: Cells, key: Any, radiance: list[Any], known: list[Pair], lit: Any) -> list[list[Any]]:
        """Return, for each channel, what rays bring of each kernel."""
        spp = dr.opaque(mi.UInt32, self._spp)
        first = dr.arange(mi.UInt32, dr.width(cells.index)) * spp
        # Made before the loop, of which they are no part.
        tables = self._coefficients

        def bring(k: Any, brought: list[list[Any]]) -> tuple[Any, list[list[Any]]]:
            drawn, chance, even = self._draws.draw(cells, k, key), jitter(cells.index, key ^ (k << 4)), (k & 1) == 0
            result = []
            for light, pair, coefficients, before in zip(radiance, known, tables, brought, strict=True):
                other = dr.select(even, pair[1], pair[0])
                change = (dr.gather(mi.Float, light, first + k) - other) * drawn.weight
                active = drawn.open & (change != 0)
                values = coefficients(drawn.point, drawn.pupil, chance, active)
                after = [old + dr.select(active, value * change, 0) for old, value in zip(before, values, strict=True)]
                after[0] += dr.select(drawn.open, other, 0)
                result.append(after)
            return k + 1, result

        nothing = [[mi.Float(0) for _ in plan.exponents] for plan in self._plans]
        end = dr.select(lit, spp, 0)
        _, brought = dr.while_loop((mi.UInt32(0), nothing), lambda k, _: k < end, bring, label="signed rays")
        return [[part / mi.Float(spp) for part in parts] for parts in brought]


def require_finite(radiance: list[Any]) -> None:
    """Refuse radiances of which some are no numbers."""
    if not dr.all(dr.all([dr.isfinite(light) for light in radiance], axis=0)):
        raise InputError("scene: the radiance of some rays is NaN or infinite: all must be finite")
