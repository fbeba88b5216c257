"""Batches on the worker processes of a Dask cluster: on this machine, or on others.

Only arrays travel: the points of a batch and the camera to a worker, and its result back. Which worker does what
has no influence on the bits; but different processors may round differently.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import CancelledError
from types import TracebackType
from typing import Any

import drjit as dr
import mitsuba as mi

from ..errors import InputError, require_count
from .batches import Batch
from .limits import software
from .variant import set_variant

_GROUP_SAMPLES = 2**22
"""Samples of the fields that a worker computes at a time, some tenths of a second: more than sending them costs."""

_AHEAD = 3
"""Groups in progress for each worker, so that none is idle and memory stays bounded."""

_PATIENCE = "20s"

_lock = threading.Lock()


class Cluster:
    """Workers that compute the batches of wave captures, in the form that `render_capture` takes as `batch_map`.

    A context: entered, it starts local processes or connects to a scheduler; left, it ends what it has started. What
    a worker that dies was doing is done again by another. Workers run what the scheduler sends them, so both belong
    into a network that is trusted. A script that starts local processes must not run when it is imported: keep it
    under ``if __name__ == "__main__":``.

    Parameters
    ----------
    workers : int, optional
        So many processes of one thread on this machine.
    scheduler : str, optional
        Instead of them, the address of a running Dask scheduler, such as ``tcp://10.0.0.1:8786``.

    Raises
    ------
    InputError
        If not exactly one of the two is given or, on entering, the workers cannot be had or have other software.
    """

    threads = 0

    def __init__(self, *, workers: int | None = None, scheduler: str | None = None) -> None:
        if (workers is None) == (scheduler is None):
            raise InputError("workers, scheduler: give one of the two")
        self._count = None if workers is None else require_count("workers", workers, maximum=1024)
        self._scheduler = scheduler
        self._open = contextlib.ExitStack()
        self._client: Any = None

    def __enter__(self) -> Cluster:
        try:
            import distributed
        except ImportError:
            raise InputError("workers: they need dask.distributed: pip install distributed") from None
        with contextlib.ExitStack() as opened:
            opened.enter_context(_quiet())
            try:
                address: Any = self._scheduler
                if self._count:
                    address = opened.enter_context(
                        distributed.LocalCluster(
                            n_workers=self._count,
                            threads_per_worker=1,
                            dashboard_address="127.0.0.1:0",
                            silence_logs=logging.CRITICAL,
                        )
                    )
                self._client = opened.enter_context(distributed.Client(address, timeout=_PATIENCE))
                self._client.wait_for_workers(1, timeout=_PATIENCE)
                found = self._client.run(software)
            except (OSError, ValueError, ImportError, RuntimeError) as error:
                raise InputError(f"{self._name}: no workers can be had: {_line(error)}") from None
            for worker, versions in found.items():
                _check_software(versions, software(), worker)
            self._open = opened.pop_all()
        return self

    def __exit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()

    @property
    def workers(self) -> int:
        """Batches that are computed at a time."""
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

    def _results(self, future: Any) -> list[Any]:
        from distributed import KilledWorker

        try:
            return list(future.result())
        except KilledWorker:
            raise InputError(
                f"{self._name}: the same part of the sum ended several workers; they may have too little memory"
            ) from None
        except (CancelledError, OSError) as error:
            raise InputError(f"{self._name}: the connection was lost: {_line(error)}") from None


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep Dask from logging tracebacks of what our own errors say."""
    logger = logging.getLogger("distributed.client")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(level)


def _groups(batches: Iterable[Batch]) -> Iterator[list[Batch]]:
    """Gather batches that follow one another until they are worth sending to a worker."""
    group: list[Batch] = []
    samples = 0
    for batch in batches:
        group.append(batch)
        samples += batch.samples
        if samples >= _GROUP_SAMPLES:
            yield group
            group, samples = [], 0
    if group:
        yield group


def _compute(batches: list[Batch], variant: str | None, versions: dict[str, str]) -> list[Any]:
    """Compute batches, on a worker."""
    _check_software(software(), versions, "a worker")
    results = []
    for batch in batches:
        # Dr.Jit's part is done by one thread at a time, where a worker has several.
        with _lock:
            set_variant(variant)
            dr.set_thread_count(1)
            work = batch.prepare()
        results.append(work())
    return results


def _check_software(there: dict[str, str], here: dict[str, str], worker: str) -> None:
    for name, version in here.items():
        if there.get(name) != version:
            raise InputError(f"{worker}: its {name} is {there.get(name)}, here it is {version}")


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
