"""How time and memory grow with the detector, the radiators, the distances and the threads.

Every point is measured in a process of its own, whose peak of memory is then that point's; on one core, but for the
threads. With the size of the detector grows what is taken beyond that of the process before the work. The growth is the
slope of a straight line through the logarithms.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mitsuba_plenoptic import Capture, PlenopticCamera, load_scene, reconstruct, render_capture
from mitsuba_plenoptic.capture.accuracy import DEFAULT_ACCURACY
from mitsuba_plenoptic.capture.operator import CaptureOperator
from mitsuba_plenoptic.optics.free_space import propagate
from mitsuba_plenoptic.runtime.batches import Threads
from mitsuba_plenoptic.runtime.fft import worker_count
from mitsuba_plenoptic.runtime.jobs import Job

from .steps import beam
from .table import Row, on_cores, peak_memory

_WAVELENGTH = 633.0
_PIXEL = 2e-3
_CAMERA = PlenopticCamera(detector_width=2.048, resolution=(1024, 1024))

_LARGEST_FIELD = 4096
"""Pixels across the largest detector whose coherent reconstruction is within the memory that one may take."""


def run(sizes: list[int], runs: int) -> list[Row]:
    """Fit every growth."""
    sizes = sorted({512, *sizes})
    return [*_detector(sizes, runs), *_radiators(), *_passes(), *_distances(runs), *_threads(runs)]


def _detector(sizes: list[int], runs: int) -> list[Row]:
    reconstructed = [size for size in sizes if size <= _LARGEST_FIELD]
    rows = []
    for what, work, some, expected in (
        ("the angular-spectrum step", _step, sizes, "2 over log N"),
        ("the ray capture, 1 sample a pixel,", _ray_capture, sizes, "2"),
        # At the main lens its windows are as wide as the pupil, however small the detector.
        ("the coherent reconstruction", _coherent, reconstructed, "at most 2 over log N"),
    ):
        points = [_point(1, work, size, runs) for size in some]
        beyond = [_Point(point.seconds, point.memory - point.before) for point in points]
        divisors = [math.log(size) if "log" in expected else 1.0 for size in some]
        rows += _rows(f"{what} with pixels across", some, beyond, expected, "at most 2", divisors)
    return rows


_SHARED = (2048, 8192, 32768)


def _radiators() -> list[Row]:
    rows = []
    for accuracy, counts, time_expected in ((0.0, (128, 512, 2048), "1"), (DEFAULT_ACCURACY, _SHARED, "at most 1")):
        points = [_point(1, _sum, count, accuracy) for count in counts]
        what = f"the wave capture, accuracy {accuracy:g}, with radiators"
        rows += _rows(what, counts, points, time_expected, "0")
    return rows


def _passes() -> list[Row]:
    counts = (1, 2, 4, 8)
    points = [_point(1, _wave_capture, count) for count in counts]
    return _rows("the whole wave capture with passes", counts, points, "1", "0")


def _distances(runs: int) -> list[Row]:
    counts = (2, 4, 8)
    return [
        row
        for method in ("ray", "coherent")
        for row in _rows(
            f"the {method} reconstruction with distances",
            counts,
            [_point(1, _reconstruct, count, method, runs) for count in counts],
            "at most 1",
            "at most 1",
        )
    ]


def _threads(runs: int) -> list[Row]:
    counts = sorted({1, worker_count()})
    if len(counts) < 2:
        return []
    points = [_point(count, _threaded, runs) for count in counts]
    return _rows("the wave capture with threads", counts, points, "-1", "at most 1", unit="s")


@dataclasses.dataclass(frozen=True)
class _Point:
    seconds: float
    memory: float
    before: float = 0.0


def _rows(
    what: str,
    counts: Sequence[int],
    points: Sequence[_Point],
    time_expected: str,
    memory_expected: str,
    divisors: Sequence[float] | None = None,
    unit: str = "CPU s",
) -> list[Row]:
    seconds = [point.seconds for point in points]
    over = [second / divisor for second, divisor in zip(seconds, divisors or [1.0] * len(seconds), strict=True)]
    memory = [point.memory for point in points]
    return [
        _row(f"time of {what}", unit, counts, seconds, time_expected, _exponent(counts, over)),
        _row(f"peak memory of {what}", "GiB", counts, memory, memory_expected, _exponent(counts, memory)),
    ]


def _row(
    what: str, unit: str, counts: Sequence[int], values: Sequence[float], expected: str, exponent: float | None
) -> Row:
    listed = ", ".join(f"{count}: {value:.3g}" for count, value in zip(counts, values, strict=True))
    points = tuple(zip(map(float, counts), values, strict=True))
    return Row(
        f"growth of the {what}",
        "exponent",
        exponent,
        f"expected: {expected}",
        note=f"{unit} at {listed}",
        points=points,
    )


def _exponent(counts: Sequence[int], values: Sequence[float]) -> float | None:
    if len(counts) < 2:
        return None
    return float(np.polyfit(np.log(counts), np.log(values), 1)[0])


def _point(cores: int, work: Callable[..., float], *arguments: Any) -> _Point:
    """Measure seconds and peak memory of some work in a process of its own."""
    return _Point(*(row.ours or math.nan for row in on_cores(cores, _measured, work, *arguments)))


def _measured(work: Callable[..., float], *arguments: Any) -> list[Row]:
    before = peak_memory()
    seconds = work(*arguments)
    return [
        Row("time", "s", seconds),
        Row("peak memory", "GiB", peak_memory()),
        Row("peak memory before the work", "GiB", before),
    ]


def _seconds(work: Callable[[], object], runs: int, clock: Callable[[], float] = time.process_time) -> float:
    """Processor seconds, or those of another clock: the median of some runs after one that does not count."""
    times = []
    for _ in range(runs + 1):
        start = clock()
        work()
        times.append(clock() - start)
    return statistics.median(times[1:])


def _step(size: int, runs: int) -> float:
    field = beam(size)

    def step() -> None:
        nonlocal field
        field = propagate(field, 4e-3, 5.0, _WAVELENGTH, overwrite=True)

    return _seconds(step, runs)


def _ray_capture(size: int, runs: int) -> float:
    scene = load_scene("letters", parameters={"resolution": str(size)})
    return _seconds(lambda: render_capture(scene, spp=1), runs)


def _camera(size: int) -> PlenopticCamera:
    return PlenopticCamera(detector_width=size * _PIXEL, resolution=(size, size))


def _coherent(size: int, runs: int) -> float:
    camera = _camera(size)
    capture = Capture(np.random.default_rng(0).random(camera.shape, dtype=np.float32), camera)
    return _seconds(lambda: reconstruct(capture, 280.0, method="coherent", wavelength=_WAVELENGTH), runs)


def _positions(count: int) -> np.ndarray:
    """Places of a wall out of focus, the same in every lens as those of a capture are."""
    lenses = 16
    per_lens = max(1, count // lenses**2)
    offset = np.random.default_rng(0).random((per_lens, 2))
    lens = np.stack(np.meshgrid(*[np.arange(lenses) - lenses // 2] * 2), -1).reshape(-1, 1, 2)
    image = ((lens + offset).reshape(-1, 2) * _CAMERA.mla_pitch)[:count]
    return np.column_stack([-image * 280.0 / _CAMERA.mla_distance, np.full(len(image), 280.0)])


def _add(positions: np.ndarray, accuracy: float, threads: int) -> None:
    operator = CaptureOperator(_CAMERA, positions, wavelength=_WAVELENGTH, accuracy=accuracy)
    operator.forward(np.ones(len(positions)), job=Job(batch_map=Threads(threads)))


def _sum(count: int, accuracy: float) -> float:
    positions = _positions(count)
    _add(_positions(64), accuracy, 1)  # compiles the kernels
    start = time.process_time()
    _add(positions, accuracy, 1)
    return time.process_time() - start


def _wave_capture(passes: int) -> float:
    """Render a part of the letters, whose radiators do not all see the whole pupil."""
    scene = load_scene("letters", parameters={"resolution": "256", "detector_width": "0.512"})
    render_capture(scene, model="wave", spp=1, radiators_per_lens=1)  # compiles the kernels
    start = time.process_time()
    render_capture(scene, model="wave", spp=1, radiators_per_lens=4, passes=passes)
    return time.process_time() - start


def _reconstruct(count: int, method: str, runs: int) -> float:
    capture = Capture(np.random.default_rng(0).random(_CAMERA.shape, dtype=np.float32), _CAMERA)
    distances = list(np.linspace(210, 280, count))
    return _seconds(lambda: reconstruct(capture, distances, method=method, wavelength=_WAVELENGTH), runs)


def _threaded(runs: int) -> float:
    positions, threads = _positions(128), worker_count()
    return _seconds(lambda: _add(positions, 0, threads), runs, time.perf_counter)
