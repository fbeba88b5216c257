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

import itertools
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError
from ..optics import rays
from ..optics.phase import in_millimetres
from ..optics.phase_space import PhaseSpace, RayCoefficients
from ..optics.thin import ThinLens
from ..runtime.batches import Box, PartialSum
from ..runtime.fft import busy_drjit
from . import child
from .bank.convolution import Convolution
from .draws import channels
from .lens_rays import Block, _blocks

Pair = tuple[Any, Any]

_BLOCK_BYTES = 2**29
"""Memory of the images of one block of the detector."""

_LANES = 2**22
"""Rays that are traced at once, about."""

_RAY_BYTES = 100
"""Memory of a ray, about."""

_PROBES, _CELLS = 2**10, 2**16
"""Cells whose light a capture is known by, and those that are timed for an estimate."""

_TRIAL = 512
"""Cells across that are convolved for an estimate."""

_STEPS = 1.1673039782614187 ** -np.arange(1.0, 5.0)
"""Steps of an additive sequence that fills four dimensions evenly: powers of 1 over the root of x^5 = x + 1."""

_FALL = 1.2
"""Distance, from a lens, over which the density of drawn points begins to fall off, in lambda b / 4 h."""

_TURNED = 1.0
"""That distance over the width of a lens from which on points are drawn along the pupil's radius and across it."""

_WIDEST = 4.0
"""That distance over the width of a lens, at most."""

_REACH = 1.25
"""Distance in lenses to which kernels are computed."""

_ORDER = 2
"""Points of the detector about a cell are drawn with the density of a B-spline of this order, so that what varies from
cell to cell faster than the grid can hold does not fold back into it."""


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
        to_world = self.sensor.world_transform()
        ray = mi.Ray3f(to_world @ mi.Point3f(*point), to_world @ dr.normalize(mi.Vector3f(*slope, 1)))
        if self.wavelength is not None:
            ray.wavelengths = self.wavelength
        sampler = child.random_numbers(seed, dr.width(ray))
        ray.time = self.sensor.shutter_open()
        if self.sensor.shutter_open_time() > 0:
            ray.time += sampler.next_1d(active) * self.sensor.shutter_open_time()
        return channels(child.sample(self.integrator, self.scene, sampler, ray, self.sensor.get_medium(), active))


class _Drawn(NamedTuple):
    """Rays that are drawn for cells of the detector."""

    pupil: Pair
    point: Pair  # on the array, from the centre of the lens
    place: Pair  # on the array, in the camera frame
    weight: Any  # one over the density of the points over the aperture
    open: Any  # whether the pupil lets them through
    active: Any  # whether they may bring light, too


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
        Rays from each cell through each lens that lights it.
    seed : int
        Of the random numbers.
    """

    arrays: Any = np

    def __init__(
        self, camera: PlenopticCamera, light: Any, plans: Sequence[PhaseSpace], *, parts: int, spp: int, seed: int
    ) -> None:
        self._camera, self._light, self._plans = camera, light, plans
        self._parts, self._spp, self._seed = parts, spp, seed
        self._step = camera.pixel_size / parts
        self._lens = ThinLens(camera.focal_length, camera.aperture_radius, camera.mla_distance, "parabolic")
        self._spread = _FALL * in_millimetres(max(plan.wavelength for plan in plans)) * camera.mla_distance / 4
        self._lens_area = float(camera.lattice.lens_area)
        self._window = max(math.hypot(*node.sides) / 2 for plan in plans for node in plan.nodes)
        self.channels = len(plans)
        rows, columns = camera.shape
        self.box = Box(0, 0, columns, rows)
        # Kernels are made before the images, whose memory they would add to.
        self._bins = self._convolutions[0].box
        values = sum(len(plan.exponents) for plan in plans)
        self._blocks = _blocks(self._bins, _BLOCK_BYTES // (4 * values))
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
                (plan.kernels(self._step, _REACH * self._camera.mla_pitch) / self._parts**2).astype(np.float32),
                self._step,
                order=_ORDER - 1,
            )
            for plan in self._plans
        }
        return [made[id(plan)] for plan in self._plans]

    @cached_property
    def _coefficients(self) -> list[RayCoefficients]:
        made = {id(plan): plan.bind() for plan in self._plans}
        return [made[id(plan)] for plan in self._plans]

    @cached_property
    def _candidates(self) -> NDArray[np.int64]:
        """Lenses that can light a cell, in steps from that of its chief ray."""
        camera = self._camera
        b, z = camera.mla_distance, camera.detector_distance
        return camera.lattice.neighbours(self._widest * z / (b + z))

    @property
    def _widest(self) -> float:
        """Distance from the axis, on the pupil's plane, within which the ray from a lit cell's middle comes."""
        camera = self._camera
        b, z = camera.mla_distance, camera.detector_distance
        # Other points of the cell, and of the lens, look a little aside.
        return camera.aperture_radius + self._step * b / z * _ORDER / math.sqrt(2) + camera.lattice.cell_reach

    def _trace(self, box: Box, cells: Any, seeds: np.random.SeedSequence) -> list[Any]:
        """Trace the rays of some cells of a box.

        Return for each channel what they bring of each kernel, (values, cells) flat.
        """
        sums = [dr.zeros(mi.Float, dr.width(cells) * len(plan.exponents)) for plan in self._plans]
        dr.eval(cells, sums)
        for steps in self._candidates:
            middle, centre = self._centres(box, cells, steps)
            pupil = self._follow(middle, centre)
            lit = dr.compress(dr.square(pupil[0]) + dr.square(pupil[1]) <= self._widest**2)
            size = max(1, _LANES // self._spp)
            for start in range(0, dr.width(lit), size):
                some = dr.gather(
                    mi.UInt32, lit, dr.opaque(mi.UInt32, start) + dr.arange(mi.UInt32, min(size, dr.width(lit) - start))
                )
                seed = int(seeds.spawn(1)[0].generate_state(1)[0])
                brought = self._collect(box, dr.gather(mi.UInt32, cells, some), steps, seed)
                every = dr.opaque(mi.UInt32, dr.width(cells))
                for total, parts in zip(sums, brought, strict=True):
                    for number, part in enumerate(parts):
                        # Every cell is in it once.
                        dr.scatter_reduce(
                            dr.ReduceOp.Add, total, part, some + every * number, mode=dr.ReduceMode.NoConflicts
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
        block = self._blocks[0]
        trial = Box(block.left, block.top, min(_TRIAL, block.columns), min(_TRIAL, block.rows))
        start = time.perf_counter()
        for convolution in convolutions:
            blank = np.zeros((trial.rows, trial.columns), np.float32)
            convolution.forward(itertools.repeat(blank, convolution.ranks), trial, convolution.reached(trial))
        count = self._bins.rows * self._bins.columns
        convolved = (time.perf_counter() - start) * count / (trial.rows * trial.columns)
        # The first compiles the kernels.
        seconds = [self._timed(self._some(_CELLS), seed) for seed in range(3)]
        images = 4.0 * sum(convolution.ranks for convolution in convolutions) * block.rows * block.columns
        # Two blocks are convolved, one waits and one is traced.
        memory = 4 * images + sum(convolution.memory for convolution in convolutions) + _RAY_BYTES * _LANES
        return made + convolved + min(seconds[1:]) * count, memory

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

    def _centres(self, box: Box, cells: Any, steps: NDArray[np.int64]) -> tuple[Pair, Pair]:
        """Return the middles of cells, and the centres of the lenses that are some steps from those of chief rays."""
        camera = self._camera
        # Opaque numbers do not compile the kernels again.
        columns = dr.opaque(mi.UInt32, box.columns)
        left, top = (dr.opaque(mi.Int32, number) for number in (box.left, box.top))
        row = cells // columns
        middle = tuple(
            (mi.Float(mi.Int32(index) + low) + 0.5) * self._step - 0.5 * camera.resolution[axis] * camera.pixel_size
            for axis, index, low in ((0, cells - row * columns, left), (1, row, top))
        )
        lattice, b, z = camera.lattice, camera.mla_distance, camera.detector_distance
        i, j = lattice.cell(*(rays.chief_point(p, b, z) for p in middle))
        i, j = (index + dr.opaque(mi.Float, float(step)) for index, step in zip((i, j), steps, strict=True))
        return middle, lattice.centre(i, j)

    def _follow(self, detector: Pair, centre: Pair) -> Pair:
        """Follow rays from the detector through the centres of lenses to the pupil."""
        z, b = self._camera.detector_distance, self._camera.mla_distance
        return tuple(rays.pupil_point(c, (c - p) / z, b) for c, p in zip(centre, detector, strict=True))

    def _draw(self, box: Box, cells: Any, sample: Any, steps: NDArray[np.int64], seed: Any) -> _Drawn:
        """Return the rays of these numbers from some cells."""
        middle, centre = self._centres(box, cells, steps)
        # Rays of even and of odd numbers are independent.
        half = sample & 1
        index = mi.Float(sample >> 1)
        random = []
        for axis, step in enumerate(_STEPS):
            value = index * step + mi.sample_tea_float32(cells, seed ^ (half * 8 + axis + 1))
            random.append(value - dr.floor(value))
        detector = tuple(p + _tent(r) * self._step for p, r in zip(middle, random[2:], strict=True))
        pupil = self._follow(detector, centre)
        point, density = self._aside(pupil, random[:2])
        place = tuple(c + m for c, m in zip(centre, point, strict=True))
        is_open = dr.square(pupil[0]) + dr.square(pupil[1]) <= self._camera.aperture_radius**2
        near = dr.square(point[0]) + dr.square(point[1]) <= self._window**2
        return _Drawn(pupil, point, place, 1 / (density * self._lens_area), is_open, is_open & near)

    def _aside(self, pupil: Pair, random: list[Any]) -> tuple[Pair, Any]:
        """Draw points about a lens, where the pupil spreads rays through it from; return their density, too.

        Along either of two directions they are even over the lens, and fall off by the square of the distance beyond. The directions are those of the lattice, or near the pupil's rim its radius and
        across it.
        """
        lattice, radius = self._camera.lattice, self._camera.aperture_radius
        Pu, Pv = lattice.to_frame(*pupil)
        widths = lattice.aperture_widths
        distance = dr.sqrt(Pu * Pu + Pv * Pv)
        # Half the widths of the overlap of the pupil with itself about P.
        across = dr.sqrt(dr.maximum(radius * radius - distance * distance, 0))
        turned = self._spread > _TURNED * (radius - distance) * max(widths)
        cosine, sine = dr.select(turned, Pu / distance, 1), dr.select(turned, Pv / distance, 0)
        halves = [
            dr.select(turned, at_rim, dr.sqrt(dr.maximum(radius * radius - other * other, 0)) - dr.abs(own))
            for at_rim, own, other in ((radius - distance, Pu, Pv), (across, Pv, Pu))
        ]
        extents = [
            0.5 * (widths[0] * dr.abs(c) + widths[1] * dr.abs(s)) for c, s in ((cosine, sine), (sine, cosine))
        ]
        places, density = [], mi.Float(1)
        for r, half, extent in zip(random, halves, extents, strict=True):
            fall = dr.minimum(self._spread / dr.maximum(half, 1e-6 * radius), _WIDEST * max(widths))
            side = 2 * r - 1
            # The greatest density over that of the place, by its root; from 1 on it is beyond the even part.
            less = fall / ((extent + fall) * dr.maximum(1 - dr.abs(side), 1e-7))
            far = dr.copysign(extent + fall * (less - 1), side)
            places.append(dr.select(less > 1, far, side * (extent + fall)))
            density *= 0.5 / ((extent + fall) * dr.square(dr.maximum(less, 1)))
        u = places[0] * cosine - places[1] * sine
        v = places[0] * sine + places[1] * cosine
        return lattice.from_frame(u, v), density

    def _collect(self, box: Box, cells: Any, steps: NDArray[np.int64], seed: int) -> list[list[Any]]:
        """Trace the rays of some cells through a lens of each; return for each channel what they bring."""
        spp = dr.opaque(mi.UInt32, self._spp)
        count, key = dr.width(cells), dr.opaque(mi.UInt32, seed & ~15)
        lane = dr.arange(mi.UInt32, count * self._spp)
        own = lane // spp
        drawn = self._draw(box, dr.gather(mi.UInt32, cells, own), lane - own * spp, steps, key)
        slope = tuple((P - q) / self._camera.mla_distance for P, q in zip(drawn.pupil, drawn.place, strict=True))
        start, direction, _ = self._lens.trace(drawn.place, slope)
        radiance = self._light(start, direction, drawn.active, seed)
        finite = dr.all([dr.isfinite(light) for light in radiance], axis=0)
        seen = dr.select(drawn.active, mi.Float(1), 0)
        dr.eval(finite, radiance, seen)
        if not dr.all(finite):
            raise InputError("scene: the radiance of some rays is NaN or infinite: all must be finite")
        means = self._means(radiance, seen, count)
        return self._bring(box, cells, steps, key, radiance, means)

    def _means(self, radiance: list[Any], seen: Any, count: int) -> list[Pair]:
        """Return, for each channel, the mean radiance that the rays of even and those of odd numbers have found."""
        spp, first = dr.opaque(mi.UInt32, self._spp), dr.arange(mi.UInt32, count) * dr.opaque(mi.UInt32, self._spp)

        def add(k: Any, totals: list[Any]) -> tuple[Any, list[Any]]:
            values = [dr.gather(mi.Float, each, first + k) for each in (seen, *radiance)]
            even = (k & 1) == 0
            return k + 1, [
                total + dr.select(even == (i % 2 == 0), values[i // 2], 0) for i, total in enumerate(totals)
            ]

        nothing = [mi.Float(0) for _ in range(2 * (1 + len(radiance)))]
        _, totals = dr.while_loop((mi.UInt32(0), nothing), lambda k, _: k < spp, add, label="means")
        result = [
            tuple(dr.select(totals[side] > 0, totals[2 + 2 * i + side] / totals[side], 0) for side in range(2))
            for i in range(len(radiance))
        ]
        dr.eval(result)
        return result

    def _bring(
        self, box: Box, cells: Any, steps: NDArray[np.int64], key: Any, radiance: list[Any], means: list[Pair]
    ) -> list[list[Any]]:
        """Return, for each channel, what rays bring of each kernel."""
        spp = dr.opaque(mi.UInt32, self._spp)
        first = dr.arange(mi.UInt32, dr.width(cells)) * spp
        lit = mi.Bool(False)
        for even, odd in means:
            lit |= (even > 0) | (odd > 0)

        def bring(k: Any, brought: list[list[Any]]) -> tuple[Any, list[list[Any]]]:
            drawn = self._draw(box, cells, k, steps, key)
            jitter = _jitter(cells, key ^ (k << 4))
            even = (k & 1) == 0
            result = []
            for light, pair, coefficients, before in zip(
                radiance, means, self._coefficients, brought, strict=True
            ):
                known = dr.select(even, pair[1], pair[0])
                change = (dr.gather(mi.Float, light, first + k) - known) * drawn.weight
                active = drawn.active & (change != 0)
                values = coefficients(drawn.point, drawn.pupil, jitter, active)
                after = [old + dr.select(active, value * change, 0) for old, value in zip(before, values, strict=True)]
                after[0] += dr.select(drawn.open, known, 0)
                result.append(after)
            return k + 1, result

        nothing = [[mi.Float(0) for _ in plan.exponents] for plan in self._plans]
        end = dr.select(lit, spp, 0)
        _, brought = dr.while_loop((mi.UInt32(0), nothing), lambda k, _: k < end, bring, label="signed rays")
        return [[part / mi.Float(spp) for part in parts] for parts in brought]


def _tent(value: Any) -> Any:
    """Turn evenly distributed numbers into those of the density 1 - |t|, a B-spline of order 2."""
    return dr.select(value < 0.5, dr.sqrt(2 * value) - 1, 1 - dr.sqrt(2 * (1 - value)))


def _jitter(cells: Any, key: Any) -> tuple[Any, Any, Any, Any]:
    """Return four random numbers, of 16 bits each."""
    words = mi.sample_tea_32(cells, key)
    low = [mi.Float(word & 0xFFFF) * 2.0**-16 for word in words]
    high = [mi.Float(word >> 16) * 2.0**-16 for word in words]
    return low[0], low[1], high[0], high[1]
