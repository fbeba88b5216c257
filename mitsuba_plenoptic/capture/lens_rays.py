r"""What is out of focus, at the price of rays: one ray from each detector point through the centre of each lens.

Out of focus, a scene point sends light through one microlens into a spot around the place where its ray through the
centre of that lens meets the detector. Spots are sums of a few kernels (see `bank`), so that the capture is

.. math:: I = \sum_r k_r * \left[ c_r(P, v) \, L \right]

with the radiance L that the ray from a detector point through a lens's centre finds in the scene, the point P where it
passes the pupil, and the vergence v of the image of what it meets. Each ray brings its own radiance: nothing need be
known of how a scene point shines over the pupil, nor of what hides it.
"""

from __future__ import annotations

import itertools
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
from ..optics.main_lens import ThinLens
from ..runtime.batches import Box, Part, PartialSum
from ..runtime.fft import busy_drjit
from .bank import Convolution, LensBank, near_weight
from .sight import Sight

_BAND_BYTES = 2**29
"""Memory of the images of one band of detector rows."""

_LANES, _BINS = 2**21, 2**18
"""Rays that are traced at once, and bins of a strip, about."""

_RIM = 1.1
"""Distance from the axis in the pupil, in its radii, beyond which fewer rays are traced."""

_FEWER = 16
"""By how much fewer."""

_TRIAL, _TRIAL_BINS, _TRIALS = 512, 2**17, 3
"""Pixels across whose convolution, and bins whose rays are timed for an estimate; how often those are."""

_RAY_BYTES = 200
"""Memory of a ray, about."""

_JITTER = (0.7548776662466927, 0.5698402909980532)
"""Steps of the R2 sequence (Roberts 2018) from sample to sample of a bin."""


class LensRaySum:
    """The part of a capture that a kernel bank records, band of detector rows by band; a `runtime.jobs.LongSum`.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera; its recorded window may be a crop.
    sight : Sight
        Finds the light along rays.
    banks : sequence of sequence of LensBank
        For each channel, for each lens type.
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
        ranks = sum(bank.rank for of_channel in banks for bank in of_channel)
        band = max(1, _BAND_BYTES // (4 * ranks * columns * self._parts**2))
        self._tops = list(range(0, rows, math.ceil(rows / math.ceil(rows / band))))
        self.items = np.diff([*self._tops, rows]) * columns
        # The aberrations of the parabolic phase that waves pass displace the spots.
        self._lens = ThinLens(camera.focal_length, camera.aperture_radius, camera.mla_distance, "parabolic")

    def batches(self, first: int) -> Iterator[Band]:
        """Trace the rays of the bands from one on, and yield what is left to do."""
        strips: dict[int, list[NDArray[np.float32]]] = {}
        for band in range(first, len(self._tops)):
            camera = self._band(band)
            box = Box(0, self._tops[band], self.box.columns, camera.shape[0])
            convolutions = [Convolution(camera, banks, order=1) for banks in self._banks]
            # The threads that compute the batches have put Dr.Jit's own to rest.
            with busy_drjit():
                images = self._images([convolution.box for convolution in convolutions], box, strips)
            yield Band(box, images, convolutions)

    def _band(self, band: int) -> PlenopticCamera:
        """Return the camera cropped to a band."""
        (left, top), columns = self._camera.crop_offset, self.box.columns
        rows = int(self.items[band]) // columns
        return self._camera.replace(crop_offset=(left, top + self._tops[band]), crop_size=(columns, rows))

    def image(self, total: PartialSum) -> NDArray[np.float32]:
        """Return the sum of all bands."""
        return np.ascontiguousarray(np.moveaxis(total.sums, 0, -1))

    @cached_property
    def _candidates(self) -> NDArray[np.int64]:
        """Lenses that can light a detector bin, in steps from that of its chief ray."""
        camera = self._camera
        scale = camera.detector_distance / (camera.mla_distance + camera.detector_distance)
        return camera.lattice.neighbours(self._widest * scale)

    def cost(self) -> tuple[float, float]:
        """Estimate the time, in seconds, from some of the rays and squares, and tell the bytes that it takes."""
        bands = [self._band(band) for band in range(len(self._tops))]
        # A part of the middle band whose convolution is a few squares.
        rows, columns = (min(size, _TRIAL) for size in bands[len(bands) // 2].shape)
        trial = bands[len(bands) // 2].replace(crop_size=(columns, rows))
        start = time.perf_counter()
        convolutions = [Convolution(trial, banks, order=1) for banks in self._banks]
        made = time.perf_counter() - start
        start = time.perf_counter()
        for convolution in convolutions:
            blank = np.zeros((convolution.box.rows, convolution.box.columns), np.float32)
            convolution.forward(itertools.repeat(blank, convolution.ranks))
        convolved = (time.perf_counter() - start) * math.prod(self._camera.shape) / (rows * columns)

        margin = max(convolution.box.rows for convolution in convolutions) - rows * self._parts
        sizes = [math.prod(size * self._parts + margin for size in band.shape) for band in bands]
        images = 4.0 * sum(convolution.ranks for convolution in convolutions) * max(sizes)
        # Bands share the bins of their margins.
        bins = math.prod(size * self._parts + margin for size in self._camera.shape)
        memory = 2 * images + sum(convolution.memory for convolution in convolutions) + _RAY_BYTES * _LANES
        return made * len(bands) + convolved + bins * self._seconds_per_bin(), memory

    def _seconds_per_bin(self) -> float:
        """Time the rays of some rows of bins, evenly over the detector."""
        left, top = (offset * self._parts for offset in self._camera.crop_offset)
        rows, columns = (size * self._parts for size in self._camera.shape)
        box = Box(left, top, columns, rows)
        lines = min(rows, max(1, _TRIAL_BINS // columns))
        index = dr.arange(mi.UInt32, lines * columns)
        bins = index + index // columns * ((rows // lines - 1) * columns)
        times = []
        with busy_drjit():
            dr.eval(bins)
            # The first compile the kernels, of which light paths of other lengths need others.
            for seed in range(_TRIALS):
                start = time.perf_counter()
                sums = self._trace_bins(box, bins, self._candidates, np.random.SeedSequence(seed))
                # What strips and bands are gathered in
                [np.stack([part.numpy() for part in parts]).copy() for parts in sums]
                times.append(time.perf_counter() - start)
        seconds = min(times)
        return seconds / (lines * columns)

    @property
    def _parts(self) -> int:
        """Bins across a pixel."""
        return round(self._camera.pixel_size / self._pitch)

    @property
    def _rim(self) -> float:
        """Distance from the axis in the pupil beyond which fewer rays are traced."""
        return min(_RIM * self._camera.aperture_radius, self._widest)

    @property
    def _few(self) -> int:
        """How many rays to each bin and lens are traced there."""
        return -(-self._spp // _FEWER)

    @cached_property
    def _widest(self) -> float:
        """Distance from the axis in the pupil beyond which no ray counts."""
        return max(bank.widest for of_channel in self._banks for bank in of_channel)

    def _images(
        self, boxes: list[Box], band: Box, strips: dict[int, list[NDArray[np.float32]]]
    ) -> list[NDArray[np.float32]]:
        """Trace the rays of a band; return for each channel the images (ranks, rows, columns) of its box.

        Strips of bins that the next band needs, too, are kept, and those that the last one left are taken.
        """
        widest = max(boxes, key=lambda box: box.columns)
        # The strips are those of all bands together, so that they are the same wherever a sum goes on.
        top = widest.top - band.top * self._parts
        bottom = top + widest.rows + (self.box.rows - band.rows) * self._parts
        height = -(-_BINS // widest.columns)
        after = widest.top + band.rows * self._parts
        ranks = [sum(bank.rank for bank in banks) for banks in self._banks]
        images = [np.empty((rank, widest.rows, widest.columns), np.float32) for rank in ranks]
        for number in range((widest.top - top) // height, -(-(widest.top + widest.rows - top) // height)):
            low, high = top + number * height, min(top + (number + 1) * height, bottom)
            strip = strips.pop(number, None) or self._strip(Box(widest.left, low, widest.columns, high - low), number)
            first, last = max(low, widest.top), min(high, widest.top + widest.rows)
            for image, part in zip(images, strip, strict=True):
                image[:, first - widest.top : last - widest.top] = part[:, first - low : last - low]
            if high > after:
                strips[number] = strip
        return [
            image[:, box.top - widest.top :, box.left - widest.left :][:, : box.rows, : box.columns]
            for image, box in zip(images, boxes, strict=True)
        ]

    def _strip(self, box: Box, number: int) -> list[NDArray[np.float32]]:
        """Trace the rays of a strip; return for each channel (ranks, rows, columns)."""
        seeds = np.random.SeedSequence([self._seed, number])
        sums = self._trace_bins(box, dr.arange(mi.UInt32, box.rows * box.columns), self._candidates, seeds)
        return [np.stack([part.numpy().reshape(box.rows, box.columns) for part in parts]) for parts in sums]

    def _trace_bins(
        self, box: Box, bins: Any, candidates: NDArray[np.int64], seeds: np.random.SeedSequence
    ) -> list[list[Any]]:
        """Trace the rays of some bins through lenses near them; return what they bring of each kernel."""
        count = dr.width(bins)
        sums = [[dr.zeros(mi.Float, count) for bank in banks for _ in range(bank.rank)] for banks in self._banks]
        dr.eval(bins, sums)
        for steps in candidates:
            (Px, Py), _, _ = self._pupil_points(box, bins, steps)
            square = Px * Px + Py * Py
            inner = square < self._rim**2
            # Beyond the rim there is little light, for which few rays do.
            for kept, spp in ((inner, self._spp), (~inner & (square < self._widest**2), self._few)):
                lit = dr.compress(kept)
                step = max(1, _LANES // spp)
                for start in range(0, dr.width(lit), step):
                    seed = int(seeds.spawn(1)[0].generate_state(1)[0])
                    some = dr.gather(
                        mi.UInt32,
                        lit,
                        dr.opaque(mi.UInt32, start) + dr.arange(mi.UInt32, min(step, dr.width(lit) - start)),
                    )
                    brought = self._trace_lit(box, dr.gather(mi.UInt32, bins, some), steps, spp, seed)
                    for targets, parts in zip(sums, brought, strict=True):
                        for target, part in zip(targets, parts, strict=True):
                            # Every bin is in it once.
                            dr.scatter_reduce(dr.ReduceOp.Add, target, part, some, mode=dr.ReduceMode.NoConflicts)
                    dr.eval(sums)
        return sums

    def _pupil_points(
        self, box: Box, bins: Any, steps: NDArray[np.int64], jitter: Any = None
    ) -> tuple[tuple[Any, Any], tuple[Any, Any], Any]:
        """Return where rays through the centre of a lens near the bins' own pass the pupil; slopes; lens types."""
        camera, lattice = self._camera, self._camera.lattice
        b, z = camera.mla_distance, self._banks[0][0].arrival
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
        (Px, Py, _), slope, _ = self._lens.trace(centre, slope)
        return (Px, Py), slope, lattice.lens_type(i, j) if len(self._banks[0]) > 1 else None

    def _counts(self, pupil: tuple[Any, Any], distance: Any) -> Any:
        """Whether what rays meet at some distances is out of focus, and brings light where they pass the pupil."""
        vergence = self._lens.vergence(distance)
        return (near_weight(self._camera, vergence, self._accuracy) < 1) & (
            dr.hypot(*pupil) < self._camera.aperture_radius + self._banks[0][0].reach(vergence)
        )

    def _trace_lit(self, box: Box, bins: Any, steps: NDArray[np.int64], spp: int, seed: int) -> list[list[Any]]:
        """Trace the rays of some bins through one of the lenses near them; return what they bring of each kernel."""
        lane = dr.arange(mi.UInt32, dr.width(bins) * spp)
        own, sample = dr.gather(mi.UInt32, bins, lane // spp), mi.Float(lane % spp)
        shift = dr.opaque(mi.UInt32, seed)
        # Every bin has a shift of its own, so that neighbours are not jittered alike.
        jitter = mi.Point2f(
            *(sample * step + mi.sample_tea_float32(own, shift ^ axis) for axis, step in enumerate(_JITTER))
        )
        pupil, slope, lens_type = self._pupil_points(box, own, steps, jitter - dr.floor(jitter))
        radiance, distance = self._sight.look((*pupil, 0.0), slope, seed, partial(self._counts, pupil))
        vergence = self._lens.vergence(distance)
        finite = dr.all([dr.isfinite(light) for light in radiance], axis=0)
        dr.eval(radiance, vergence, pupil, finite)
        if not dr.all(finite):
            raise InputError("scene: the radiance of some rays is NaN or infinite: all must be finite")
        # A pixel is the mean of its bins, of which the convolution takes the sum.
        part = (self._pitch / self._camera.pixel_size) ** 2 / spp
        weight = (1 - near_weight(self._camera, vergence, self._accuracy)) * part
        sums = []
        for light, banks in zip(radiance, self._banks, strict=True):
            brought: list[Any] = []
            for number, bank in enumerate(banks):
                kept = weight * light if lens_type is None else dr.select(lens_type == number, weight * light, 0)
                brought += [coefficient * kept for coefficient in bank.coefficients(*pupil, vergence)]
            sums.append([dr.block_sum(samples, spp) for samples in brought])
        dr.eval(sums)
        return sums


@dataclass(frozen=True)
class Band:
    """The images of a band of pixels, to be convolved with the kernels.

    Attributes
    ----------
    box : Box
        The pixels.
    images : list of float32 arrays (ranks, rows, columns)
        For each channel.
    convolutions : list of Convolution
        For each channel.
    """

    box: Box
    images: list[NDArray[np.float32]]
    convolutions: list[Convolution]

    @property
    def samples(self) -> int:
        """Samples of all images."""
        return sum(image.size for image in self.images)

    def prepare(self) -> Callable[[], Part]:
        """Return the function that convolves the images."""
        return partial(_convolve, self)


def _convolve(band: Band) -> Part:
    pairs = zip(band.convolutions, band.images, strict=True)
    return Part(band.box, np.stack([convolution.forward(images) for convolution, images in pairs]))
