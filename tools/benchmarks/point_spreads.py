"""Point spreads against bare FFTs and other libraries, and sums with shared point spreads against sums without."""

from __future__ import annotations

import contextlib
import importlib
import io
import time
from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
import scipy.fft

from mitsuba_plenoptic import PlenopticCamera, load_scene
from mitsuba_plenoptic.capture.accuracy import DEFAULT_ACCURACY
from mitsuba_plenoptic.capture.incoherent import _add_up, _PatchSum, estimate_cost, incoherent_sum
from mitsuba_plenoptic.capture.patch import PatchBatch, Workspace, _blocks
from mitsuba_plenoptic.capture.radiators import find_radiators, sample_pairs
from mitsuba_plenoptic.runtime.batches import Threads
from mitsuba_plenoptic.runtime.fft import resting_drjit

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


def radiators(scene_name: str, parameters: dict[str, str]) -> tuple[Any, ...]:
    """Find the radiators of a scene: camera, positions, weights and masks."""
    scene = load_scene(scene_name, parameters=parameters)
    sensor = scene.sensors()[0]
    camera = PlenopticCamera.from_sensor(sensor)
    found = find_radiators(
        scene, sensor, mi.load_dict({"type": "path"}), camera, sample_pairs(8, np.zeros(4)),
        spp=4, seed=1, wavelength=None, occlusion=True,
    )  # fmt: skip
    return camera, found.positions, found.radiance[:, 0] / found.share, found.masks


def sharing() -> list[Row]:
    """Compare sums of the default accuracy with sums in which nothing is shared: speed and error on parts of scenes."""
    rows = []
    for name, scene, parameters, centre, across in _PARTS:
        camera, positions, weights, masks = radiators(scene, parameters)
        image = -positions[:, :2] * (camera.mla_distance / positions[:, 2:])
        part = (np.abs(image - centre) < across / 2 * camera.mla_pitch).all(1)
        what = f"{name}: {part.sum()} radiators on {across} x {across} lenses"
        rows.append(
            _compare_accuracies(what, camera, positions[part], weights[part], None if masks is None else masks[part])
        )
    return rows


def whole(scene: str) -> list[Row]:
    """Compare the sums of a whole capture: minutes by the default accuracy, far more with nothing shared."""
    camera, positions, weights, masks = radiators(scene, SCENES[scene])
    what = f"{scene}, {camera.resolution[0]} x {camera.resolution[1]}, all {len(positions)} radiators"
    return [_compare_accuracies(what, camera, positions, weights, masks)]


def _compare_accuracies(
    what: str, camera: PlenopticCamera, positions: np.ndarray, weights: np.ndarray, masks: np.ndarray | None
) -> Row:
    results = []
    for accuracy in (DEFAULT_ACCURACY, 0.0):
        start, busy = time.perf_counter(), time.process_time()
        image = incoherent_sum(camera, positions, weights, wavelength=WAVELENGTH, accuracy=accuracy, pupil_masks=masks)
        results.append((image, time.perf_counter() - start, time.process_time() - busy))
    (image, ours, busy), (exact, theirs, exact_busy) = results
    error = np.linalg.norm(image - exact) / np.linalg.norm(exact)
    return Row(
        what, "s", ours, "accuracy = 0", theirs, theirs / ours, exact_busy / busy,
        f"times faster; error {100 * error:.2f} %",
    )  # fmt: skip


def estimates() -> list[Row]:
    """Estimate whole captures of the default accuracy and those in which nothing is shared, from a part of each."""
    rows = []
    for name, parameters in SCENES.items():
        camera, positions, _, masks = radiators(name, parameters)
        ours, exact = (
            estimate_cost(camera, positions, wavelength=WAVELENGTH, accuracy=accuracy, pupil_masks=masks)
            for accuracy in (DEFAULT_ACCURACY, 0.0)
        )
        rows.append(
            Row(
                f"{name}, {camera.resolution[0]} x {camera.resolution[1]}, {len(positions)} radiators: estimate", "s",
                ours.seconds, "accuracy = 0", exact.seconds, exact.seconds / ours.seconds,
                note=f"{ours.patterns} point spreads for {exact.patterns}",
            )
        )  # fmt: skip
    return rows


def bare(runs: int) -> list[Row]:
    """Compare the sum of radiators that share nothing with the bare transforms of their patches, on one thread."""
    camera, count = PlenopticCamera(), 128
    rng = np.random.default_rng(1)
    rows = []
    for g in (210.0, 240.0, 280.0):
        image = rng.uniform(-0.2, 0.2, (count, 2))
        positions = np.column_stack([-image * g / camera.mla_distance, np.full(count, g)])
        work = _PatchSum(camera, positions, np.ones((count, 1)), None, WAVELENGTH, 0.0)
        batch = work._batch(work.chunks[0]).fields()
        works = {
            "FFTs": _transforms(batch, count),
            "ours": lambda work=work: _add_up(work, Threads(1), None, None, None),
        }
        with resting_drjit():
            timings = side_by_side(works, runs)
        ours, theirs = timings["ours"], timings["FFTs"]
        rows.append(
            Row(
                f"{count} point spreads at {g:g} mm, {batch.samples} samples across, one thread", "ms each",
                1e3 / count * ours.seconds, "their bare FFTs", 1e3 / count * theirs.seconds, ours.ratio, ours.cpu_ratio,
                "ours over the FFTs",
            )
        )  # fmt: skip
    return rows


def _transforms(batch: PatchBatch, count: int) -> Callable[[], None]:
    """Do nothing but the transforms of so many radiators like a batch's."""
    work, n, m = Workspace(batch), batch.samples, batch.mla_samples
    work.rows[:], work.columns[:], work.field[:] = 0, 0, 0

    def transform(field: np.ndarray, axis: int) -> None:
        scipy.fft.ifft(field, axis=axis, overwrite_x=True, norm="forward", workers=1)

    def run() -> None:
        for _ in range(-(-count // batch.together)):
            transform(work.rows, 2)
            transform(work.rows, 2)
            for block in _blocks(n, m, batch.sizes.block):
                columns = work.columns[:, : block.stop - block.start]
                transform(columns, 2)
                transform(columns, 2)
                transform(columns[..., :n], 2)
            for block in _blocks(n, n, batch.sizes.block):
                transform(work.field[..., block], 1)

    return run


def peers() -> list[Row]:
    """Compare point spreads per second with a full-field loop by HCIPy and with pyolaf's patterns."""
    camera = PlenopticCamera()
    positions = np.column_stack([np.linspace(-2, 2, 64), np.linspace(2, -2, 64), np.full(64, 280.0)])
    start = time.perf_counter()
    incoherent_sum(camera, positions, np.ones(64), wavelength=WAVELENGTH, accuracy=0)
    ours = 64 / (time.perf_counter() - start)
    rows = []
    for against, work in (
        ("HCIPy, full field, 4096 x 4096 samples of 2.5 µm", _hcipy),
        ("pyolaf, from the MLA on, 577 x 577 samples of 2 µm", _pyolaf),
    ):
        what = "point spreads, one radiator at 280 mm, nothing shared"
        try:
            theirs = work(camera)
        except ImportError as missing:
            rows.append(Row(what, "per s", ours, against, note=f"not installed ({missing.name})"))
        else:
            rows.append(Row(what, "per s", ours, against, theirs, ours / theirs))
    return rows


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
