"""Sums of point spreads: shared against unshared, against bare FFTs and other libraries, and adjoints."""

from __future__ import annotations

import contextlib
import importlib
import io
import itertools
import time
from collections.abc import Callable, Iterator

import numpy as np
import scipy.fft

from mitsuba_plenoptic import CaptureOperator, Job, PlenopticCamera
from mitsuba_plenoptic.light.optical_system import OpticalSystem
from mitsuba_plenoptic.points.accuracy import DEFAULT_ACCURACY
from mitsuba_plenoptic.points.patch import PatchBatch, PatchWorkspace
from mitsuba_plenoptic.points.patch_plan import PatchPlan
from mitsuba_plenoptic.runtime.batches import Threads
from mitsuba_plenoptic.runtime.fft import resting_drjit

from .. import Row, at_most, case, pick
from ..measures import relative
from ..speed import SCENES, SPEED, WAVELENGTH, ScenePoints, compared
from ..timing import once, paired

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
