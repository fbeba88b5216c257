"""Point spreads one by one, each in the pixels that it reaches."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ...optics import guards
from ...points import Copies, FullFieldPlan, PatchPlan, Recorder, Scatter
from ...runtime import Floats, Integers, Job, Part, active_backend, add


@dataclass(frozen=True)
class Spread:
    """A point spread shared by some points, in the pixels of a window of the image."""

    points: Integers
    window: tuple[slice, slice]
    pixels: Floats


class PatchSpreads(PatchPlan):
    """Point spreads of a `PatchPlan`, kept separate."""

    @property
    def pixels(self) -> int:
        """Number of pixels in the windows of the spreads of all points."""
        patterns = range(len(self._positions))
        return sum(recorder.count * len(points) for p in patterns for points, _, recorder in self._recorded(p))

    def spreads(self, job: Job, done: int, total: int) -> Iterator[Spread]:
        """Yield the spreads of all points whose light reaches the recorded window.

        `done` of the `total` points of a job are already complete.
        """
        parts = []
        for chunk in self._chunks:
            # As many of its patterns as fit into memory together, each with a channel.
            corner = self._placement.corner[chunk]
            across = int(self._placement.samples[chunk[0]])
            tile = 4.0 * float((np.ptp(corner, axis=0) + across).prod())
            # 64 MiB for the patches that are computed together.
            size = max(1, int(2**26 // tile))
            parts += [chunk[first : first + size] for first in range(0, len(chunk), size)]
        origin = np.zeros((1, 2), np.int64)
        batches = (
            Scatter(
                self._fields(members_of),
                np.full(len(members_of), self.gain**0.5),
                [Copies(origin, channel[None]) for channel in np.eye(len(members_of), dtype=np.float32)],
            )
            for members_of in parts
        )
        members = self._last - self._first
        arrived = 0.0
        items = [int(members[members_of].sum()) for members_of in parts]
        results = job.each(batches, items, done + self._count - sum(items), total)
        for members_of, spread in zip(parts, results, strict=True):
            for pattern, sums in zip(members_of.tolist(), spread.sums, strict=True):
                arrived += float(sums.sum(dtype=np.float64)) * int(members[pattern]) / self.gain
                for points, shift, recorder in self._recorded(pattern):
                    dx, dy = shift.tolist()
                    box = recorder.box
                    samples = active_backend().arrays.zeros((1, box.rows, box.columns), np.float32)
                    moved = replace(spread.box, left=spread.box.left + dx, top=spread.box.top + dy)
                    add(Part(moved, sums[None]), box, samples)
                    yield Spread(points, recorder.window, recorder.integrate(samples[0]))
        loss = self.loss(self._chunks, np.ones((self._count, 1)), arrived)
        if loss is not None:
            guards.check(guards.PATCH, loss)

    def _recorded(self, pattern: int) -> Iterator[tuple[Integers, Integers, Recorder]]:
        """Yield points, shift and pixels of each copy of a pattern that reaches recorded pixels."""
        members = slice(self._first[pattern], self._last[pattern])
        shifts, copy = np.unique(self._shifts[members], axis=0, return_inverse=True)
        for index, shift in enumerate(shifts):
            low = (self._placement.corner[pattern] + shift)[None]
            high = low + self._placement.samples[pattern]
            recorder = Recorder(self._camera, self._grid, low, high, self._recorder)
            if recorder.count:
                yield self._order[members][copy.reshape(-1) == index], shift, recorder


class FullFieldSpreads(FullFieldPlan):
    """Point spreads of a `FullFieldPlan`, kept separate."""

    @property
    def pixels(self) -> int:
        """Number of pixels of all spreads together."""
        return math.prod(self._camera.shape) * len(self._points)

    def spreads(self, job: Job, done: int, total: int) -> Iterator[Spread]:
        """Yield the spreads of all points; see `PatchSpreads.spreads`."""
        unit = np.ones(1, np.float32)
        count = len(self._points)
        window = (slice(None), slice(None))
        batches = (self.batch(point, unit) for point in range(count))
        for point, members_of in enumerate(job.each(batches, [1] * count, done, total)):
            yield Spread(np.array([point]), window, members_of.sums[0])
