"""Long sums: who computes their batches, who is notified of the progress, and where partial results are stored."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import refuse_if
from .batches import Batch, BatchMap, Box, PartialSum, Threads, add

Progress = Callable[[int, int], None]
"""Called with the items done and how many there are."""

Item = TypeVar("Item")


def counted(items: Collection[Item], progress: Progress | None) -> Iterator[Item]:
    """Yield items, and report the number of finished ones before each and at the end."""
    for done, item in enumerate(items):
        if progress:
            progress(done, len(items))
        yield item
    if progress:
        progress(len(items), len(items))


class LongSum(Protocol):
    """A sum of many items on a box of some grid, gathered into batches."""

    arrays: Any  # NumPy, or CuPy for parts that lie on a CUDA device
    box: Box
    channels: int
    items: NDArray[np.int64]  # of each batch

    def batches(self, first: int) -> Iterator[Batch]:
        """Yield the batches from one on, in their order."""

    def image(self, total: PartialSum) -> NDArray[np.float32]:
        """Turn the finished sum into (rows, columns, channels) of pixels."""


@dataclass(frozen=True)
class SumTask:
    """One of several sums of batches that make an image."""

    # Its items, those too that are in no batch.
    items: int
    # Plans the sum, once it is its turn.
    plan: Callable[[], LongSum]
    # Turns its image into what is added to that of all: (rows, columns, channels).
    combine: Callable[[NDArray[np.float32]], NDArray[np.float32]]


@dataclass(frozen=True)
class Snapshot:
    """State of several sums in progress, for a checkpoint."""

    sums: int
    # Their images, added up; (rows, columns, channels).
    image: NDArray[np.float32]
    # The next one, as far as it has come.
    partial: PartialSum | None = None


class CheckpointStore(Protocol):
    """Stores the partial result of a job, so that it can resume after a crash: see `io.checkpoints.Checkpoint`."""

    def begin(self, shape: tuple[int, ...], **facts: Any) -> Snapshot | None:
        """Return the stored partial result of the job with these facts or None; refuse that of another job."""

    def save(self, snapshot: Snapshot) -> None:
        """Keep a snapshot, if it is time to."""


@dataclass
class Job:
    """Execution of a long computation: workers, progress and checkpoint.

    Attributes
    ----------
    progress : callable, optional
        Called with the items done and how many there are.
    batch_map : BatchMap, optional
        Computes the batches. Default: threads of this process.
    keeper : CheckpointStore, optional
        Stores what is done.
    """

    progress: Progress | None = None
    batch_map: BatchMap | None = None
    keeper: CheckpointStore | None = None

    @property
    def workers(self) -> BatchMap:
        """Map that computes batches: the given one, or threads of this process."""
        return self.batch_map or Threads()

    def run(
        self,
        tasks: Iterable[SumTask],
        shape: tuple[int, int, int],
        items: int,
        facts: Callable[[], dict[str, Any]] = dict,
    ) -> NDArray[np.float32]:
        """Compute sums one after another, and add their images.

        The bits of the result depend neither on who computes the batches nor on whether the job was continued.

        Parameters
        ----------
        tasks : iterable of SumTask
            The sums.
        shape : (int, int, int)
            Rows, columns and channels of the image.
        items : int
            Items of all sums.
        facts : callable
            Returns what the job is computed from, in plain JSON values, by which a stored one is recognised as the
            same.

        Returns
        -------
        float32 array (rows, columns, channels)
        """
        state = Snapshot(0, np.zeros(shape, np.float32))
        if self.keeper:
            state = self.keeper.begin(shape, **facts()) or state
        done = count = 0
        for count, task in enumerate(tasks, 1):
            if count > state.sums:
                image = task.combine(self._sum(task, state, done, items))
                state = Snapshot(count, np.add(state.image, image, out=state.image))
            done += task.items
        refuse_if(state.sums > count, f"checkpoint: it is damaged: {state.sums} sums are no part of {count}")
        return state.image

    def _sum(self, task: SumTask, state: Snapshot, before: int, items: int) -> NDArray[np.float32]:
        """Return one sum, continued from its state."""
        work = task.plan()
        shape = (work.channels, work.box.rows, work.box.columns)
        start = state.partial or PartialSum(0, work.arrays.zeros(shape, np.float32))
        refuse_if(
            start.sums.shape != shape or not 0 <= start.batches <= len(work.items),
            f"checkpoint: {start.batches} batches of shape {start.sums.shape}: this sum has {len(work.items)} of "
            f"shape {shape}",
        )
        left = work.items[start.batches :].tolist()
        total = replace(start, sums=work.arrays.asarray(start.sums))
        batches, done = work.batches(start.batches), before + task.items - sum(left)
        with contextlib.closing(self.each(batches, left, done, items)) as parts:
            for part in parts:
                add(part, work.box, total.sums)
                arrived = total.arrived + float(part.sums.sum(dtype=np.float64))
                total = PartialSum(total.batches + 1, total.sums, arrived)
                if self.keeper:
                    self.keeper.save(replace(state, partial=total))
        return work.image(total)

    def each(self, batches: Iterable[Batch], items: Sequence[int], done: int, total: int) -> Generator[Any, None, None]:
        """Compute batches of `size` items each, and yield their results in order.

        Parameters
        ----------
        batches : iterable of Batch
            The batches.
        items : sequence of int
            How many items each of them stands for.
        done, total : int
            The items that are done before, and those of the whole job.
        """
        self._report(done, total)
        with contextlib.closing(self.workers(batches)) as results:
            for count, result in zip(items, results, strict=True):
                yield result
                done += int(count)
                self._report(done, total)

    def _report(self, done: int, items: int) -> None:
        if self.progress:
            self.progress(done, items)
