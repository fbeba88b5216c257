"""Point spreads against bare FFTs and other libraries, sums that share them against sums that do not, and adjoints."""

from __future__ import annotations

import contextlib
import importlib
import io
import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
import scipy.fft

from mitsuba_plenoptic import PlenopticCamera, load_scene
from mitsuba_plenoptic.capture.scene_light import SceneLight
from mitsuba_plenoptic.capture.scene_points import find_points
from mitsuba_plenoptic.operator.accuracy import DEFAULT_ACCURACY
from mitsuba_plenoptic.operator.operator import CaptureOperator
from mitsuba_plenoptic.operator.patch import PatchBatch, PatchWorkspace
from mitsuba_plenoptic.operator.patch_plan import PatchPlan
from mitsuba_plenoptic.operator.pupil_weights import PupilWeights
from mitsuba_plenoptic.runtime.batches import Threads
from mitsuba_plenoptic.runtime.fft import resting_drjit
from mitsuba_plenoptic.runtime.jobs import Job
from mitsuba_plenoptic.system.optical_system import OpticalSystem

from .table import Row, side_by_side

WAVELENGTH = 633.0
_STILL_LIFE = {"resolution": "1024", "detector_width": "2.048"}
# name, scene, parameters, centre on the microlens array in millimetres, lenses across
_PARTS = (
    ("letters, '8' at 210 mm", "letters", {}, (-2.15, 0.475), 5),
    ("letters, 'F' in focus", "letters", {}, (-0.4, -0.58), 7),
    ("letters, '#' at 280 mm", "letters", {}, (1.84, -0.07), 5),
    ("still life, table", "still_life", _STILL_LIFE, (-0.5, 0.5), 7),
    ("still life, edges", "still_life", _STILL_LIFE, (0.5, -0.83), 5),
)
SCENES = {"letters": {}, "still_life": _STILL_LIFE}


@dataclass(frozen=True)
class ScenePoints:
    """Points of a scene before a camera, their weights and what they see of the pupil."""

    camera: PlenopticCamera
    positions: np.ndarray
    weights: np.ndarray
    pupil_weights: PupilWeights | None

    @classmethod
    def of(cls, scene_name: str, parameters: dict[str, str]) -> ScenePoints:
        """Find them."""
        scene = load_scene(scene_name, parameters=parameters)
        sensor = scene.sensors()[0]
        camera = PlenopticCamera.from_sensor(sensor)
        found = find_points([SceneLight(scene, sensor, mi.load_dict({"type": "path"}))], camera, 64, seed=1, paths=4)
        return cls(camera, found.positions, found.weights[:, 0], found.pupil_weights)

    def take(self, which: Any) -> ScenePoints:
        """Return some of them."""
        pupil_weights = self.pupil_weights and self.pupil_weights.take(which)
        return ScenePoints(self.camera, self.positions[which], self.weights[which], pupil_weights)

    def operator(self, accuracy: float = DEFAULT_ACCURACY) -> CaptureOperator:
        """Return the operator of their capture, with nothing planned yet."""
        return CaptureOperator(
            self.camera, self.positions, wavelength=WAVELENGTH, accuracy=accuracy, pupil_weights=self.pupil_weights
        )

    def __str__(self) -> str:
        columns, rows = self.camera.resolution
        return f"{columns} x {rows}, {len(self.positions)} points"


def sharing() -> Iterator[Row]:
    """Compare sums of the default accuracy with sums in which nothing is shared: speed and error on parts of scenes."""
    for name, scene, parameters, centre, across in _PARTS:
        points = ScenePoints.of(scene, parameters)
        camera, positions = points.camera, points.positions
        image = -positions[:, :2] * (camera.mla_distance / positions[:, 2:])
        part = points.take(np.flatnonzero((np.abs(image - centre) < across / 2 * camera.mla_pitch).all(1)))
        what = f"{name}: {len(part.positions)} points on {across} x {across} lenses"
        yield _compare_accuracies(what, part)


def whole(scene: str) -> Iterator[Row]:
    """Compare the sums of a whole capture: minutes by the default accuracy, far more with nothing shared."""
    points = ScenePoints.of(scene, SCENES[scene])
    yield _compare_accuracies(f"{scene}, {points}, all of them", points)


def _compare_accuracies(what: str, points: ScenePoints) -> Row:
    results = []
    for accuracy in (DEFAULT_ACCURACY, 0.0):
        start, busy = time.perf_counter(), time.process_time()
        image = points.operator(accuracy).forward(points.weights)
        results.append((image, time.perf_counter() - start, time.process_time() - busy))
    (image, ours, busy), (exact, theirs, exact_busy) = results
    error = np.linalg.norm(image - exact) / np.linalg.norm(exact)
    return Row(
        what, "s", ours, "accuracy = 0", theirs, theirs / ours, exact_busy / busy,
        f"times faster; error {100 * error:.2f} %",
    )  # fmt: skip


def estimates() -> Iterator[Row]:
    """Estimate whole captures of the default accuracy and those in which nothing is shared, from a part of each."""
    for name, parameters in SCENES.items():
        points = ScenePoints.of(name, parameters)
        ours, exact = (points.operator(accuracy).estimate() for accuracy in (DEFAULT_ACCURACY, 0.0))
        yield Row(
            f"{name}, {points}: estimate", "s",
            ours.seconds, "accuracy = 0", exact.seconds, exact.seconds / ours.seconds,
            note=f"{ours.patterns} point spreads for {exact.patterns}",
        )  # fmt: skip


def adjoint(runs: int) -> Iterator[Row]:
    """Compare the adjoint with the sum, both planned beforehand, of the default accuracy and with nothing shared."""
    letters = ScenePoints.of("letters", {"resolution": "512", "detector_width": "1.024"})
    for points, accuracy in ((letters, DEFAULT_ACCURACY), (letters.take(slice(None, None, 20)), 0.0)):
        operator = points.operator(accuracy)
        image = operator.forward(points.weights)
        timings = side_by_side(
            {
                "adjoint": lambda operator=operator, image=image: operator.adjoint(image),
                "forward": lambda operator=operator, weights=points.weights: operator.forward(weights),
            },
            runs,
        )
        ours, theirs = timings["adjoint"], timings["forward"]
        yield Row(
            f"adjoint, letters, {points}, accuracy {accuracy:g}", "s", ours.seconds, "forward", theirs.seconds,
            1 / theirs.ratio, 1 / theirs.cpu_ratio, "adjoint over forward",
        )  # fmt: skip


def bare(runs: int) -> Iterator[Row]:
    """Compare the sum of points that share nothing with the bare transforms of their patches, on one thread."""
    camera, count = PlenopticCamera(), 128
    rng = np.random.default_rng(1)
    for g in (210.0, 240.0, 280.0):
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
            timings = side_by_side(works, runs)
        ours, theirs = timings["ours"], timings["FFTs"]
        yield Row(
            f"{count} point spreads at {g:g} mm, {batch.samples} samples across, one thread", "ms each",
            1e3 / count * ours.seconds, "their bare FFTs", 1e3 / count * theirs.seconds, ours.ratio, ours.cpu_ratio,
            "ours over the FFTs",
        )  # fmt: skip


def _transforms(batch: PatchBatch, count: int) -> Callable[[], None]:
    """Do nothing but the transforms of so many points like a batch's."""
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


def peers() -> Iterator[Row]:
    """Compare point spreads per second with a full-field loop by HCIPy and with pyolaf's patterns."""
    camera = PlenopticCamera()
    positions = np.column_stack([np.linspace(-2, 2, 64), np.linspace(2, -2, 64), np.full(64, 280.0)])
    start = time.perf_counter()
    CaptureOperator(camera, positions, wavelength=WAVELENGTH, accuracy=0).forward(np.ones(64))
    ours = 64 / (time.perf_counter() - start)
    for against, work in (
        ("HCIPy, full field, 4096 x 4096 samples of 2.5 µm", _hcipy),
        ("pyolaf, from the MLA on, 577 x 577 samples of 2 µm", _pyolaf),
    ):
        what = "point spreads, one radiator at 280 mm, nothing shared"
        try:
            theirs = work(camera)
        except ImportError as missing:
            yield Row(what, "per s", ours, against, note=f"not installed ({missing.name})")
        else:
            yield Row(what, "per s", ours, against, theirs, ours / theirs)


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
