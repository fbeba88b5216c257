"""The worth of training on wave captures: view synthesis by a linear model.

From the pixels of 3 x 3 neighbouring lenses of a raw capture, with the noise of a detector, a linear model predicts
what pinhole cameras at nine positions of the pupil see behind the lens in the middle. The truth is rendered by
Mitsuba's own `perspective`. One model is trained on wave captures and its twin on ray captures of the same scenes, each
with the ridge penalty that is best for captures of its own kind that were held back; both are judged on wave captures
of scenes that neither has seen. Every seed has scenes, noise and a split of its own. A third is trained on ray captures
convolved with the diffraction spot of a microlens. Next to the twins stand the model of the rays judged on rays (what
light without diffraction would allow) and the best single pixel, without any model.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from cases import spot_filtered
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.lib.stride_tricks import sliding_window_view

from mitsuba_plenoptic import Capture, PlenopticCamera, design, expose
from mitsuba_plenoptic.dataset import DataSet, Recipe, make_dataset, parse_recipe
from mitsuba_plenoptic.extensions.data.sample import open_sample

from .. import Row, case

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
    page="docs/guides/datasets.md",
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
