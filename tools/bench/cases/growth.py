"""How time and memory grow with the detector, the points, the distances and the threads.

Every point is measured in a process of its own, whose peak of memory is then that point's; on one core, except for
the threads. With the size of the detector grows what is taken beyond that of the process before the work. The growth is
the slope of a straight line through the logarithms.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from mitsuba_plenoptic import Capture, CaptureOperator, Job, PlenopticCamera, load_scene, reconstruct, render_capture
from mitsuba_plenoptic.optics.waves import propagate
from mitsuba_plenoptic.points.accuracy import DEFAULT_ACCURACY
from mitsuba_plenoptic.runtime.batches import Threads
from mitsuba_plenoptic.runtime.fft import worker_count

from .. import Row, at_most, case, pick
from ..speed import beam
from ..timing import alone, in_process, once, peak_memory

_WAVELENGTH = 633.0

_PIXEL = 2e-3

_CAMERA = PlenopticCamera(detector_width=2.048, resolution=(1024, 1024))

_LARGEST_FIELD = 4096
"""Pixels across the largest detector whose coherent reconstruction is within the memory that one may take."""

_Point = tuple[float, float, float]
"""Seconds, the peak of memory, and its peak before the work, both in GiB."""


@case(
    "growth",
    "Growth of time and memory: fitted exponents against those of theory",
    {
        "of": "{measure}", "work": "{work}", "exponent": "{exponent:.2f}", "expected": "{expected}",
        "": "{unit} at {points}",
    },
    (at_most("exponent", "most"),),
    page="docs/theory/cost.md",
    quick={"sizes": (512, 1024), "runs": 1, "only": ("ray capture",)},
)  # fmt: skip
def growth(
    *, sizes: tuple[int, ...] = (512, 1024, 2048, 4096, 8192), runs: int = 5, only: tuple[str, ...] = ()
) -> Iterator[Row]:
    """Fit every growth; limits are a quarter above the exponents that theory expects, for threads a half."""
    fields = [size for size in sizes if size <= _LARGEST_FIELD]
    shared = f"the sum of point spreads, accuracy {DEFAULT_ACCURACY:g}, with points"
    # The work, its other arguments than the count, and the exponents of time and memory that theory expects.
    works: dict[str, tuple[Sequence[int], Callable[..., float], tuple[Any, ...], str, str]] = {
        "the angular-spectrum step with pixels across": (sizes, _step, (runs,), "2 over log N", "at most 2"),
        "the ray capture, 1 sample a pixel, with pixels across": (sizes, _ray_capture, (runs,), "2", "at most 2"),
        # At the main lens its windows are as wide as the pupil, however small the detector.
        "the coherent reconstruction with pixels across": (
            fields, _coherent, (runs,), "at most 2 over log N", "at most 2"
        ),
        "the sum of point spreads, accuracy 0, with points": ((128, 512, 2048), _sum, (0.0,), "1", "0"),
        shared: ((2048, 8192, 32768), _sum, (DEFAULT_ACCURACY,), "at most 1", "0"),
        "the whole wave capture with samples a pixel": ((16, 64, 256), _wave_capture, (), "1", "0"),
        "the ray reconstruction with distances": ((2, 4, 8), _reconstruct, ("ray", runs), "at most 1", "at most 1"),
        "the coherent reconstruction with distances": (
            (2, 4, 8), _reconstruct, ("coherent", runs), "at most 1", "at most 1"
        ),
    }  # fmt: skip
    for what, (counts, work, given, time_expected, memory_expected) in pick(works, only).items():
        points = [_point(1, work, count, *given) for count in counts]
        if "pixels across" in what:
            points = [(seconds, memory - before, before) for seconds, memory, before in points]
        yield from _rows(what, counts, points, time_expected, memory_expected)
    if worker_count() > 1 and not only:
        counts = (1, worker_count())
        points = [_point(count, _threaded, runs) for count in counts]
        yield from _rows("the sum of point spreads with threads", counts, points, "-1", "at most 1", unit="s")


def _rows(
    what: str,
    counts: Sequence[int],
    points: Sequence[_Point],
    time_expected: str,
    memory_expected: str,
    unit: str = "CPU s",
) -> Iterator[Row]:
    """Fit time and memory; what is expected "over log N" is divided by that beforehand."""
    for name, measure, expected, values in (
        ("time", unit, time_expected, [point[0] for point in points]),
        ("peak memory", "GiB", memory_expected, [point[1] for point in points]),
    ):
        divisors = np.log(counts) if "log" in expected else np.ones(len(counts))
        listed = ", ".join(f"{count}: {value:.3g}" for count, value in zip(counts, values, strict=True))
        yield {
            "measure": name,
            "work": what,
            "exponent": float(np.polyfit(np.log(counts), np.log(values / divisors), 1)[0]) if len(counts) > 1 else None,
            "expected": expected,
            "most": float(expected.removeprefix("at most ").removesuffix(" over log N"))
            + (0.5 if unit == "s" else 0.25),
            "unit": measure,
            "points": listed,
            "values": list(zip(counts, values, strict=True)),
        }


def _point(cores: int, work: Callable[..., float], *arguments: Any) -> _Point:
    """Measure some work in a process of its own."""
    return in_process(_measured, work, *arguments, cores=cores)


def _measured(work: Callable[..., float], *arguments: Any) -> _Point:
    before, seconds = peak_memory(), work(*arguments)
    return seconds, peak_memory(), before


def _step(size: int, runs: int) -> float:
    field = beam(size)

    def step() -> None:
        nonlocal field
        field = propagate(field, 4e-3, 5.0, _WAVELENGTH, overwrite=True)

    return alone(step, runs).processor


def _ray_capture(size: int, runs: int) -> float:
    scene = load_scene("letters", parameters={"resolution": str(size)})
    return alone(lambda: render_capture(scene, spp=1), runs).processor


def _noise(camera: PlenopticCamera) -> Capture:
    return Capture(np.random.default_rng(0).random(camera.shape, dtype=np.float32), camera)


def _coherent(size: int, runs: int) -> float:
    capture = _noise(PlenopticCamera(detector_width=size * _PIXEL, resolution=(size, size)))
    return alone(lambda: reconstruct(capture, 280.0, method="coherent", wavelength=_WAVELENGTH), runs).processor


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
    return once(lambda: _add(positions, accuracy, 1))[2]


def _wave_capture(spp: int) -> float:
    """Render a part of the letters."""
    scene = load_scene("letters", parameters={"resolution": "256", "detector_width": "0.512"})
    render_capture(scene, model="wave", spp=1)  # compiles the kernels
    return once(lambda: render_capture(scene, model="wave", spp=spp))[2]


def _reconstruct(count: int, method: str, runs: int) -> float:
    capture = _noise(_CAMERA)
    distances = list(np.linspace(210, 280, count))
    wavelength = None if method == "ray" else _WAVELENGTH
    work = alone(lambda: reconstruct(capture, distances, method=method, wavelength=wavelength), runs)
    return work.processor


def _threaded(runs: int) -> float:
    positions, threads = _positions(128), worker_count()
    return alone(lambda: _add(positions, 0, threads), runs).seconds
