"""What sums, processes and sizes cost.

Sums of point spreads: shared against unshared, against bare FFTs and other libraries, and adjoints.

How time and memory grow with the detector, the points, the distances and the threads: every point is measured in a
process of its own, whose peak of memory is then that point's; on one core, except for the threads. With the size of the
detector grows what is taken beyond that of the process before the work. The growth is the slope of a straight line
through the logarithms.

Processor time until the package is imported and the command says something, over that of importing Mitsuba. And ten
figures at sizes that take seconds: what is slow, what takes memory, and how exact it is; asv follows them.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import itertools
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import scipy.fft

from mitsuba_plenoptic import (
    Capture,
    CaptureOperator,
    Job,
    PlenopticCamera,
    decode,
    load_scene,
    point_spread_function,
    reconstruct,
    render_capture,
)
from mitsuba_plenoptic import render_capture as render
from mitsuba_plenoptic.light.optical_system import OpticalSystem
from mitsuba_plenoptic.optics.waves import propagate
from mitsuba_plenoptic.points.accuracy import DEFAULT_ACCURACY
from mitsuba_plenoptic.points.patch import PatchBatch, PatchWorkspace
from mitsuba_plenoptic.points.patch_plan import PatchPlan
from mitsuba_plenoptic.runtime.batches import Threads
from mitsuba_plenoptic.runtime.fft import resting_drjit, worker_count
from mitsuba_plenoptic.views import depth_map

from .. import Row, at_most, case, figure, pick
from ..measures import relative
from ..speed import SCENES, SPEED, WAVELENGTH, ScenePoints, beam, compared
from ..timing import alone, in_process, once, paired, peak_memory

_STILL_LIFE = SCENES["still_life"]
# name, scene, parameters, centre on the microlens array in millimetres, lenses across
_PARTS = (
    ("letters, '8' at 210 mm", "letters", {}, (-2.15, 0.475), 5),
    ("letters, 'F' in focus", "letters", {}, (-0.4, -0.58), 7),
    ("letters, '#' at 280 mm", "letters", {}, (1.84, -0.07), 5),
    ("still life, table", "still_life", _STILL_LIFE, (-0.5, 0.5), 7),
    ("still life, edges", "still_life", _STILL_LIFE, (0.5, -0.83), 5),
)


@case(
    "speed.sharing",
    "Sums of point spreads of the default accuracy against sums in which nothing is shared: how many times faster, and "
    "the error, on parts of scenes",
    SPEED,
    (at_most("difference", DEFAULT_ACCURACY),),
    page="docs/theory/cost.md",
    quick={"count": 1},
)
def sharing(*, scene: str = "", count: int = 5) -> Iterator[Row]:
    """Compare parts; a scene that is named is summed whole, which takes up to an hour."""
    if scene:
        points = ScenePoints.of(scene, pick(SCENES, [scene])[scene])
        yield _compare_accuracies(f"{scene}, {points}, all of them", points)
        return
    for name, scene_name, parameters, centre, across in _PARTS[:count]:
        points = ScenePoints.of(scene_name, parameters)
        camera, positions = points.camera, points.positions
        image = -positions[:, :2] * (camera.mla_distance / positions[:, 2:])
        part = points.take(np.flatnonzero((np.abs(image - centre) < across / 2 * camera.mla_pitch).all(1)))
        yield _compare_accuracies(f"{name}: {len(part.positions)} points on {across} x {across} lenses", part)


def _compare_accuracies(what: str, points: ScenePoints) -> Row:
    (image, ours, busy), (exact, theirs, exact_busy) = (
        once(lambda a=accuracy: points.operator(a).forward(points.weights)) for accuracy in (DEFAULT_ACCURACY, 0.0)
    )
    return {
        "what": what, "unit": "s", "ours": ours, "against": "accuracy = 0", "theirs": theirs, "ratio": theirs / ours,
        "cpu_ratio": exact_busy / busy, "difference": relative(image, exact), "note": "times faster, each run once",
    }  # fmt: skip


@case(
    "speed.estimates",
    "Estimates of whole captures by points of the default accuracy against those in which nothing is shared",
    SPEED,
    quick={"only": ("still_life",)},
)
def estimates(*, only: tuple[str, ...] = ()) -> Iterator[Row]:
    """Estimate from a part of each."""
    for name, parameters in pick(SCENES, only).items():
        points = ScenePoints.of(name, parameters)
        ours, exact = (points.operator(accuracy).estimate() for accuracy in (DEFAULT_ACCURACY, 0.0))
        yield {
            "what": f"{name}, {points}: estimate", "unit": "s", "ours": ours.seconds, "against": "accuracy = 0",
            "theirs": exact.seconds, "ratio": exact.seconds / ours.seconds,
            "note": f"{ours.patterns} point spreads for {exact.patterns}",
        }  # fmt: skip


@case(
    "speed.adjoint",
    "The adjoint over the sum, both planned beforehand, of the default accuracy and with nothing shared",
    SPEED,
    quick={"runs": 1, "resolution": 256},
)
def adjoint(*, runs: int = 5, resolution: int = 512) -> Iterator[Row]:
    """Time both in turn."""
    letters = ScenePoints.of("letters", {"resolution": str(resolution), "detector_width": str(0.002 * resolution)})
    for points, accuracy in ((letters, DEFAULT_ACCURACY), (letters.take(slice(None, None, 20)), 0.0)):
        operator = points.operator(accuracy)
        image = operator.forward(points.weights)
        timings = paired(
            {
                "forward": lambda operator=operator, weights=points.weights: operator.forward(weights),
                "adjoint": lambda operator=operator, image=image: operator.adjoint(image),
            },
            runs,
        )
        what = f"adjoint, letters, {points}, accuracy {accuracy:g}"
        yield compared(what, "s", timings["adjoint"], "forward", timings["forward"], "adjoint over forward")


@case(
    "speed.bare-sums",
    "Sums of points that share nothing over the bare transforms of their patches, on one thread",
    SPEED,
    quick={"runs": 1, "distances": (240.0,), "count": 16},
)
def bare(*, runs: int = 5, count: int = 128, distances: tuple[float, ...] = (210.0, 240.0, 280.0)) -> Iterator[Row]:
    """Time both in turn."""
    camera, rng = PlenopticCamera(), np.random.default_rng(1)
    for g in distances:
        image = rng.uniform(-0.2, 0.2, (count, 2))
        positions = np.column_stack([-image * g / camera.mla_distance, np.full(count, g)])
        weights = np.ones((count, 1))
        first = next(PatchPlan(OpticalSystem(camera, WAVELENGTH), positions, None, 0.0).sum(weights).batches(0))
        batch = PatchBatch(first.fields, first.amplitudes)
        operator = CaptureOperator(camera, positions, wavelength=WAVELENGTH, accuracy=0)
        works = {
            "FFTs": _transforms(batch, count),
            "ours": lambda operator=operator, weights=weights: operator.forward(weights, job=Job(batch_map=Threads(1))),
        }
        with resting_drjit():
            timings = paired(works, runs)
        what, note = (
            f"{count} point spreads at {g:g} mm, {batch.samples} samples across, one thread",
            "ours over the FFTs",
        )
        yield compared(what, "ms each", timings["ours"], "their bare FFTs", timings["FFTs"], note, scale=1e3 / count)


def _transforms(batch: PatchBatch, count: int) -> Callable[[], None]:
    """Do nothing but the transforms of a count of points like a batch's."""
    work, n, m = PatchWorkspace(batch), batch.samples, batch.mla_samples
    work.rows[:], work.columns[:], work.field[:] = 0, 0, 0

    def transform(field: np.ndarray, axis: int) -> None:
        scipy.fft.ifft(field, axis=axis, overwrite_x=True, norm="forward", workers=1)

    def blocks(length: int) -> Iterator[slice]:
        parts = max(1, round(n * length / batch.sizes.block))
        return (slice(*pair) for pair in itertools.pairwise(n * part // parts for part in range(parts + 1)))

    def run() -> None:
        for _ in range(-(-count // batch.together)):
            transform(work.rows, 2)
            transform(work.rows, 2)
            for block in blocks(m):
                columns = work.columns[:, : block.stop - block.start]
                transform(columns, 2)
                transform(columns, 2)
                transform(columns[..., :n], 2)
            for block in blocks(n):
                transform(work.field[..., block], 1)

    return run


@case(
    "speed.peers",
    "Point spreads per second, one radiator at 280 mm, nothing shared, against a full-field loop by HCIPy and pyolaf's "
    "patterns",
    SPEED,
    quick={"count": 8},
)
def peers(*, count: int = 64) -> Iterator[Row]:
    """Compare with the libraries that are installed."""
    camera = PlenopticCamera()
    positions = np.column_stack([np.linspace(-2, 2, count), np.linspace(2, -2, count), np.full(count, 280.0)])
    operator = CaptureOperator(camera, positions, wavelength=WAVELENGTH, accuracy=0)
    _, seconds, _ = once(lambda: operator.forward(np.ones(count)))
    for against, work in (
        ("HCIPy, full field, 4096 x 4096 samples of 2.5 µm", _hcipy),
        ("pyolaf, from the MLA on, 577 x 577 samples of 2 µm", _pyolaf),
    ):
        row: Row = {"what": "point spreads", "unit": "per s", "ours": count / seconds, "against": against}
        try:
            theirs = work(camera)
        except ImportError as missing:
            yield row | {"note": f"not installed ({missing.name})"}
        else:
            yield row | {"theirs": theirs, "ratio": count / seconds / theirs, "note": "times faster"}


def _hcipy(camera: PlenopticCamera) -> float:
    """Point spreads per second of two steps by HCIPy with cached transfer functions, once warm."""
    hcipy = importlib.import_module("hcipy")
    size, pitch, lam = 4096, 2.5e-3, WAVELENGTH * 1e-6
    grid = hcipy.make_uniform_grid([size, size], [size * pitch] * 2)
    steps = [
        hcipy.AngularSpectrumPropagator(grid, distance, num_oversampling=1)
        for distance in (camera.mla_distance, camera.detector_distance)
    ]
    x, y = np.asarray(grid.x), np.asarray(grid.y)
    in_lens = [(axis / camera.mla_pitch) % 1 * camera.mla_pitch - camera.mla_pitch / 2 for axis in (x, y)]
    lens = np.exp(-1j * np.pi * (in_lens[0] ** 2 + in_lens[1] ** 2) / (lam * camera.mla_focal_length))
    lens = lens.astype(np.complex64)
    square = x**2 + y**2
    phase = square * (1 / 280.0 - 1 / camera.focal_length) / 2 / lam
    pupil = (np.exp(2j * np.pi * phase) * (square < camera.aperture_radius**2)).astype(np.complex64)
    for _ in range(2):
        start = time.perf_counter()
        wave = steps[0].forward(hcipy.Wavefront(hcipy.Field(pupil, grid), lam))
        wave = steps[1].forward(hcipy.Wavefront(wave.electric_field * lens, lam))
        np.abs(np.asarray(wave.electric_field)) ** 2
    return 1 / (time.perf_counter() - start)


def _pyolaf(camera: PlenopticCamera) -> float:
    """Patterns per second of pyolaf, given the field at the MLA."""
    lf = importlib.import_module("pyolaf.lf")
    size, count = 577, 2
    field = np.ones((size, size, 1), complex)
    options = {"range": "full", "mla2sensor": camera.detector_distance, "WaveLength": WAVELENGTH * 1e-6}
    resolution = {
        "TexNnum": np.array([count, count]), "TexNnum_half": np.array([1, 1]), "texScaleFactor": np.array([1, 1]),
        "sensorRes": np.array([camera.pixel_size] * 2), "depths": [0.0],
    }  # fmt: skip
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        start = time.perf_counter()
        lf.LFM_computeForwardPatternsWaves(field, np.ones((size, size), complex), options, resolution)
    return count**2 / (time.perf_counter() - start)


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


_COMPLETE = {"_MITSUBA_PLENOPTIC_COMPLETE": "complete_bash", "COMP_WORDS": "mitsuba-plenoptic re", "COMP_CWORD": "1"}

# What is run, the environment, and the largest ratio.
STARTS: dict[str, tuple[list[str], dict[str, str], float | None]] = {
    "import mitsuba_plenoptic": (["-c", "import mitsuba_plenoptic"], {}, 2.0),
    "--help": (["-m", "mitsuba_plenoptic", "--help"], {}, 3.0),
    "completion of a command": (["-m", "mitsuba_plenoptic"], _COMPLETE, 3.0),
    "a misspelt command": (["-m", "mitsuba_plenoptic", "rendr"], {}, 3.0),
    "render --help": (["-m", "mitsuba_plenoptic", "render", "--help"], {}, 3.0),
    "a misspelt option of render": (["-m", "mitsuba_plenoptic", "render", "--misspelt"], {}, 3.0),
    "reconstruct --help": (["-m", "mitsuba_plenoptic", "reconstruct", "--help"], {}, 3.0),
    "view --help": (["-m", "mitsuba_plenoptic", "view", "--help"], {}, 3.0),
}


@case(
    "command.start",
    "Processor time of a new process, over that of one that imports Mitsuba alone",
    {"what": "{what}", "seconds": "{seconds:.2f}", "over `import mitsuba`": "{ratio:.1f}"},
    (at_most("ratio", "limit"),),
    page="docs/theory/cost.md",
    quick={"runs": 1, "names": ("--help",)},
)
def start(*, runs: int = 7, names: tuple[str, ...] = tuple(STARTS)) -> Iterator[Row]:
    """Start each process several times, in turn with one that imports Mitsuba."""
    for name in names:
        words, environment, limit = STARTS[name]
        times = np.array([(_seconds(["-c", "import mitsuba"], {}), _seconds(words, environment)) for _ in range(runs)])
        ratio = np.median(times[:, 1] / times[:, 0])
        yield {"what": name, "seconds": np.median(times[:, 1]), "ratio": ratio, "limit": limit}


def _seconds(words: list[str], environment: dict[str, str]) -> float:
    """Return the processor time of a process of Python, which may refuse what it is asked."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, *words],
        env={**os.environ, **environment},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


SMALL = {"detector_width": 2.048, "resolution": 1024, "letter_scale": 0.25}
DISTANCES = (210.0, 240.0, 280.0)


def letters() -> Any:
    """Load the letters before a quarter of the paper's camera."""
    return load_scene("letters", parameters=SMALL)


@functools.cache
def captured(model: str) -> Capture:
    """Render them."""
    return render(letters(), model=model, spp=16)


def _alone_seconds(work: Callable[[], object]) -> float:
    return alone(work, 3).seconds


def _import_time() -> float:
    return _alone_seconds(lambda: subprocess.run([sys.executable, "-c", "import mitsuba_plenoptic"], check=True))


def _capture_time(model: str, spp: int) -> float:
    scene = letters()
    return _alone_seconds(lambda: render(scene, model=model, spp=spp))


def _wave_memory() -> float:
    render(letters(), model="wave", spp=16)
    return peak_memory()


def _energy() -> float:
    return float(captured("wave").image.sum() / captured("ray").image.sum())


def _reconstruction_time(method: str) -> float:
    return _alone_seconds(lambda: reconstruct(captured("wave"), DISTANCES, method=method))


def _patch_error() -> float:
    camera = PlenopticCamera(detector_width=1.024, resolution=(512, 512))
    quick, exact = (
        point_spread_function(camera, (0.1, -0.2, 215.0), wavelength=633.0, method=method).astype(np.float64)
        for method in ("patch", "full_field")
    )
    return relative(quick, exact)


def _depth_time() -> float:
    lf = decode(captured("ray"))
    return _alone_seconds(lambda: depth_map(lf, 200.0, 300.0))


HISTORY: dict[str, tuple[Callable[[], float], str]] = {
    "import": (_import_time, "s"),
    "ray capture": (functools.partial(_capture_time, "ray", 64), "s"),
    "wave capture": (functools.partial(_capture_time, "wave", 16), "s"),
    "wave capture, peak memory": (functools.partial(in_process, _wave_memory), "GiB"),
    "wave capture, energy over the ray capture's": (_energy, ""),
    "reconstruction, ray": (functools.partial(_reconstruction_time, "ray"), "s"),
    "reconstruction, coherent": (functools.partial(_reconstruction_time, "coherent"), "s"),
    "reconstruction, partial": (functools.partial(_reconstruction_time, "partial"), "s"),
    "patch off the full field": (_patch_error, ""),
    "depth map": (_depth_time, "s"),
}
LIMITS = {"patch off the full field": 0.005}


@case("history", "The ten figures that `asv run` follows from commit to commit", quick={"only": ("patch", "import")})
def history(*, only: tuple[str, ...] = ()) -> Iterator[Row]:
    """Measure each."""
    for name, (measure, unit) in pick(HISTORY, only).items():
        yield figure(name, measure(), unit=unit, at_most=LIMITS.get(name))
