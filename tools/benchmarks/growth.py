"""How time and memory grow with the detector, the radiators, the distances and the threads."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Sequence

import numpy as np

from mitsuba_plenoptic import Capture, PlenopticCamera, reconstruct
from mitsuba_plenoptic.propagation import incoherent_sum, propagate
from mitsuba_plenoptic.propagation.fft import worker_count

from .table import Row, on_cores, peak_memory

_WAVELENGTH = 633.0
_CAMERA = PlenopticCamera(detector_width=2.048, resolution=(1024, 1024))


def run(sizes: list[int], runs: int) -> list[Row]:
    """Fit every growth."""
    return [*_detector(sizes, runs), *_radiators(runs), *_memory(), *_distances(runs), *_threads(runs)]


def _exponent(counts: Sequence[float], values: Sequence[float]) -> float:
    return float(np.polyfit(np.log(counts), np.log(values), 1)[0])


def _seconds(work: Callable[[], object], runs: int) -> float:
    """Processor seconds, the median of some runs after one that does not count."""
    times = []
    for _ in range(runs + 1):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return statistics.median(times[1:])


def _row(what: str, unit: str, counts: Sequence[int], values: Sequence[float], expected: str, exponent: float) -> Row:
    listed = ", ".join(f"{count}: {value:.3g}" for count, value in zip(counts, values, strict=True))
    return Row(f"growth of {what}", unit, against=expected, ratio=exponent, note=f"exponent fitted to {listed}")


def _detector(sizes: list[int], runs: int) -> list[Row]:
    sizes = sorted({512, *sizes})
    times = []
    for size in sizes:
        field = np.ones((size, size), np.complex64)
        times.append(_seconds(lambda field=field: propagate(field, 4e-3, 5.0, _WAVELENGTH), runs))
    per_log = [seconds / math.log(size) for seconds, size in zip(times, sizes, strict=True)]
    what = "the step with N, over log N"
    return [_row(what, "CPU s", sizes, times, "2: N² log N", _exponent(sizes, per_log))]


def _positions(count: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    image = rng.uniform(-0.8, 0.8, (count, 2))
    return np.column_stack([-image * 280.0 / _CAMERA.mla_distance, np.full(count, 280.0)])


def _sum(count: int, threads: int | None = None) -> None:
    incoherent_sum(_CAMERA, _positions(count), np.ones(count), wavelength=_WAVELENGTH, accuracy=0, threads=threads)


def _radiators(runs: int) -> list[Row]:
    counts = [64, 128, 256, 512]
    times = [_seconds(lambda count=count: _sum(count), 1) for count in counts]
    return [_row("the wave capture with radiators", "CPU s", counts, times, "1", _exponent(counts, times))]


def _memory() -> list[Row]:
    counts = [128, 512]
    rows = [on_cores(worker_count(), _peak, count)[0] for count in counts]
    values = [row.ours or 0.0 for row in rows]
    return [_row("its memory with radiators", "GiB", counts, values, "0", _exponent(counts, values))]


def _peak(count: int) -> list[Row]:
    _sum(count)
    return [Row("peak memory", "GiB", peak_memory())]


def _distances(runs: int) -> list[Row]:
    image = np.random.default_rng(0).random(_CAMERA.shape, dtype=np.float32)
    capture = Capture(image, _CAMERA)
    counts = [2, 4, 8]
    rows = []
    for method in ("ray", "coherent"):
        times = [
            _seconds(
                lambda count=count, method=method: reconstruct(
                    capture, list(np.linspace(210, 280, count)), method=method, wavelength=_WAVELENGTH
                ),
                runs,
            )
            for count in counts
        ]
        what = f"the {method} reconstruction with distances"
        rows.append(_row(what, "CPU s", counts, times, "at most 1", _exponent(counts, times)))
    return rows


def _threads(runs: int) -> list[Row]:
    counts = sorted({1, worker_count()})
    times = []
    for count in counts:
        wall = []
        for _ in range(runs):
            start = time.perf_counter()
            _sum(128, count)
            wall.append(time.perf_counter() - start)
        times.append(statistics.median(wall))
    if len(counts) < 2:
        return []
    return [_row("the wave capture's time with threads", "s", counts, times, "-1", _exponent(counts, times))]
