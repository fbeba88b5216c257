"""Sums of point spreads by a bank: every pair of a point and a lens that it lights is a ray."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...optics.fitted_lens import FittedLens, lens_of_waves
from ...optics.sampling import check_memory
from ...runtime.batches import BatchMap, Box, Part, PartialSum, add
from ...runtime.fft import resting_drjit
from ...runtime.jobs import Job
from ..patch_plan import Cost
from ..pupil_weights import PupilWeights
from .blend import most_blur
from .convolution import Convolution
from .lens_bank import LensBank, finest_pitch
from .local_lens import local_camera, local_vergences, require_served
from .rays import Rays, Traced
from .real_rays import PassedPower, RealRays
from .table import SHADOW

_PAIRS = 2**17
"""Pairs of a point and a lens that are computed together."""

_ZONE = 8
"""Lenses across a square of the array whose points are computed together, so that their light lies close together."""

_BLUR_STEP = 1.1
"""Ratio of the blurs of points that are computed with the same lenses around."""

_ABERRATION = 1.05
"""Radius of the blur, aberrations included, over that by rays near the axis, at most."""


class BankPlan:
    """The operator by banks; parameters as of `PatchPlan`. The points must be blurred enough: see `near_weight`."""

    def __init__(
        self,
        camera: PlenopticCamera,
        points: NDArray[np.float64],
        pupil_weights: PupilWeights | None,
        wavelength: float,
        accuracy: float,
    ) -> None:
        self._camera, self._points, self._pupil_weights = camera, points, pupil_weights
        require_served(camera, wavelength)
        self._lens = lens_of_waves(camera, points, wavelength)
        vergence = self._lens.vergence(points[:, 2])
        between = local_vergences(camera, (float(vergence.min()), float(vergence.max())))
        types = range(len(camera.mla_focal_lengths))
        pitch, local = finest_pitch(camera, (wavelength,)), local_camera(camera)
        self.banks = [LensBank.learn(local, wavelength, accuracy, between, kind, pitch) for kind in types]
        self.convolution = Convolution(
            camera, [kernel for bank in self.banks for kernel in bank.kernels], pitch, order=4
        )
        self._chunks = self._sort(most_blur(camera, vergence))
        self._power = PassedPower.of(self._lens) if isinstance(self._lens, FittedLens) else None

    def _sort(self, blur: NDArray[np.float64]) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Cut the points into chunks, each with the lenses around a point's own that it may light."""
        step = np.ceil(np.log(blur) / math.log(_BLUR_STEP)).astype(np.int64)
        image = self._lens.images(self._points)
        zone = np.floor(image / (_ZONE * self._camera.mla_pitch)).astype(np.int64)
        order = np.lexsort((zone[:, 0], zone[:, 1], step))
        keys = np.column_stack([step, zone])[order]
        chunks = []
        for group in np.split(order, np.flatnonzero((np.diff(keys, axis=0) != 0).any(1)) + 1):
            blurred = _BLUR_STEP ** step[group[0]] / 2 * _ABERRATION
            around = self._camera.lattice.neighbours((blurred + SHADOW) * max(self._camera.mla_pitches))
            size = max(1, _PAIRS // len(around))
            chunks += [(group[start : start + size], around) for start in range(0, len(group), size)]
        return chunks

    def sum(self, weights: NDArray[np.float64]) -> BankSum:
        """Return the sum of the point spreads with these weights, (n, channels), yet to be computed."""
        return BankSum(self, weights)

    def rays(self, chunk: int) -> Rays | RealRays:
        """Describe the rays of a chunk."""
        points, around = self._chunks[chunk]
        if self._power is not None:
            return RealRays(self._camera, self._power, self.banks, self.convolution.pitch, self._points[points], around)
        weights = self._pupil_weights and self._pupil_weights.take(points)
        return Rays(self._camera, self.banks, self.convolution.pitch, self._points[points], around, weights)

    def points_of(self, chunk: int) -> NDArray[np.int64]:
        """Return the numbers of a chunk's points."""
        return self._chunks[chunk][0]

    def lit_chunks(self, weights: NDArray[np.float64]) -> list[int]:
        """Return the chunks that have any weight."""
        return [number for number, (points, _) in enumerate(self._chunks) if weights[points].any()]

    def gather(self, image: NDArray[np.float32], job: Job, done: int, total: int) -> NDArray[np.float64]:
        """Return for every point the image weighted by its point spread; see `PatchPlan.gather`."""
        channels = np.moveaxis(image, -1, 0)
        samples = np.stack([np.stack(list(self.convolution.adjoint(channel))) for channel in channels])
        result = np.zeros((len(self._points), len(samples)))
        batches = (_Gather(self.rays(chunk), self.convolution.box, samples) for chunk in range(len(self._chunks)))
        items = [len(points) for points, _ in self._chunks]
        for (points, _), products in zip(self._chunks, job.each(batches, items, done, total), strict=True):
            result[points] = products
        return result

    def check_memory(self, batch_map: BatchMap, channels: int = 1) -> float:
        """Return the bytes that a sum takes, or refuse them."""
        box, ranks = self.convolution.box, self.convolution.ranks
        images = 4.0 * channels * ranks * box.rows * box.columns
        memory = images + self.convolution.memory + (batch_map.threads + 1) * 16.0 * _PAIRS * (ranks * channels + 48)
        check_memory(memory, f"{len(self._points)} radiators by {ranks} images of {box.columns} x {box.rows} samples")
        return memory

    def cost(self, batch_map: BatchMap) -> Cost:
        """Estimate what a sum takes from one batch, and from one convolution."""
        memory = self.check_memory(batch_map)
        start = time.perf_counter()
        if self._chunks:
            ones = np.ones((len(self._points), 1))
            trial = BankSum(self, ones)
            middle = len(self._chunks) // 2
            with resting_drjit():
                trial.batch(middle).prepare()()  # compiles the kernels
                start = time.perf_counter()
                trial.batch(middle).prepare()()
        pairs = sum(len(points) * len(around) for points, around in self._chunks)
        points, around = self._chunks[len(self._chunks) // 2]
        seconds = (time.perf_counter() - start) * pairs / (len(points) * len(around))
        start = time.perf_counter()
        box = self.convolution.box
        blank = np.zeros((box.rows, box.columns), np.float32)
        self.convolution.forward(blank for _ in range(self.convolution.ranks))
        seconds += time.perf_counter() - start
        return Cost(len(self._points), self.convolution.ranks, seconds, memory)


class BankSum:
    """A sum by banks, batch by batch; what it must offer is said in `runtime.jobs.LongSum`."""

    def __init__(self, plan: BankPlan, weights: NDArray[np.float64]) -> None:
        self._plan, self._weights = plan, weights.astype(np.float32)
        self._lit = plan.lit_chunks(weights)
        self.items = np.array([len(plan.points_of(chunk)) for chunk in self._lit], np.int64)
        self.arrays: Any = np
        self.box, self.channels = plan.convolution.box, plan.convolution.ranks * weights.shape[1]

    def batch(self, chunk: int) -> _Scatter:
        """Describe the batch of a chunk."""
        return _Scatter(self._plan.rays(chunk), self._weights[self._plan.points_of(chunk)])

    def batches(self, first: int) -> Iterator[_Scatter]:
        """Yield the batches from one on, in their order."""
        return (self.batch(chunk) for chunk in self._lit[first:])

    def image(self, total: PartialSum) -> NDArray[np.float32]:
        """Convolve the images of every channel."""
        images = total.sums.reshape(-1, self._plan.convolution.ranks, *total.sums.shape[1:])
        return np.stack([self._plan.convolution.forward(each) for each in images], axis=-1)


@dataclass(frozen=True)
class _Scatter:
    """Rays to be added, with weights (points, channels)."""

    rays: Rays | RealRays
    weights: NDArray[np.float32]

    @property
    def samples(self) -> int:
        """Coefficients of all rays."""
        return self.rays.samples

    def prepare(self) -> Callable[[], Part]:
        """Trace the rays, and return the function that adds what they bring."""
        return partial(_add, self.rays.trace(), self.weights)


def _add(traced: Traced, weights: NDArray[np.float32]) -> Part:
    box = traced.box
    shares = traced.shares(box)
    images = [shares @ (traced.coefficients * factor[traced.point][:, None]) for factor in weights.T]
    return Part(box, np.concatenate([image.T.reshape(-1, box.rows, box.columns) for image in images]))


@dataclass(frozen=True)
class _Gather:
    """Rays to be multiplied with images, (channels, ranks, rows, columns), of the samples of a box."""

    rays: Rays | RealRays
    box: Box
    images: NDArray[np.float32]

    @property
    def samples(self) -> int:
        """Coefficients of all rays."""
        return self.rays.samples

    def prepare(self) -> Callable[[], NDArray[np.float64]]:
        """Trace the rays, and return the function that multiplies what they bring."""
        return partial(_multiply, self.rays.trace(), self.box, self.images, len(self.rays.points))


def _multiply(traced: Traced, box: Box, images: NDArray[np.float32], count: int) -> NDArray[np.float64]:
    reached = traced.box
    result = np.empty((count, len(images)))
    shares = traced.shares(reached).T.tocsr()
    for channel, image in enumerate(images):
        tile = np.zeros((len(image), reached.rows, reached.columns), np.float32)
        add(Part(box, image), reached, tile)
        brought = (shares @ tile.reshape(len(image), -1).T) * traced.coefficients
        result[:, channel] = np.bincount(traced.point, brought.sum(1, dtype=np.float64), count)
    return result
