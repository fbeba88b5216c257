"""The derivatives of a sum of point spreads at one wavelength, forward and in reverse."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...runtime.backend import backend
from ...runtime.batches import BatchMap, PartialSum
from ...runtime.jobs import Job
from ..patch_plan import PatchPlan
from ..pupil_weights import PupilWeights
from ..recorder import Recorder
from .batches import Pull, Push
from .numbers import MOVES, VaryingNumbers

Direction = dict[str, NDArray[np.float64]]
"""Changes of numbers, by name."""


class DerivativePlan(PatchPlan):
    """Point spreads of which each radiator has its own: those of neighbouring lenses do not change alike.

    Parameters
    ----------
    camera, points, pupil_weights, wavelength, accuracy
        As of `PatchPlan`.
    """

    def __init__(
        self,
        camera: PlenopticCamera,
        points: NDArray[np.float64],
        pupil_weights: PupilWeights | None,
        wavelength: float,
        accuracy: float,
    ) -> None:
        super().__init__(camera, points, pupil_weights, wavelength, accuracy, exact=True)
        self._wavelength = wavelength
        # The intensities of fields are sampled twice as finely as the fields.
        low, size = 2 * self._placement.corner, 2 * self._placement.samples[:, None]
        self._recorder = Recorder(camera, replace(self._grid, pitch=self._grid.pitch / 2), low, low + size)

    def push(self, weights: NDArray[np.float64], directions: list[Direction]) -> PushSum:
        """Return the changes of the sum with these weights, (n, channels), in some directions, yet to be computed."""
        return PushSum(self, weights, directions)

    def pull(
        self,
        weights: NDArray[np.float64],
        image: NDArray[np.float32],
        names: tuple[str, ...],
        job: Job,
        done: int,
        total: int,
    ) -> dict[str, NDArray[np.float64]]:
        """Return the gradients of numbers from that of the image, (rows, columns, channels).

        Parameters
        ----------
        weights : float64 array (n, channels)
            Of the radiators.
        names : tuple of str
            The numbers.
        job : Job
            Who computes, and who is told of the progress.
        done, total : int
            The radiators that are done before, and those of the whole job.
        """
        numbers = VaryingNumbers(self._camera, self._wavelength, names)
        moves = [name for name in MOVES if name in names]
        samples = np.stack([self._recorder.spread(image, name) for name in (None, *moves)])
        chunks, items = self.lit_chunks(weights)
        pulls = [self._pull(chunk, weights) for chunk in chunks]
        batches = (self._with_tile(*pull, samples) for pull in pulls)
        waiting: list[Pull] = []

        def kept() -> Iterator[Pull]:
            for batch in batches:
                waiting.append(batch)
                yield batch

        moved = np.zeros(len(moves))
        for pulled in job.each(kept(), items.tolist(), done + self._count - int(items.sum()), total):
            waiting.pop(0).gather(pulled, numbers)
            moved += pulled.moves
        gradients = numbers.gradients()
        for name, part in zip(moves, moved.tolist(), strict=True):
            gradients[name] = gradients[name] + part
        return gradients

    def _pull(self, chunk: NDArray[np.int64], weights: NDArray[np.float64]) -> tuple[NDArray[np.int64], Any]:
        given = weights[self._order[self._first[chunk]]]
        lit = given.any(1)
        return chunk[lit], given[lit].astype(np.float32)

    def _with_tile(self, chunk: NDArray[np.int64], given: NDArray[np.float32], samples: NDArray[np.float32]) -> Pull:
        """Describe a batch, with the samples that it reaches; what lies beyond the recorded ones is zero."""
        fields = self._fields(chunk)
        corner, size = fields.placement.corner, int(fields.placement.samples[0])
        return Pull(fields, given, self._tile(samples, 2 * corner.min(0), 2 * (corner.max(0) + size)))

    def check_memory(self, batch_map: BatchMap, channels: int = 1) -> float:
        """Return the bytes that derivatives take, of all channels in all directions, or refuse them."""
        return super().check_memory(batch_map, 4 * channels)


class PushSum:
    """Changes of a sum in several directions, batch by batch; what it must offer is said in `runtime.jobs.LongSum`."""

    def __init__(self, plan: DerivativePlan, weights: NDArray[np.float64], directions: list[Direction]) -> None:
        self._plan, self._weights, self._directions = plan, weights, directions
        self._chunks, self.items = plan.lit_chunks(weights)
        self.arrays: Any = backend().arrays
        self.box, self.channels = plan._recorder.box, (len(directions) + 1) * weights.shape[1]

    def batches(self, first: int) -> Iterator[Push]:
        """Yield the batches from one on, in their order."""
        plan = self._plan
        for chunk in self._chunks[first:]:
            numbers = tuple(VaryingNumbers(plan._camera, plan._wavelength, changes) for changes in self._directions)
            for varying, changes in zip(numbers, self._directions, strict=True):
                varying.set_tangents(changes)
            lit, given = plan._pull(chunk, self._weights)
            yield Push(plan._fields(lit), given, numbers)

    def image(self, total: PartialSum) -> NDArray[np.float32]:
        """Integrate over the recorded pixels, and add what their own moves change."""
        recorder, channels = self._plan._recorder, self._weights.shape[1]
        image = recorder.record(total.sums[:-channels])
        for first, changes in enumerate(self._directions):
            for name in MOVES:
                change = changes.get(name, np.zeros(1))
                if change.any():
                    moved = recorder.record(total.sums[-channels:], name)
                    image[..., first * channels : (first + 1) * channels] += float(change[0]) * moved
        return image
