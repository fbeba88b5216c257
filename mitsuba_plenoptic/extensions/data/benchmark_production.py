"""Making a benchmark, with its data card and its contact sheet."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...report.images import enlarge, shrink, write_png
from ...runtime.batches import BatchMap, Progress
from ...runtime.files import write_text
from .contents import (
    CAPTURES,
    DISTANCES,
    FINER,
    HELD_OUT,
    NOISE,
    PUPIL_POINTS,
    Benchmark,
    BenchmarkRecipe,
    central_truth,
    make_entry,
)
from .dataset import DataSet, Recipe, make_dataset
from .dataset_production import inverse_distance
from .scenes import SCENES, WHITE
from .score import TASKS
from .shards import CARD, PREVIEW


def make_benchmark(
    recipe: BenchmarkRecipe,
    folder: str | Path,
    *,
    batch_map: BatchMap | None = None,
    progress: Progress | None = None,
) -> Benchmark:
    """Make a benchmark, or resume an interrupted production with the same bits.

    Parameters
    ----------
    recipe : BenchmarkRecipe
        The recipe, from `benchmark_recipe`.
    folder : path
        Folder of the benchmark, made if missing.
    batch_map, progress : callable, optional
        As for `make_dataset`.

    Raises
    ------
    InputError
        As `make_dataset` does.
    """
    make_dataset(recipe, folder, batch_map=batch_map, progress=progress, make=make_entry, describe=describe_benchmark)
    return Benchmark(folder)


_TEXT = """# {title}

Captures of plenoptic (light-field) cameras, simulated by rays and by waves, with ground truth, to compare methods that
find depth, refocus, or find sharp views. {scenes} scenes by {cameras} cameras; version {version}, seed {seed}.

Licence: Creative Commons Attribution 4.0 International (CC BY 4.0). The program that made it is BSD-3-Clause.

![Each scene by the first camera: sharp view, depth, virtual depth (near is white), ray and wave capture]({preview})

## Scenes

| scene | content |
|---|---|
{scene_table}

All are procedural: positions, textures and brightness follow from the seed. They are the same for all cameras, and lie
between about {near:g} and {far:g} mm. The scene `{white}`, evenly white with radiance 1, is for calibration.

## Cameras

| camera | split | parameters |
|---|---|---|
{camera_table}

Cameras of the split `held_out` must not be used in training. Methods that learn should train on benchmarks of other
seeds, and state them.

## Arrays of a sample

`shards/*.h5` are HDF5 files with one group per sample (`000000`, ...; the scenes in the order above, each by all
cameras, the white one last). Sizes are those of the first sample; all are float32.

| array | shape | meaning |
|---|---|---|
{array_table}

`facts` is UTF-8 JSON: the names of scene, camera and shapes, the camera, and how each capture was made.

## Tasks

| task | array to be found of each capture | ranked by |
|---|---|---|
{task_table}

`mitsuba-plenoptic benchmark score` scores files SCENE/CAMERA/CAPTURE/TASK.npy, such as `{example}`.

## How it was made

Captures have {spp} samples per pixel, with Mitsuba's path tracer (at most eight reflections) in luminance. Wave
captures have the wavelength {wavelength:g} nm and the method {method}. The pictures that are to be found are by
Mitsuba's own `thinlens` and `perspective` cameras, with {truth_spp} samples per pixel. Depth is that of the ray of each
bin of a view. The noise is that of a detector after EMVA 1288: {noise} photons hit a pixel of radiance 1.

The same seed, size and software give the same bits on processors of one kind; `sha256sum -c checksums.sha256` finds
damaged files. Software: {software}.

## Known limits

Scenes are synthetic, small and without colour. Lenses are thin and without aberrations, waves are scalar and
monochromatic, and objects do not diffract. Where glass is seen, depth is that of its front and is not scored. Virtual
depth is traced in plane mirrors only; highlights of glossy surfaces have the depth of the surface. The captures have
noise of their rendering, and so, less, have the pictures that are the truth.
"""

_ARRAYS = {
    **dict.fromkeys(CAPTURES, "capture"),
    "ray": "capture by the ray model",
    "wave": "capture by the wave model",
    "target_refocus": f"pictures of a thin lens focused at {', '.join(f'{one:g}' for one in DISTANCES)} mm",
    "target_views": f"sharp views, {FINER} pixels a bin, from the pupil points (x, y over its radius) "
    + ", ".join(f"({x:g}, {y:g})" for x, y in PUPIL_POINTS),
    "depth": "distance along the axis from the main lens, mm, of the chief ray of each pixel",
    "virtual_depth": "the same, in plane mirrors of the mirror image; mirrors are where it exceeds `depth`",
    "normal": "shading normal, world frame",
    "shape_index": "number of the shape, 0 for none",
}


def describe_benchmark(folder: Path, recipe: Recipe, made: DataSet) -> None:
    """Write the data card and the contact sheet."""
    write_sheet(folder / PREVIEW, Benchmark(folder))
    content, names = recipe.content, [name for name in recipe.content["scenes"] if name != WHITE]
    first = made[0]

    def meaning(name: str) -> str:
        base = name.removeprefix("views_")
        level = name.partition("_")[2]
        if base in _ARRAYS and base != name:
            return f"the same as `{base}`, of the decoded views (v, u, t, s)"
        return f"the same with noise, {NOISE[level]:g} photons" if level in NOISE else _ARRAYS[name]

    near, far = (edge(central_truth(first)["depth"]) for edge in (np.nanmin, np.nanmax))
    software = dict(made.manifest["software"])
    cameras = {
        one["name"]: (
            "held_out" if one["name"] in HELD_OUT else "training",
            ", ".join(f"{key} {value}" for key, value in one.items() if key != "name"),
        )
        for one in content["cameras"]
    }
    text = _TEXT.format(
        title=recipe.name,
        scenes=len(names),
        cameras=len(cameras),
        version=content["benchmark"],
        seed=recipe.seed,
        preview=PREVIEW,
        white=WHITE,
        near=round(float(near)),
        far=round(float(far)),
        scene_table="\n".join(f"| `{name}` | {_sentence(name)} |" for name in names),
        camera_table="\n".join(f"| `{name}` | {split} | {text} |" for name, (split, text) in cameras.items()),
        array_table="\n".join(
            f"| `{name}` | {' x '.join(map(str, array.shape))} | {meaning(name)} |"
            for name, array in sorted(first.arrays.items())
        ),
        task_table="\n".join(f"| `{name}` | {task.words} | `{task.main}` |" for name, task in TASKS.items()),
        example=f"{names[0]}/{next(iter(cameras))}/wave_dim/depth.npy",
        spp=content["size"]["spp"],
        truth_spp=content["size"]["truth_spp"],
        wavelength=recipe.wave["wavelength"],
        method=recipe.wave["method"],
        noise=" or ".join(f"{photons:g} (`{name}`)" for name, photons in NOISE.items()),
        software=", ".join(f"{name} {version}" for name, version in sorted(software.items())),
    )
    write_text(folder / CARD, text)


def _sentence(scene: str) -> str:
    """Return the content of a scene in a few words."""
    return str(SCENES[scene].__doc__).partition("\n")[0].removeprefix("Show ").rstrip(".")


_WIDTH = 192


def write_sheet(path: Path, made: Benchmark) -> None:
    """Write a PNG with a row for each scene by the first camera: view, depth, virtual depth, ray and wave capture."""
    rows = []
    for index in range(0, len(made.entries()), len(made.cameras)):
        sample = made[index]
        truth = central_truth(sample)
        # On one scale, so that both depths compare.
        depths = inverse_distance(np.concatenate([truth["depth"], truth["virtual_depth"]], axis=1))
        pictures = [
            sample.arrays["target_views"][0],
            *np.split(depths, 2, axis=1),
            *(sample.arrays[m] for m in CAPTURES[::3]),
        ]
        rows.append(np.concatenate([_fitted(picture) for picture in pictures], axis=1))
    write_png(path, np.concatenate(rows), peak=1.0)


def _fitted(picture: np.ndarray) -> np.ndarray:
    """Return a picture `_WIDTH` wide and high, enlarged or averaged by whole numbers, with a black border."""
    small = shrink(enlarge(picture, max(1, _WIDTH // len(picture))), _WIDTH)
    room = [(0, _WIDTH - size) for size in small.shape]
    return np.pad(small, room)
