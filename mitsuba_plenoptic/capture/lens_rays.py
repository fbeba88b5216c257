r"""What is out of focus, at the price of rays: one ray from each detector point through the centre of each lens.

Out of focus, a scene point sends light through one microlens into a spot around the place where its ray through the
centre of that lens meets the detector. Spots are sums of a few kernels (see `bank`), so that the capture is

.. math:: I = \sum_r k_r * \left[ c_r(P, v) \, L \right]

with the radiance L that the ray from a detector point through a lens's centre finds in the scene, the point P where it
passes the pupil, and the vergence v of the image of what it meets. Each ray brings its own radiance: nothing need be
known of how a scene point shines over the pupil, nor of what hides it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError
from ..optics import rays
from ..runtime.batches import Box, Part, PartialSum
from ..runtime.fft import busy_drjit
from .bank import Convolution, LensBank, cost_of, margin_of, near_weight
from .lens_paths import Path, paths_of
from .sight import Sight

_BLOCK_BYTES = 2**29
"""Memory of the images of one block of the detector."""

_LANES = 2**21
"""Rays that are traced at once, about."""

_FEWER = 16
"""By how much fewer rays are traced where light comes by diffraction alone."""

_FEW_BINS, _MANY_BINS, _TRIALS = 2**14, 2**16, 2
"""Bins whose rays are timed for an estimate; how often the many are."""

_RAY_BYTES = 200
"""Memory of a ray, about."""

_JITTER = (0.7548776662466927, 0.5698402909980532)
"""Steps of the R2 sequence (Roberts 2018) from sample to sample of a bin."""


class LensRaySum:
    """The part of a capture that a kernel bank records, block of the detector by block; a `runtime.jobs.LongSum`.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera; its recorded window may be a crop.
    sight : Sight
        Finds the light along rays.
    banks : sequence of sequence of LensBank
        For each channel, for each lens type.
    wavelength : float
        Wavelength in nanometres by which rays are traced through a real main lens.
    accuracy : float
        Allowed relative error, by which it is decided which light is left to exact point spreads.
    spp : int
        Rays to each detector bin and lens.
    seed : int
        Of the random numbers.
    """

    arrays: Any = np

    def __init__(
        self,
        camera: PlenopticCamera,
        sight: Sight,
        banks: Sequence[Sequence[LensBank]],
        *,
        wavelength: float,
        accuracy: float,
        spp: int,
        seed: int,
    ) -> None:
        self._camera, self._sight, self._banks = camera, sight, banks
        self._accuracy, self._spp, self._seed = accuracy, spp, seed
        self._pitch = banks[0][0].pitch
        self.channels = len(banks)
        rows, columns = camera.shape
        self.box = Box(0, 0, columns, rows)
        self._paths = paths_of(camera, [bank for of_channel in banks for bank in of_channel], wavelength)
        margin = margin_of([kernel for of_channel in banks for bank in of_channel for kernel in bank.kernels])
        left, top = (offset * self._parts - margin for offset in camera.crop_offset)
        self._bins = Box(left, top, columns * self._parts + 2 * margin, rows * self._parts + 2 * margin)
        ranks = [sum(bank.rank for bank in of_channel) for of_channel in banks]
        self._blocks = blocks_of(self._bins, _BLOCK_BYTES // (4 * sum(ranks)))
        self.items = np.array([block.rows * block.columns for block in self._blocks])

    def batches(self, first: int) -> Iterator[Block]:
        """Trace the rays of the blocks from one on, and yield what is left to do."""
        for number, bins in enumerate(self._blocks[first:], first):
            seeds = np.random.SeedSequence([self._seed, number])
            # The threads that compute the batches have put Dr.Jit's own to rest.
            with busy_drjit():
                count = bins.rows * bins.columns
                sums = self._trace_bins(bins, dr.arange(mi.UInt32, count), self._candidates, seeds)
            images = [part.numpy().reshape(-1, bins.rows, bins.columns) for part in sums]
            yield Block(bins, images, self._convolutions, range(self.channels))

    @cached_property
    def _convolutions(self) -> list[Convolution]:
        largest = self._blocks[0].rows, self._blocks[0].columns
        # Channels of the same kernels share theirs.
        keys = [tuple(id(bank.kernels) for bank in banks) for banks in self._banks]
        made = {
            key: Convolution(
                self._camera, [kernel for bank in banks for kernel in bank.kernels], self._pitch, order=1, size=largest
            )
            for key, banks in dict(zip(keys, self._banks, strict=True)).items()
        }
        return [made[key] for key in keys]

    def image(self, total: PartialSum) -> NDArray[np.float32]:
        """Return the sum of all blocks."""
        return np.ascontiguousarray(np.moveaxis(total.sums, 0, -1))

    @cached_property
    def _candidates(self) -> NDArray[np.int64]:
        """Lenses that can light a detector bin, in steps from that of its chief ray."""
        camera = self._camera
        scale = camera.detector_distance / (self._paths.pupil_distance + camera.detector_distance)
        return camera.lattice.neighbours(self._paths.widest * scale)

    def cost(self) -> tuple[float, float]:
        """Estimate the time, in seconds, from some of the rays and tiles, and tell the bytes that it takes."""
        start = time.perf_counter()
        convolutions = self._convolutions
        made = time.perf_counter() - start
        count = self._bins.rows * self._bins.columns
        convolved, memory = cost_of(convolutions, self._blocks[0], count)
        return made + convolved + self._tracing(), memory + _RAY_BYTES * _LANES

    def _tracing(self) -> float:
        """Estimate the seconds that all rays take: a part for each block, and a part for each bin."""
        # The first compile the kernels, of which light paths of other lengths need others.
        many, longer = min(self._timed(_MANY_BINS, seed) for seed in range(_TRIALS))
        few, seconds = self._timed(_FEW_BINS, _TRIALS)
        count = self._bins.rows * self._bins.columns
        if many == few or longer <= seconds:
            return longer / many * count
        each = (longer - seconds) / (many - few)
        return max(seconds - few * each, 0.0) * len(self._blocks) + count * each

    def _timed(self, count: int, seed: int) -> tuple[int, float]:
        """Time the rays of rows of about so many bins, evenly over the detector; return their number, too."""
        rows, columns = self._bins.rows, self._bins.columns
        lines = min(rows, max(1, count // columns))
        index = dr.arange(mi.UInt32, lines * columns)
        bins = index + index // columns * ((rows // lines - 1) * columns)
        with busy_drjit():
            dr.eval(bins)
            start = time.perf_counter()
            self._trace_bins(self._bins, bins, self._candidates, np.random.SeedSequence(seed))
            dr.sync_thread()
            return lines * columns, time.perf_counter() - start

    @property
    def _parts(self) -> int:
        """Bins across a pixel."""
        return round(self._camera.pixel_size / self._pitch)

    @property
    def _few(self) -> int:
        """How many rays to each bin and lens are traced there."""
        return -(-self._spp // _FEWER)

    def _trace_bins(
        self, box: Box, bins: Any, candidates: NDArray[np.int64], seeds: np.random.SeedSequence
    ) -> list[Any]:
        """Trace the rays of some bins of a box through lenses near them.

        Return for each channel what they bring of each kernel, (ranks, bins) flat.
        """
        count = dr.width(bins)
        sums = [dr.zeros(mi.Float, count * sum(bank.rank for bank in banks)) for banks in self._banks]
        dr.eval(bins, sums)
        for steps in candidates:
            pupil, centre, _, _ = self._pupil_points(box, bins, steps)
            # Beyond the rim there is little light, for which few rays do.
            for kept, spp in zip(self._paths.lit(pupil, centre), (self._spp, self._few), strict=True):
                lit = dr.compress(kept)
                step = max(1, _LANES // spp)
                for start in range(0, dr.width(lit), step):
                    seed = int(seeds.spawn(1)[0].generate_state(1)[0])
                    some = dr.gather(
                        mi.UInt32,
                        lit,
                        dr.opaque(mi.UInt32, start) + dr.arange(mi.UInt32, min(step, dr.width(lit) - start)),
                    )
                    traced = self._trace_lit(box, dr.gather(mi.UInt32, bins, some), steps, spp, seed)
                    self._collect(sums, traced, some, spp)
        return sums

    def _pupil_points(
        self, box: Box, bins: Any, steps: NDArray[np.int64], jitter: Any = None
    ) -> tuple[tuple[Any, Any], tuple[Any, Any], tuple[Any, Any], Any]:
        """Return where rays through the centre of a lens near the bins' own pass the pupil; centres, slopes, types."""
        camera, lattice = self._camera, self._camera.lattice
        b, z = self._paths.pupil_distance, self._banks[0][0].arrival
        # Opaque numbers do not compile the kernels again.
        columns = dr.opaque(mi.UInt32, box.columns)
        left, top = (dr.opaque(mi.Int32, number) for number in (box.left, box.top))
        row = bins // columns
        middle = [
            (mi.Float(mi.Int32(index) + low) + 0.5) * self._pitch - 0.5 * camera.resolution[axis] * camera.pixel_size
            for axis, index, low in ((0, bins - row * columns, left), (1, row, top))
        ]
        i, j = lattice.cell(*(rays.chief_point(p, b, z) for p in middle))
        i, j = (index + dr.opaque(mi.Float, float(step)) for index, step in zip((i, j), steps, strict=True))
        centre = lattice.centre(i, j)
        place = middle if jitter is None else [p + (jitter[axis] - 0.5) * self._pitch for axis, p in enumerate(middle)]
        slope = tuple((c - p) / z for c, p in zip(centre, place, strict=True))
        pupil = tuple(rays.pupil_point(c, s, b) for c, s in zip(centre, slope, strict=True))
        return pupil, centre, slope, lattice.lens_type(i, j) if len(self._banks[0]) > 1 else None

    def _counts(self, path: Path, distance: Any) -> Any:
        """Whether what rays meet at some distances is out of focus, and brings light where they pass the pupil."""
        vergence = path.vergence(distance)
        return (near_weight(self._camera, vergence, self._accuracy) < 1) & path.reaches(vergence)

    def _trace_lit(self, box: Box, bins: Any, steps: NDArray[np.int64], spp: int, seed: int) -> _Traced:
        """Trace the rays of some bins through one of the lenses near them; those of a bin follow each other."""
        lane = dr.arange(mi.UInt32, dr.width(bins) * spp)
        own, sample = dr.gather(mi.UInt32, bins, lane // spp), mi.Float(lane % spp)
        shift = dr.opaque(mi.UInt32, seed)
        # Every bin has a shift of its own, so that neighbours are not jittered alike.
        jitter = mi.Point2f(
            *(sample * step + mi.sample_tea_float32(own, shift ^ axis) for axis, step in enumerate(_JITTER))
        )
        pupil, centre, slope, lens_type = self._pupil_points(box, own, steps, jitter - dr.floor(jitter))
        path = self._paths.follow(pupil, centre, slope)
        radiance, distance = self._sight.look(path.point, path.slope, seed, partial(self._counts, path))
        vergence = path.vergence(distance)
        finite = dr.all([dr.isfinite(light) for light in radiance], axis=0)
        # A pixel is the mean of its bins, of which the convolution takes the sum.
        part = (self._pitch / self._camera.pixel_size) ** 2 / spp
        weight = (1 - near_weight(self._camera, vergence, self._accuracy)) * part
        traced = _Traced(*path.asked(distance, vergence), [weight * light for light in radiance], lens_type)
        dr.eval(finite, traced)
        if not dr.all(finite):
            raise InputError("scene: the radiance of some rays is NaN or infinite: all must be finite")
        return traced

    def _collect(self, sums: list[Any], traced: _Traced, targets: Any, spp: int) -> None:
        """Add what rays bring of each kernel to the sums of their bins."""
        first = dr.arange(mi.UInt32, dr.width(targets)) * dr.opaque(mi.UInt32, spp)
        end = first + dr.opaque(mi.UInt32, spp)

        def bring(ray: Any, brought: list[list[Any]]) -> tuple[Any, list[list[Any]]]:
            pupil = dr.gather(mi.Float, traced.Px, ray), dr.gather(mi.Float, traced.Py, ray)
            vergence = dr.gather(mi.Float, traced.vergence, ray)
            lens_type = None if traced.lens_type is None else dr.gather(type(traced.lens_type), traced.lens_type, ray)
            total = []
            for light, banks, before in zip(traced.light, self._banks, brought, strict=True):
                power = dr.gather(mi.Float, light, ray)
                of_type = [
                    power if lens_type is None else dr.select(lens_type == n, power, 0) for n in range(len(banks))
                ]
                parts = [
                    coefficient * own
                    for bank, own in zip(banks, of_type, strict=True)
                    for coefficient in bank.coefficients(*pupil, vergence, own != 0)
                ]
                total.append([old + part for old, part in zip(before, parts, strict=True)])
            return ray + 1, total

        # A loop keeps the sums in registers: the coefficients of all rays would be more than memory passes quickly.
        nothing = [[mi.Float(0) for bank in banks for _ in range(bank.rank)] for banks in self._banks]
        _, brought = dr.while_loop((first, nothing), lambda ray, _: ray < end, bring, label="what rays bring")
        for channel, parts in enumerate(brought):
            count = dr.opaque(mi.UInt32, dr.width(sums[channel]) // len(parts))
            for rank, part in enumerate(parts):
                # Every bin is in it once.
                dr.scatter_reduce(
                    dr.ReduceOp.Add, sums[channel], part, targets + count * rank, mode=dr.ReduceMode.NoConflicts
                )
        dr.eval(sums)


@dataclass(frozen=True)
class _Traced:
    """Rays from the detector: where they pass the pupil, and what they find in the scene.

    Attributes
    ----------
    Px, Py, vergence : Float
        By which `LensBank.coefficients` knows them: where they pass the pupil of a thin main lens, in the camera's
        frame, and the vergence of the image of what they meet, in 1/mm.
    light : list of Float
        For each channel, what they bring to a pixel.
    lens_type : Float, optional
        Of the lenses that they pass.
    """

    Px: Any
    Py: Any
    vergence: Any
    light: list[Any]
    lens_type: Any


@dataclass(frozen=True)
class Block:
    """The images of a block of bins, to be convolved with the kernels.

    Attributes
    ----------
    bins : Box
        The bins.
    images : list of float32 arrays (ranks, rows, columns)
        What rays bring of the kernels of each convolution.
    convolutions : list of Convolution
        For each of the images.
    channels : sequence of int
        Those to which they are added, counted from 0; none is left out.
    """

    bins: Box
    images: list[NDArray[np.float32]]
    convolutions: list[Convolution]
    channels: Sequence[int]

    @property
    def samples(self) -> int:
        """Samples of all images."""
        return sum(image.size for image in self.images)

    def prepare(self) -> Callable[[], Part]:
        """Return the function that convolves the images."""
        return partial(_convolve, self)


def _convolve(block: Block) -> Part:
    # Kernels of longer waves reach farther.
    pixels = max((each.reached(block.bins) for each in block.convolutions), key=lambda box: box.rows * box.columns)
    sums = np.zeros((max(block.channels) + 1, pixels.rows, pixels.columns), np.float32)
    for channel, convolution, images in zip(block.channels, block.convolutions, block.images, strict=True):
        sums[channel] += convolution.forward(images, block.bins, pixels)
    return Part(pixels, sums)


def blocks_of(box: Box, most: int) -> list[Box]:
    """Cut a box into nearly square ones of about so many samples, the largest first."""
    rows = math.ceil(box.rows / math.ceil(box.rows / math.sqrt(max(most, 1))))
    columns = math.ceil(box.columns / math.ceil(box.columns * rows / max(most, rows)))
    return [
        Box(box.left + left, box.top + top, min(columns, box.columns - left), min(rows, box.rows - top))
        for top in range(0, box.rows, rows)
        for left in range(0, box.columns, columns)
    ]
