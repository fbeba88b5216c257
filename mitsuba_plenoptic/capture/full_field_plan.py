"""Sums of point spreads without shortcuts, point by point: the reference for every quicker way."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..optics.sampling import check_memory
from ..runtime.batches import BatchMap, Box, Part, PartialSum
from ..runtime.jobs import Job
from .full_field import full_field
from .patch_plan import Cost
from .pupil_weights import PupilWeights


@dataclass(frozen=True)
class _FullField:
    """One point: a batch."""

    camera: PlenopticCamera
    position: NDArray[np.float64]
    factors: NDArray[np.float32]  # of the channels
    wavelength: float
    pupil_weights: PupilWeights | None

    @property
    def samples(self) -> int:
        """Samples on the detector."""
        return math.prod(self.camera.shape)

    def prepare(self) -> Callable[[], Part]:
        """Do all of it."""
        psf = full_field(self.camera, self.position, self.wavelength, pupil_weights=self.pupil_weights)
        part = Part(_pixels(self.camera), self.factors[:, None, None] * psf)
        return lambda: part


def _pixels(camera: PlenopticCamera) -> Box:
    return Box(*camera.crop_offset, *camera.crop_size)


class FullFieldPlan:
    """The operator by full fields; parameters as of `PatchPlan`, of which `accuracy` is of no use here."""

    def __init__(
        self,
        camera: PlenopticCamera,
        points: NDArray[np.float64],
        pupil_weights: PupilWeights | None,
        wavelength: float,
        accuracy: float,
    ) -> None:
        self._camera, self._points, self._wavelength = camera, points, wavelength
        self._pupil_weights = pupil_weights

    def sum(self, weights: NDArray[np.float64]) -> FullFieldSum:
        """Return the sum of the point spreads with these weights, (n, channels), yet to be computed."""
        return FullFieldSum(self, weights)

    def batch(self, point: int, factors: NDArray[np.float32]) -> _FullField:
        """Describe the point spread of one point."""
        weights = self._pupil_weights and self._pupil_weights.take(np.array([point]))
        return _FullField(self._camera, self._points[point], factors, self._wavelength, weights)

    @property
    def box(self) -> Box:
        """The recorded pixels."""
        return _pixels(self._camera)

    def gather(self, image: NDArray[np.float32], job: Job, done: int, total: int) -> NDArray[np.float64]:
        """Return for every point the image weighted by its point spread; see `PatchPlan.gather`."""
        one, count = np.ones(1, np.float32), len(self._points)
        batches = (self.batch(point, one) for point in range(count))
        spreads = (part.sums[0] for part in job.each(batches, [1] * count, done, total))
        return np.array([np.tensordot(psf, image, 2) for psf in spreads], np.float64).reshape(-1, image.shape[2])

    def check_memory(self, batch_map: BatchMap, channels: int = 1) -> float:
        """Return the bytes of the image, or refuse them; those of the fields are judged point by point."""
        memory = 8.0 * channels * math.prod(self._camera.shape)
        check_memory(memory, f"image of {self._camera.shape[1]} x {self._camera.shape[0]} pixels")
        return memory

    def cost(self, batch_map: BatchMap) -> Cost:
        """Estimate what a sum takes from its first point."""
        count, memory = len(self._points), self.check_memory(batch_map)
        start = time.perf_counter()
        if count:
            self.batch(0, np.ones(1, np.float32)).prepare()()
        return Cost(count, count, (time.perf_counter() - start) * count, memory)


class FullFieldSum:
    """A sum of full fields; what it must offer is said in `runtime.jobs.LongSum`."""

    def __init__(self, plan: FullFieldPlan, weights: NDArray[np.float64]) -> None:
        self._plan, self._weights = plan, weights.astype(np.float32)
        self._lit = np.flatnonzero(weights.any(1))
        self.arrays: Any = np
        self.box, self.channels = plan.box, weights.shape[1]
        self.items = np.ones(len(self._lit), np.int64)

    def batches(self, first: int) -> Iterator[_FullField]:
        """Yield one batch a point."""
        return (self._plan.batch(int(point), self._weights[point]) for point in self._lit[first:])

    def image(self, total: PartialSum) -> NDArray[np.float32]:
        """Put the channels last; what a full field loses is judged where it is computed."""
        return np.ascontiguousarray(total.sums.transpose(1, 2, 0))
