"""Work in batches of plain arrays that any thread, process or machine can compute, used in a fixed order.

The result of a batch is the same whoever computes it. The parts of a sum are added one after another in the order of
their batches, so its bits depend on the inputs alone, and a sum that was stopped after some batch and is continued from
there has the bits of one that was not.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .backend import backend
from .fft import resting_drjit, worker_count


@dataclass(frozen=True)
class Box:
    """A rectangle of a grid: first sample and size, along x and y."""

    left: int
    top: int
    columns: int
    rows: int

    @classmethod
    def between(cls, low: NDArray[np.int64], high: NDArray[np.int64]) -> Box:
        """Make the rectangle of two corners, the second one outside."""
        return cls(*(int(number) for number in (*low, *(high - low))))


@dataclass(frozen=True)
class Part:
    """The sum of one batch."""

    # Where it lies on the grid.
    box: Box
    # The sum there, on the backend's device; it is zero elsewhere; (channels, rows, columns).
    sums: NDArray[np.float32]


class Batch(Protocol):
    """A part of some work that is still to be done. Holds plain arrays and can be pickled."""

    @property
    def samples(self) -> int:
        """Samples of all its fields, to which the time is about proportional."""

    def prepare(self) -> Callable[[], Any]:
        """Run what Dr.Jit does, and return the rest: a function that any thread may call for the batch's result."""


class BatchMap(Protocol):
    """Computes batches and yields their results in the order of the batches.

    It must take the batches as it needs them and keep few results waiting, so that memory does not grow with the work.
    """

    @property
    def workers(self) -> int:
        """Batches that are computed at a time."""

    @property
    def threads(self) -> int:
        """How many of them are computed in this process."""

    def __call__(self, batches: Iterable[Batch]) -> Generator[Any, None, None]:
        """Compute the batches; closed early, it drops what is under way."""


@dataclass(frozen=True)
class PartialSum:
    """A sum under way."""

    # The batches that are in it: the first ones.
    batches: int
    # Their sum, on the backend's device; (channels, rows, columns).
    sums: NDArray[np.float32]
    # All samples of their parts added up, those beyond the box of the sum too.
    arrived: float = 0.0


class Threads:
    """Computes batches on threads of this process."""

    def __init__(
        self,
        # Default: all cores that this process may use. A CUDA device takes its work from one.
        count: int | None = None,
    ) -> None:
        self.workers = self.threads = 1 if backend().is_cuda else count or worker_count()

    def __call__(self, batches: Iterable[Batch]) -> Generator[Any, None, None]:
        """Compute the batches, a few ahead of the one that is due."""
        pending: deque[Future[Any]] = deque()
        with resting_drjit(), ThreadPoolExecutor(self.threads) as pool:
            for batch in batches:
                pending.append(pool.submit(batch.prepare()))
                if len(pending) > self.threads:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()


def add(part: Part, box: Box, sums: NDArray[np.float32]) -> None:
    """Add a part to a sum, (channels, rows, columns), that covers a box of the grid."""
    left, top = max(box.left, part.box.left), max(box.top, part.box.top)
    right = min(box.left + box.columns, part.box.left + part.box.columns)
    bottom = min(box.top + box.rows, part.box.top + part.box.rows)
    if left < right and top < bottom:
        sums[:, top - box.top : bottom - box.top, left - box.left : right - box.left] += part.sums[
            :, top - part.box.top : bottom - part.box.top, left - part.box.left : right - part.box.left
        ]
