"""The one way of timing: things compared run in turn, medians count; and work in a process of its own."""

from __future__ import annotations

import multiprocessing
import os
import resource
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi

Result = TypeVar("Result")


@dataclass(frozen=True)
class Timing:
    """Medians over the runs in seconds, elapsed and of the processor, and ratios to the first of the things timed."""

    seconds: float
    processor: float
    ratio: float
    processor_ratio: float


def paired(works: Mapping[str, Callable[[], object]], runs: int = 5, *, warm: bool = True) -> dict[str, Timing]:
    """Time several things in turn, ``runs`` times after one that does not count; ratios are taken run by run.

    Without ``warm`` all count, for things that have run before.
    """
    wall: dict[str, list[float]] = {name: [] for name in works}
    busy: dict[str, list[float]] = {name: [] for name in works}
    for run in range(not warm, runs + 1):
        for name, work in works.items():
            start, cpu = time.perf_counter(), time.process_time()
            work()
            dr.sync_thread()
            if run:
                wall[name].append(time.perf_counter() - start)
                busy[name].append(time.process_time() - cpu)
    first = next(iter(works))

    def ratio(times: dict[str, list[float]], name: str) -> float:
        # A clock may stand still over very short work.
        return statistics.median(a / b if b else 1.0 for a, b in zip(times[name], times[first], strict=True))

    return {
        name: Timing(statistics.median(wall[name]), statistics.median(busy[name]), ratio(wall, name), ratio(busy, name))
        for name in works
    }


def alone(work: Callable[[], object], runs: int = 5) -> Timing:
    """Time one thing, ``runs`` times after one that does not count."""
    return paired({"": work}, runs)[""]


def once(work: Callable[[], Result]) -> tuple[Result, float, float]:
    """Return a result, and the seconds, elapsed and of the processor, that one run took."""
    start, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, time.perf_counter() - start, time.process_time() - cpu


def in_process(
    work: Callable[..., Result], *arguments: Any, cores: int | None = None, variant: str = "llvm_ad_mono"
) -> Result:
    """Do some work in a process of its own, on a count of cores if given, with as many threads."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, initializer=_prepare, initargs=(cores, variant)) as pool:
        return pool.submit(work, *arguments).result()


def peak_memory() -> float:
    """Return the peak memory of this process in GiB."""
    # Linux hands ru_maxrss on from the process that started this one.
    found = status_memory("VmHWM")
    if found is not None:
        return found
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**30 if sys.platform == "darwin" else 2**20)


def status_memory(what: str) -> float | None:
    """Return a figure of this process's memory by its name in Linux, in GiB; None elsewhere."""
    status = Path("/proc/self/status")
    if not status.exists():
        return None
    lines = status.read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(what)) / 2**20


def _prepare(cores: int | None, variant: str) -> None:
    if cores is not None and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    mi.set_variant(variant)
    if cores is not None:
        dr.set_thread_count(cores)
