"""Rows of the benchmark's table, and timing of several things in turn."""

from __future__ import annotations

import multiprocessing
import os
import resource
import statistics
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi

Result = TypeVar("Result")

COLUMNS = ("what", "unit", "ours", "against", "theirs", "ratio", "CPU ratio", "note")


@dataclass(frozen=True)
class Row:
    """One comparison; what is not known is None."""

    what: str
    unit: str = ""
    ours: float | None = None
    against: str = ""
    theirs: float | None = None
    ratio: float | None = None
    cpu_ratio: float | None = None
    note: str = ""
    points: tuple[tuple[float, float], ...] = ()
    """What a growth was fitted to; in the JSON file alone."""

    def cells(self) -> list[str]:
        """Return the texts of the row's cells."""
        numbers = ["" if n is None else f"{n:.3g}" for n in (self.ours, self.theirs, self.ratio, self.cpu_ratio)]
        return [self.what, self.unit, numbers[0], self.against, *numbers[1:], self.note]


@dataclass(frozen=True)
class Timing:
    """Medians over the runs; the ratios are to the first of the things timed, run by run."""

    seconds: float
    cpu_seconds: float
    ratio: float
    cpu_ratio: float


def markdown(rows: list[Row]) -> str:
    """Return the rows as a table."""
    lines = ["| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|"]
    return "\n".join(lines + ["| " + " | ".join(row.cells()) + " |" for row in rows]) + "\n"


def side_by_side(works: Mapping[str, Callable[[], object]], runs: int) -> dict[str, Timing]:
    """Time several things in turn, `runs` times after one that does not count."""
    wall: dict[str, list[float]] = {name: [] for name in works}
    busy: dict[str, list[float]] = {name: [] for name in works}
    for run in range(runs + 1):
        for name, work in works.items():
            start, cpu = time.perf_counter(), time.process_time()
            work()
            if run:
                wall[name].append(time.perf_counter() - start)
                busy[name].append(time.process_time() - cpu)

    def ratio(times: dict[str, list[float]], name: str) -> float:
        first = times[next(iter(works))]
        return statistics.median(a / b for a, b in zip(times[name], first, strict=True))

    return {
        name: Timing(statistics.median(wall[name]), statistics.median(busy[name]), ratio(wall, name), ratio(busy, name))
        for name in works
    }


def on_cores(count: int, work: Callable[..., Result], *arguments: Any) -> Result:
    """Do some work in a process of its own that may use so many cores, as may every thread that it starts."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, initializer=_hold, initargs=(count,)) as pool:
        return pool.submit(work, *arguments).result()


def peak_memory() -> float:
    """Return this process's peak memory in GiB."""
    try:
        # Linux carries ru_maxrss over from the process that started this one.
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 2**20
    except FileNotFoundError:
        # in bytes on macOS
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**30


def _hold(count: int) -> None:
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:count])
    mi.set_variant("llvm_ad_mono")
    dr.set_thread_count(count)
