"""A data set of paired captures that is killed twice, resumed and read back.

The worth of training on wave captures: view synthesis by a linear model.

From the pixels of 3 x 3 neighbouring lenses of a raw capture, with the noise of a detector, a linear model predicts
what pinhole cameras at nine positions of the pupil see behind the lens in the middle. The truth is rendered by
Mitsuba's own `perspective`. One model is trained on wave captures and its twin on ray captures of the same scenes, each
with the ridge penalty that is best for captures of its own kind that were held back; both are judged on wave captures
of scenes that neither has seen. Every seed has scenes, noise and a split of its own. A third is trained on ray captures
convolved with the diffraction spot of a microlens. Next to the twins stand the model of the rays judged on rays (what
light without diffraction would allow) and the best single pixel, without any model.
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import psutil
import yaml
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.lib.stride_tricks import sliding_window_view

from mitsuba_plenoptic import Capture, InputError, PlenopticCamera, design, expose
from mitsuba_plenoptic.dataset import DataSet, Recipe, make_dataset, make_sample, parse_recipe, read_recipe
from mitsuba_plenoptic.extensions.data.sample import open_sample

from .. import Row, case, figure
from ..measures import spot_filtered

MORE = 1000
"""Samples for which time and memory are extrapolated."""

PIXEL = 0.002
"""Of the paper's camera, in millimetres, of which the data set's is a part."""

COMPARED = 6


@case(
    "data-set",
    "A data set made by worker processes, killed when a third and two thirds of it are there, resumed, compared bit by "
    "bit and read by PyTorch",
    page="docs/guides/datasets.md",
    quick={"count": 4, "size": 64},
)
def data_set(output: Path, *, count: int = 100, size: int = 512, workers: int = 2) -> Iterator[Row]:
    """Make captures of the same random shapes by both models, with depth, normals and camera.

    Some samples, those about the kills among them, are made once more in this process. Times are those of the wall
    clock, the starts after kills in them; 1,000 samples are extrapolated from the second half.
    """
    folder, source = output / "data", output / "recipe.yaml"
    shutil.rmtree(folder, ignore_errors=True)
    source.write_text(yaml.safe_dump(recipe(count, size)))
    run = Run(source, folder, workers)
    kills = [count // 3, 2 * count // 3]
    for stop in (*kills, None):
        run.until(stop)
    spread = np.linspace(0, count - 1, COMPARED).astype(int).tolist()
    near = [index for kill in kills for index in (kill, kill + 1) if index < count]
    compared = sorted({*spread, *near})
    # The first samples of a run compile its kernels.
    log = np.array(run.log)
    late = log[log[:, 1] >= kills[1] + 2]
    rate, growth = (np.polyfit(late[:, 1], late[:, column], 1)[0] if len(late) > 2 else np.nan for column in (0, 2))
    # Few samples are dominated by the starts.
    limit = 0.18 * count if count >= 100 else None
    yield figure("time, restarts after two kills in it", run.seconds / 60, unit="min", at_most=limit)
    yield figure("time of one more sample", rate, unit="s")
    yield figure(f"time of {MORE}, extrapolated", (run.seconds + rate * (MORE - count)) / 3600, unit="h")
    yield figure("largest memory of all processes", log[:, 2].max() / 1024, unit="GiB")
    yield figure("its growth per sample", growth, unit="MiB")
    yield figure(f"of {len(compared)} samples made again, other bits", others(source, folder, compared), at_most=0)
    yield figure("samples", len(DataSet(folder)), at_least=count)
    total = sum(path.stat().st_size for path in folder.rglob("*.h5"))
    yield figure("size of a sample", total / count / 2**20, unit="MiB")
    for name, fields in (("all arrays", None), ("both captures and depth", ["ray", "wave", "depth"])):
        speed = reading_rate(folder, fields)
        if speed is not None:
            yield figure(f"read by PyTorch, {name}", speed, at_least=50, unit="samples/s")


def recipe(count: int, size: int) -> dict[str, Any]:
    """Return the recipe of the measured data set."""
    camera = {"detector_width": PIXEL * size, "resolution": [size, size], "focus_distance": {"from": 230, "to": 250}}
    return {
        "name": "dataset_benchmark",
        "count": count,
        "camera": camera,
        "scenes": [{"generator": "shapes", "objects": {"from": 6, "to": 16, "step": 1}}],
        "light": {"sky": {"from": 0.2, "to": 0.6}, "lamp": {"from": 0.2, "to": 1}},
        "ray": {"spp": 16},
        "wave": {"spp": 16},
        "samples_per_shard": 25,
    }


class Run:
    """The command at work: how many samples are there at which second, and how much memory its processes take."""

    def __init__(self, source: Path, folder: Path, workers: int) -> None:
        self.source, self.folder, self.workers = source, folder, workers
        self.seconds = 0.0
        self.log: list[tuple[float, int, float]] = []

    def until(self, count: int | None) -> None:
        """Run the command until a count of samples is there, and kill it; or to its end."""
        words = ["dataset", str(self.source), "-o", str(self.folder), "--workers", str(self.workers)]
        start = time.perf_counter()
        process = subprocess.Popen([sys.executable, "-m", "mitsuba_plenoptic", *words], start_new_session=True)
        while process.poll() is None:
            done = self.done()
            self.log.append((self.seconds + time.perf_counter() - start, done, memory(process.pid)))
            if count is not None and done >= count:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                break
            time.sleep(0.5)
        self.seconds += time.perf_counter() - start
        if count is None and process.returncode:
            raise SystemExit(f"the command ended with status {process.returncode}")

    def done(self) -> int:
        """Return how many samples are there; shards have the first ones."""
        shards = len(list(self.folder.glob("shards/*.h5")))
        return 25 * shards + len(list(self.folder.glob("samples/*.h5")))


def memory(process: int) -> float:
    """Return the memory of a process and of all that it started, in MiB."""
    total = 0.0
    with contextlib.suppress(psutil.Error):
        first = psutil.Process(process)
        for each in (first, *first.children(recursive=True)):
            with contextlib.suppress(psutil.Error):
                total += each.memory_info().rss / 2**20
    return total


def others(source: Path, folder: Path, indices: list[int]) -> int:
    """Make samples once more, here, and return how many differ."""
    samples, wanted, differ = DataSet(folder), read_recipe(source), 0
    for index in indices:
        again, found = make_sample(wanted, index).arrays, samples[index].arrays
        differ += set(again) != set(found) or any(again[name].tobytes() != found[name].tobytes() for name in again)
    return differ


def reading_rate(folder: Path, fields: list[str] | None) -> float | None:
    """Return the samples that PyTorch's loader gives each second, on the second reading; None without PyTorch."""
    try:
        import torch

        from mitsuba_plenoptic.extensions.data.torch_data import TorchDataset
    except (ImportError, InputError):
        return None
    # Views differ in number from camera to camera, so each sample is a batch.
    loader = torch.utils.data.DataLoader(TorchDataset(folder, fields), batch_size=None, shuffle=True)
    for _ in range(2):
        start = time.perf_counter()
        total = sum(float(sample["wave"].sum()) for sample in loader)
        seconds = time.perf_counter() - start
    assert np.isfinite(total)
    return len(loader) / seconds


LENSES, PIXELS, PITCH = 32, 8, 0.016

FILL, MLA_DISTANCE = 0.7, 120.0

WAVELENGTH = 633.0

REACH = 3
"""Lenses across the neighbourhood that a model sees."""

PLACES = (-0.6, 0.0, 0.6)
"""Of the pinholes along each axis, in radii of the pupil."""

PENALTIES = 10.0 ** np.arange(-6, 1)

HELD_BACK, JUDGED = 0.25, 0.25

SPP = 64

FIGURES = {
    "best pixel": ("one pixel", "0.6"),
    "ray twin": ("trained on rays", "tab:orange"),
    "convolved twin": ("trained on convolved rays", "tab:red"),
    "wave twin": ("trained on waves", "tab:blue"),
    "rays on rays": ("rays, judged on rays", "tab:green"),
}
"""Names, headings and colours of the errors."""


@case(
    "wave-training",
    "Errors of synthesised views over their mean: models trained on wave captures, ray captures and convolved ones, "
    "judged on wave captures",
    {
        "microlenses": "f/{f_number:g}", "spot (pixels)": "{spot:.1f}",
        **{heading: f"{{{key.replace(' ', '_')}}}" for key, (heading, _) in FIGURES.items()}, "gain": "{gain}",
    },
    page="docs/guides/wave_training.md",
    quick={"captures": 4, "seeds": 2, "f_number": (8.0,)},
)  # fmt: skip
def wave_training(
    output: Path, *, captures: int = 16, seeds: int = 5, f_number: tuple[float, ...] = (4.0, 8.0, 16.0)
) -> Iterator[Row]:
    """Run seeds for each f-number of the microlenses; a quarter of the captures of each judge."""
    rows: list[Row] = []
    for f in f_number:
        own = [study(output / "data" / f"f{f:g}_{captures}_{seed}", f, seed, captures) for seed in range(seeds)]
        rows += own
        camera = training_recipe(f, 0, 1).plan(0).camera
        found: Row = {"f_number": f, "spot": design.spot_radius(camera, WAVELENGTH) / camera.pixel_size, "seeds": own}
        for key in (*FIGURES, "gain"):
            values = [row[key] for row in own]
            found[key.replace(" ", "_")] = f"{np.mean(values):.1%} +- {np.std(values, ddof=1):.1%}"
        yield found
    picture(output / "wave_training.png", rows, f_number)


def training_recipe(f_number: float, seed: int, count: int) -> Recipe:
    """Return the recipe of the captures of one seed."""
    width = LENSES * PITCH
    return parse_recipe(
        {
            "name": f"f/{f_number:g}, seed {seed}",
            "seed": seed,
            "count": count,
            "camera": {
                "mla_pitch": PITCH,
                "mla_focal_length": f_number * PITCH,
                "aperture_radius": FILL * MLA_DISTANCE / f_number / 2,
                "detector_width": width,
                "resolution": [LENSES * PIXELS, LENSES * PIXELS],
                "lens_model": "parabolic",
            },
            "scenes": [{"generator": "shapes", "objects": {"from": 4, "to": 10, "step": 1}, "plain": 0.1}],
            "noise": {"photons": 2000},
            "ray": {"spp": 32},
            "wave": {"spp": 32, "wavelength": WAVELENGTH},
            "truth": [],
        }
    )


def pinhole_views(scene: Any, camera: PlenopticCamera) -> np.ndarray:
    """Render what pinholes on the pupil see, one pixel a lens: (rows, columns, views)."""
    focus, sensor = camera.focus_distance, scene.sensors()[0]
    to_world = mi.ScalarTransform4f(np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4))
    width = camera.detector_width * focus / camera.mla_distance
    film = {"type": "hdrfilm", "width": LENSES, "height": LENSES, "rfilter": {"type": "box"}}
    views = []
    for v in PLACES:
        for u in PLACES:
            x, y = u * camera.aperture_radius, v * camera.aperture_radius
            pinhole = mi.load_dict(
                {
                    "type": "perspective",
                    "fov": math.degrees(2 * math.atan(width / 2 / focus)),
                    "principal_point_offset_x": x / width,
                    "principal_point_offset_y": y / width,
                    "to_world": to_world @ mi.ScalarTransform4f().translate([x, y, 0]),
                    "film": {**film, "pixel_format": "luminance", "component_format": "float32"},
                }
            )
            views.append(np.array(mi.render(scene, sensor=pinhole, spp=SPP))[..., 0])
    return np.stack(views, axis=-1)


def neighbourhoods(capture: np.ndarray) -> np.ndarray:
    """Return the pixels of the lenses around each that is not at the border: (lenses, pixels)."""
    windows = sliding_window_view(capture, (REACH * PIXELS, REACH * PIXELS))[::PIXELS, ::PIXELS]
    return windows.reshape(-1, (REACH * PIXELS) ** 2).astype(np.float64)


def ridge(inputs: np.ndarray, outputs: np.ndarray, penalty: float) -> np.ndarray:
    """Fit a linear model; the penalty is relative to the mean power of an input."""
    gram = inputs.T @ inputs
    gram.flat[:: len(gram) + 1] += penalty * np.trace(gram) / len(gram)
    return np.linalg.solve(gram, inputs.T @ outputs)


def error(model: np.ndarray, inputs: np.ndarray, outputs: np.ndarray) -> float:
    """Return the root mean square error of what a model predicts, over the mean of the truth."""
    return float(np.sqrt(np.mean(np.square(inputs @ model - outputs))) / outputs.mean())


def train(inputs: np.ndarray, outputs: np.ndarray, rows: int) -> np.ndarray:
    """Fit with the penalty that is best for captures that are held back, and then with all; `rows` a capture."""
    count = len(inputs) // rows
    kept = rows * (count - max(1, round(HELD_BACK * count)))
    fitted = [
        error(ridge(inputs[:kept], outputs[:kept], penalty), inputs[kept:], outputs[kept:]) for penalty in PENALTIES
    ]
    return ridge(inputs, outputs, float(PENALTIES[int(np.argmin(fitted))]))


def best_pixel(inputs: np.ndarray, outputs: np.ndarray) -> np.ndarray:
    """Return the model that takes, for each view, the one pixel that explains most of it, scaled."""
    power = np.square(inputs).sum(axis=0)
    product = inputs.T @ outputs
    gained = np.square(product) / np.maximum(power, 1e-12)[:, None]
    model = np.zeros_like(product)
    for view, pixel in enumerate(gained.argmax(axis=0)):
        model[pixel, view] = product[pixel, view] / power[pixel]
    return model


def study(folder: Path, f_number: float, seed: int, count: int) -> Row:
    """Train the twins on the captures of one seed and judge them."""
    wanted = training_recipe(f_number, seed, count)
    samples: DataSet = make_dataset(wanted, folder)
    inputs: dict[str, list[np.ndarray]] = {"ray": [], "convolved": [], "wave": []}
    views = []
    for index, sample in enumerate(samples):
        edge = REACH // 2
        plan = wanted.plan(index)
        found = pinhole_views(open_sample(wanted, plan), sample.camera)[edge:-edge, edge:-edge]
        views.append(found.reshape(-1, len(PLACES) ** 2))
        blurred = Capture(spot_filtered(sample.arrays["ray"].astype(np.float64), plan.camera), plan.camera)
        captures = {
            "ray": sample.capture("ray", exposed=True),
            "convolved": expose(blurred, plan.detector, photons=plan.photons, seed=index),
            "wave": sample.capture("wave", exposed=True),
        }
        for model, patches in inputs.items():
            patches.append(neighbourhoods(captures[model].image))
    rows, training = len(views[0]), count - max(1, round(JUDGED * count))
    truth = np.concatenate(views)
    pixels = {model: np.concatenate(patches) for model, patches in inputs.items()}
    cut = rows * training
    twins = {model: train(pixels[model][:cut], truth[:cut], rows) for model in inputs}
    judged = pixels["wave"][cut:], truth[cut:]
    errors = {f"{model} twin": error(twins[model], *judged) for model in inputs}
    errors["rays on rays"] = error(twins["ray"], pixels["ray"][cut:], truth[cut:])
    errors["best pixel"] = error(best_pixel(pixels["wave"][:cut], truth[:cut]), *judged)
    return {"f_number": f_number, "seed": seed, **errors, "gain": 1 - errors["wave twin"] / errors["ray twin"]}


def picture(path: Path, rows: list[Row], f_numbers: tuple[float, ...]) -> None:
    """Draw the errors of the twins, seed by seed."""
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for shift, (key, (label, colour)) in enumerate(FIGURES.items()):
        places = [f_numbers.index(row["f_number"]) + 0.12 * (shift - 2) for row in rows]
        axes.plot(places, [100 * row[key] for row in rows], "o", color=colour, markersize=4, label=label)
    axes.set_xticks(range(len(f_numbers)), [f"f/{each:g}" for each in f_numbers])
    axes.set_ylabel("error of views, % of their mean")
    axes.set_ylim(bottom=0)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=150)
