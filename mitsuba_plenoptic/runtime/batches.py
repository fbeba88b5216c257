"""Long sums in batches of plain arrays, which any thread, process or machine can compute, added in a fixed order.

Results do not depend on where a batch is computed: in threads of this process, or by the workers of a Dask cluster, to
which only arrays are sent. The parts of a sum are added in the order of their batches, so its bits depend on the inputs
alone, and a sum that was stopped and continued has the bits of an uninterrupted one. Different processors may round
differently, and the threads of a CUDA device add in an order of their own.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import gc
import logging
import multiprocessing
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextvars import ContextVar
from dataclasses import dataclass, replace
from types import MappingProxyType, TracebackType
from typing import Any, Protocol, Self, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import InputError, argument, refuse_if, refusing, require_count, require_module
from .backend import Array, Floats, Integers, active_backend, on_cuda, set_variant
from .fft import resting_drjit, stop_threads, worker_count
from .limits import memory_asked, single_threaded_blas, software


@dataclass(frozen=True)
class Box:
    """A rectangle of a grid: first sample and number of samples, along x and y."""

    left: int
    top: int
    columns: int
    rows: int

    @classmethod
    def between(cls, low: Integers, high: Integers) -> Box:
        """Return the rectangle between two corners, the second one excluded."""
        return cls(*(int(corner) for corner in (*low, *(high - low))))

    def within(self, margin: int) -> Self:
        """Return the rectangle with a margin on all sides."""
        left, top = self.left - margin, self.top - margin
        return replace(self, left=left, top=top, columns=self.columns + 2 * margin, rows=self.rows + 2 * margin)


@dataclass(frozen=True)
class Part:
    """Sum of one batch, with its position in the image."""

    # Where it lies on the grid.
    box: Box
    # The sum there, on the backend's device; it is zero elsewhere; (channels, rows, columns).
    sums: Floats

    @property
    def samples(self) -> int:
        """Number of samples, as that of a `Batch` that is computed already."""
        return self.sums.size

    def prepare(self) -> Callable[[], Part]:
        """Return the function that returns the part; see `Batch`."""
        return lambda: self


class Batch(Protocol):
    """A part of some work still to be done; it holds plain arrays and can be pickled."""

    @property
    def samples(self) -> int:
        """Number of samples of all fields of the batch, to which its time is about proportional."""

    def prepare(self) -> Callable[[], Any]:
        """Run the Dr.Jit part of a batch; return a function, for any thread, that computes the batch's result."""


class BatchMap(Protocol):
    """Computes batches and yields their results in the order of the batches.

    It must request batches only as needed and keep few results waiting, so that memory does not grow with the work.
    """

    @property
    def workers(self) -> int:
        """Number of batches computed at a time."""

    @property
    def threads(self) -> int:
        """Number of batches computed at a time in this process."""

    def __call__(self, batches: Iterable[Batch]) -> Generator[Any, None, None]:
        """Yield the results of batches; if closed early, drop batches in progress."""


@dataclass(frozen=True)
class PartialSum:
    """Sum of the batches computed so far."""

    # The batches that are in it: the first ones.
    batches: int
    # Their sum, on the backend's device; (channels, rows, columns).
    sums: Floats
    # All samples of their parts added up, those beyond the box of the sum too.
    arrived: float = 0.0


class Threads:
    """Computes batches on threads of this process."""

    def __init__(
        self,
        # Default: the cores that this process may use, up to a number. A CUDA device takes its work from one.
        count: int | None = None,
    ):
        # Threads that batches are computed on by default: each takes memory, and Dr.Jit's part is done by one of them.
        self.workers = self.threads = 1 if active_backend().is_cuda else count or min(worker_count(), 16)

    def __call__(self, batches: Iterable[Batch]) -> Generator[Any, None, None]:
        """Yield the results of batches, computed a few ahead of the next one due; on CUDA, by the calling thread."""
        if active_backend().is_cuda:
            yield from (batch.prepare()() for batch in batches)
            return
        pending: deque[Future[Any]] = deque()
        with resting_drjit(), ThreadPoolExecutor(self.threads) as pool:
            for batch in batches:
                pending.append(pool.submit(batch.prepare()))
                # What is done is not held back, so that a checkpoint can have it.
                while len(pending) > self.threads or (pending and pending[0].done()):
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()


def on_all_cores(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Return a function's results for items, from a thread for each core; linear algebra stays on these threads.

    A CUDA device takes its work from the calling thread.
    """
    if on_cuda():
        return [function(item) for item in items]
    with single_threaded_blas(), ThreadPoolExecutor(worker_count()) as pool:
        return list(pool.map(function, items))


def add(partial_sum: Part, box: Box, sums: Floats) -> None:
    """Add a part to a sum (channels, rows, columns) that covers a box of the grid."""
    left = max(box.left, partial_sum.box.left)
    top = max(box.top, partial_sum.box.top)
    right = min(box.left + box.columns, partial_sum.box.left + partial_sum.box.columns)
    bottom = min(box.top + box.rows, partial_sum.box.top + partial_sum.box.rows)
    if left < right and top < bottom:
        sums[:, top - box.top : bottom - box.top, left - box.left : right - box.left] += partial_sum.sums[
            :,
            top - partial_sum.box.top : bottom - partial_sum.box.top,
            left - partial_sum.box.left : right - partial_sum.box.left,
        ]


Progress = Callable[[int, int], None]
"""Called with the numbers of items done and of all items."""

Item = TypeVar("Item")
Result = TypeVar("Result")


def counted(items: Collection[Item], progress: Progress | None) -> Iterator[Item]:
    """Yield items; report before each, and at the end, how many are done."""
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
    items: Integers  # of each batch

    def batches(self, first: int) -> Iterator[Batch]:
        """Yield the batches in order, from index `first` on."""

    def image(self, total: PartialSum) -> Floats:
        """Return the pixels (rows, columns, channels) of a finished sum."""


@dataclass(frozen=True)
class SumTask:
    """One of several sums that are added to make an image."""

    # Its items, those too that are in no batch.
    items: int
    # Plans the sum, once it is its turn.
    plan: Callable[[], LongSum]
    # Turns its image into what is added to that of all: (rows, columns, channels).
    combine: Callable[[Floats], Floats]


@dataclass(frozen=True)
class Snapshot:
    """State of several sums in progress."""

    sums: int
    # Their images, added up; (rows, columns, channels).
    image: Floats
    # The next one, as far as it has come.
    partial: PartialSum | None = None


class CheckpointStore(Protocol):
    """Stores the partial result of a job, so that it can resume after a crash: see `io.checkpoints.Checkpoint`."""

    def begin(self, shape: tuple[int, ...], **facts: Any) -> Snapshot | None:
        """Return the stored result of the job with these facts, or functions of them, or None; refuse another job's."""

    def save(self, snapshot: Snapshot) -> None:
        """Store a snapshot if the time since the last one is long enough."""


prepared: ContextVar[Callable[[Any, Callable[[], Array]], Array]] = ContextVar(
    "prepared", default=lambda key, make: make()
)
"""Function of a key that returns an array that takes long to make, stored in a checkpoint within its context."""


@dataclass
class Job:
    """How a long computation is carried out: workers, progress and checkpoint.

    Attributes
    ----------
    progress : callable, optional
        Called with the numbers of items done and of all items.
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
        """The given workers, or threads of this process."""
        return self.batch_map or Threads()

    def run(
        self,
        tasks: Iterable[SumTask],
        shape: tuple[int, int, int],
        items: int,
        facts: Mapping[str, Any] = MappingProxyType({}),
    ) -> Floats:
        """Return the sum of the images of several sums, computed one after another.

        The bits of the result depend neither on the workers nor, except on CUDA, on whether the job was resumed.

        Parameters
        ----------
        tasks : iterable of SumTask
            The sums.
        shape : (int, int, int)
            Rows, columns and channels of the image.
        items : int
            Items of all sums.
        facts : mapping of str
            The data that determine the job, by which a stored job is recognised: plain JSON values, or functions that
            return such values when they are needed.

        Returns
        -------
        float32 array (rows, columns, channels)
        """
        state = Snapshot(0, np.zeros(shape, np.float32))
        if self.keeper:
            state = self.keeper.begin(shape, **facts) or state
        done = count = 0
        for count, task in enumerate(tasks, 1):
            if count > state.sums:
                image = task.combine(self._sum(task, state, done, items))
                state = Snapshot(count, np.add(state.image, image, out=state.image))
                # The next sum has arrays of other sizes.
                active_backend().release()
            done += task.items
        refuse_if(state.sums > count, f"checkpoint: it is damaged: {state.sums} sums are no part of {count}")
        return state.image

    def _sum(self, task: SumTask, state: Snapshot, before: int, items: int) -> Floats:
        """Return the image of one sum, computed from its stored state on."""
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
        batches = work.batches(start.batches)
        done = before + task.items - sum(left)
        with contextlib.closing(self.each(batches, left, done, items)) as parts:
            for batch_sum in parts:
                add(batch_sum, work.box, total.sums)
                arrived = total.arrived + float(batch_sum.sums.sum(dtype=np.float64))
                total = PartialSum(total.batches + 1, total.sums, arrived)
                if self.keeper:
                    self.keeper.save(replace(state, partial=total))
        return work.image(total)

    def each(self, batches: Iterable[Batch], items: Sequence[int], done: int, total: int) -> Generator[Any, None, None]:
        """Yield the results of batches of `items` items each, in order.

        Parameters
        ----------
        batches : iterable of Batch
            The batches.
        items : sequence of int
            Number of items in each batch.
        done, total : int
            Items done before, and items of the whole job.
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


_GROUP_SAMPLES = 2**22
"""Samples of the fields that a worker computes at a time, some tenths of a second: more than sending them costs."""

_AHEAD = 3
"""Groups in progress for each worker, so that none is idle and memory stays bounded."""

_PATIENCE = "20s"

_lock = threading.Lock()


async def _greet(address: str) -> None:
    """Raise an error if no scheduler answers at an address."""
    from distributed import Security
    from distributed.comm import connect

    # Other programs say nothing, for which Dask waits, or what Dask takes for lengths.
    with refusing("what listens there is no scheduler", MemoryError, asyncio.TimeoutError):
        reached = await asyncio.wait_for(connect(address, timeout=5, **Security().get_connection_args("client")), 6)
    reached.abort()


class Cluster:
    """Workers that compute the batches of wave captures, for the argument `batch_map` of `render_capture`.

    Use it as a context: on entry it starts local processes or connects to a scheduler; on exit it ends what it has
    started. The batches of a worker that dies are computed again by another worker. Workers run whatever the scheduler
    sends them, so both must be in a trusted network. A script that starts local processes must not run when it is
    imported: put its code under ``if __name__ == "__main__":``.

    Parameters
    ----------
    workers : int, optional
        Number of processes of one thread each on this machine.
    scheduler : str, optional
        Address of a running Dask scheduler, instead of `workers`, such as ``tcp://10.0.0.1:8786``.

    Raises
    ------
    InputError
        If not exactly one of the two is given or, on entering, the workers cannot be started or reached, or have other
        software.
    """

    threads = 0

    def __init__(self, *, workers: int | None = None, scheduler: str | None = None):
        refuse_if((workers is None) == (scheduler is None), "workers, scheduler: give one of the two")
        self._count = None if workers is None else require_count("workers", workers, maximum=1024)
        self._scheduler = scheduler
        self._open = contextlib.ExitStack()
        self._client: Any = None

    def __enter__(self) -> Cluster:
        if getattr(multiprocessing.current_process(), "_inheriting", False):
            # A worker imports a script that would start workers: it ends, and the script is told why.
            raise SystemExit(1)
        distributed = require_module("distributed", "workers: they need dask.distributed: pip install distributed")
        failure = ""
        with contextlib.ExitStack() as opened:
            # Dask would log tracebacks of errors that are reported anyway.
            logger = logging.getLogger("distributed.client")
            opened.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL + 1)
            try:
                address = self._scheduler
                if self._scheduler:
                    # In a thread, as notebooks have a loop. Clients would go on trying where nobody answers.
                    with ThreadPoolExecutor(1) as pool:
                        pool.submit(asyncio.run, _greet(self._scheduler)).result()
                else:
                    address = opened.enter_context(
                        distributed.LocalCluster(
                            n_workers=self._count,
                            threads_per_worker=1,
                            dashboard_address="127.0.0.1:0",
                            silence_logs=logging.CRITICAL,
                        )
                    )
                # As the default client, one that finds no scheduler would leave Dask's own settings changed for good.
                client = distributed.Client(address, timeout=_PATIENCE, set_as_default=False)
                self._client = opened.enter_context(client)
                self._client.wait_for_workers(1, timeout=_PATIENCE)
                software_of_workers = self._client.run(software)
            except Exception as error:
                failure = _line(error)
            if failure:
                # A client that never connected is closed as it is collected. Collected later, while the next one
                # starts, it would wait for a lock that its own thread holds.
                gc.collect()
                guard = '; in a script, put the code under if __name__ == "__main__":' if self._count else ""
                raise InputError(f"{self._name}: no workers can be had: {failure.rstrip('.')}{guard}")
            for worker, versions in software_of_workers.items():
                _check_software(versions, software(), worker)
            self._open = opened.pop_all()
        return self

    def __exit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._client = None
        self._open.close()

    @property
    def workers(self) -> int:
        """Number of batches computed at a time."""
        refuse_if(
            self._client is None, f"{self._name}: the workers are there within: with mp.Cluster(...) as cluster alone"
        )
        return max(1, sum(self._client.nthreads().values()))

    @property
    def _name(self) -> str:
        return f"scheduler {self._scheduler}" if self._scheduler else f"workers = {self._count}"

    def __call__(self, batches: Iterable[Batch]) -> Generator[Any, None, None]:
        """Compute batches on the workers and yield their results in order."""
        ahead = _AHEAD * self.workers
        pending: deque[Any] = deque()
        try:
            for group in _groups(batches):
                # The arrays are a part of the task, so that it can be done again when a worker has died.
                pending.append(self._client.submit(_compute, group, mi.variant(), software(), pure=False))
                if len(pending) >= ahead:
                    yield from self._results(pending.popleft())
            while pending:
                yield from self._results(pending.popleft())
        finally:
            with contextlib.suppress(Exception):
                self._client.cancel(list(pending), force=True)

    def _results(self, future: Any) -> list:
        from distributed import KilledWorker

        try:
            return list(future.result())
        except KilledWorker:
            raise InputError(
                f"{self._name}: the same part of the sum ended several workers; they may have too little memory"
            ) from None
        except (CancelledError, OSError) as error:
            raise InputError(f"{self._name}: the connection was lost: {_line(error)}") from None


def _groups(batches: Iterable[Batch]) -> Iterator[list[Batch]]:
    """Yield groups of consecutive batches, large enough to be worth sending to a worker."""
    group = []
    samples = 0
    for batch in batches:
        group.append(batch)
        samples += batch.samples
        if samples >= _GROUP_SAMPLES:
            yield group
            group = []
            samples = 0
    if group:
        yield group


def _compute(batches: list[Batch], variant: str | None, versions: dict[str, str]) -> list:
    """Return the results of batches, computed on a worker."""
    _check_software(software(), versions, "a worker")
    results = []
    for batch in batches:
        # Dr.Jit's part is done by one thread at a time, where a worker has several.
        with _lock:
            set_variant(variant)
            if not on_cuda():
                stop_threads()
            work = batch.prepare()
        results.append(work())
    return results


def _check_software(there: dict[str, str], here: dict[str, str], worker: str) -> None:
    for name, version in here.items():
        refuse_if(there.get(name) != version, f"{worker}: its {name} is {there.get(name)}, here it is {version}")


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


@dataclass(frozen=True)
class Cost:
    """Estimated time in seconds on this machine, and memory in bytes, of a computation."""

    seconds: float
    memory: float  # largest memory asked for


class _KnownError(Exception):
    """Ends work whose time is known by now."""


def cost_of(work: Callable, *values: Any, **options: Any) -> Cost:
    """Return the estimated cost of a function called with values and options, and with `progress`.

    The work is begun, and abandoned as soon as its forecast stands, or done if it ends before.
    """
    # Not needed by captures.
    from .progress import Forecast

    for name in ("progress", "checkpoint"):
        if options.get(name) is not None:
            raise InputError(f"{argument(name)}: an estimate does not take it; leave it out")

    def leave(seconds: float) -> None:
        raise _KnownError(seconds)

    start = time.monotonic()
    with memory_asked() as sizes:
        try:
            work(*values, **options | {"progress": Forecast(leave)})
            seconds = time.monotonic() - start
        except _KnownError as known:
            (seconds,) = known.args
    return Cost(seconds, max(sizes))


_LOOK = 0.25
"""Seconds between two reports of a kernel."""

_lane_count: ContextVar[Any] = ContextVar("count", default=None)


def count_lanes(lanes: int) -> None:
    """Let the kernel that is being recorded count its lanes, if anyone asks for them: see `lanes_reported`."""
    if (count := _lane_count.get()) is not None:
        # One lane of 1,024, as threads wait for each other's counts; without copies for each, added up at the end.
        counts = (dr.arange(mi.UInt32, lanes) & 1023) == 0
        dr.scatter_add(count, mi.UInt32(1024), dr.zeros(mi.UInt32, lanes), counts, mode=dr.ReduceMode.Local)


@contextlib.contextmanager
def lanes_reported(report: Callable[[float], None] | None, lanes: int) -> Iterator[None]:
    """Report the fraction of lanes that kernels within the context have counted, from a thread while they run.

    What the report raises is raised at the end of the context. On CUDA nothing is reported.
    """
    if report is None or on_cuda():
        yield
        return
    count = dr.zeros(mi.UInt32, 1)
    dr.make_opaque(count)
    dr.sync_thread()
    counted = ctypes.c_uint32.from_address(count.numpy().ctypes.data)
    ended = threading.Event()
    errors = []

    def watch() -> None:
        try:
            while not ended.wait(_LOOK):
                if counted.value:
                    report(min(counted.value / lanes, 1.0))
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=watch, daemon=True)
    before = _lane_count.set(count)
    # The only thread of a single core would run a kernel as one piece, which counts at its end.
    alone = worker_count() == dr.thread_count() == 1
    if alone:
        dr.set_thread_count(2)
    thread.start()
    try:
        yield
    finally:
        _lane_count.reset(before)
        if alone:
            dr.sync_thread()
            stop_threads()
        ended.set()
        thread.join()
    if errors:
        raise errors[0]
