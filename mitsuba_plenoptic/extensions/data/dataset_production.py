"""Production of a data set, sample by sample, so that a killed run resumes where it was."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from ...errors import naming
from ...report import images, plots
from ...runtime import Array, BatchMap, Progress, h5py_module, locked, remove_leftovers, write_text
from .recipe import Recipe
from .sample import Sample, make_sample, open_sample
from .shards import CARD, LOCK, PREVIEW, DataFolder, DataSet, claim, open_shard, read_sample, samples_in, write_samples


@dataclass(frozen=True)
class SampleTask:
    """Task that renders one sample and writes its file, in this process or another."""

    recipe: Recipe
    index: int
    # The file, which a worker elsewhere must see under the same name.
    path: Path

    @property
    def samples(self) -> int:
        """Nominal number of samples, so large that each task is a batch by itself."""
        return 2**62

    def prepare(self) -> Callable[[], int]:
        """Return the function that renders and writes the sample and returns its index."""
        return self.make

    def make(self, progress: Progress | None = None) -> int:
        """Render and write the sample, and return its index."""
        with naming(f"sample {self.index}"):
            write_samples(self.path, [make_sample(self.recipe, self.index, progress)])
        return self.index


def make_dataset(
    recipe: Recipe, folder: str | Path, *, batch_map: BatchMap | None = None, progress: Progress | None = None
) -> DataSet:
    """Make a data set, or resume an interrupted run with the same bits.

    Each sample has a file until all samples of its shard exist. A run that was killed at any moment can be started
    again and ends with the same bytes as an uninterrupted run. A data set of the same recipe with a smaller count
    grows. Only one process at a time may make a data set.

    Parameters
    ----------
    recipe : Recipe
        The recipe, from `read_recipe`.
    folder : path
        Folder of the data set, made if missing.
    batch_map : callable, optional
        Who renders, for example `Cluster`; workers must see folder and scene files under the same names. Default: this
        process.
    progress : callable, optional
        Called with the finished and the total work, in thousandths of a sample.

    Returns
    -------
    DataSet

    Raises
    ------
    InputError
        If the folder holds something else, another process is making it, or a sample cannot be rendered.
    """
    # Before the first sample is rendered, which needs it not before it is written.
    h5py_module("a data set")
    folder = Path(folder).absolute()
    _try_scenes(recipe)
    with locked(folder / LOCK, f"{folder}: another process is making this data set"):
        _produce(recipe, claim(folder, recipe), batch_map, progress)
        data_set = DataSet(folder)
        write_preview(folder / PREVIEW, data_set)
        write_card(folder / CARD, recipe, data_set)
    return DataSet(folder)


def _produce(recipe: Recipe, layout: DataFolder, batch_map: BatchMap | None, progress: Progress | None) -> None:
    """Render the samples that are in no file, and write each shard when its last sample is there."""
    for path in (layout.sample(0).parent, layout.shard(0).parent):
        for leftover in path.glob(".*"):
            shutil.rmtree(leftover, ignore_errors=True)
    for name in (CARD, PREVIEW):
        remove_leftovers(layout.folder / name)
        # They describe a complete data set.
        (layout.folder / name).unlink(missing_ok=True)
    packed = set().union(*(samples_in(layout.shard(shard)) for shard in range(layout.shards)))
    missing = [index for index in range(recipe.count) if index not in packed and not layout.sample(index).exists()]
    waiting = set(missing)

    def pack(shard: int) -> None:
        members = layout.members(shard)
        if waiting.isdisjoint(members) and not packed.issuperset(members):
            write_samples(layout.shard(shard), (read(index) for index in members))
            for index in members:
                layout.sample(index).unlink(missing_ok=True)

    def read(index: int) -> Sample:
        shard = index // layout.samples_per_shard
        path = layout.shard(shard) if index in packed else layout.sample(index)
        with open_shard(path) as file:
            return read_sample(file, path, index)

    tasks = [SampleTask(recipe, index, layout.sample(index)) for index in missing]

    def report(done: int, total: int) -> None:
        if progress:
            finished = recipe.count - len(waiting)
            progress(round(1000 * (finished + done / max(total, 1))), 1000 * recipe.count)

    results = batch_map(tasks) if batch_map and tasks else (task.make(report) for task in tasks)
    for shard in range(layout.shards):
        pack(shard)
    report(0, 1)
    for index in results:
        waiting.discard(index)
        pack(index // layout.samples_per_shard)
        report(0, 1)
    shutil.rmtree(layout.sample(0).parent)


def _try_scenes(recipe: Recipe) -> None:
    """Load one scene of each source of a recipe, so that errors in files are reported before rendering."""
    left = set(range(len(recipe.scenes)))
    for index in range(min(recipe.count, 1000)):
        plan = recipe.plan(index)
        if plan.source in left:
            left.discard(plan.source)
            open_sample(recipe, plan)
        if not left:
            return


_MEANINGS = {
    "ray": "capture by geometric optics",
    "wave": "capture by wave optics (scalar diffraction through both lenses)",
    "ray_exposed": "the capture by rays with the noise of a detector (EMVA 1288)",
    "wave_exposed": "the capture by waves with the noise of a detector (EMVA 1288)",
    "depth": "distance along the axis from the main lens, mm; of the chief ray of each pixel",
    "virtual_depth": "the same, in plane mirrors of the mirror image, mm",
    "position": "where the pixel's chief ray meets the scene, world frame, mm",
    "normal": "shading normal there, world frame",
    "albedo": "diffuse reflectance there",
    "shape_index": "number of the shape there, 0 for none",
    "sharp": "what a small pupil sees through each lens, all in focus; in focus the sum of the photodiodes",
    "lens_depth": "distance along the axis from the main lens, mm; of the chief ray of each lens",
    "blur_radius": "radius, in lenses, of the image of a point at that distance; negative behind the plane in focus",
}

_TEXT = """# {name}

{count} samples of plenoptic (light-field) captures, simulated from the recipe below.
Sample k depends on the seed and k alone: the same recipe and software make the same bits.

![The first samples: captures, and depth with near in white]({preview})

## Contents

`shards/*.h5`: HDF5, one group per sample (`000000`, ...), with these float32 arrays (sizes of the first sample):

{table}

and `facts`, UTF-8 JSON: the camera, all that was drawn, names of the shapes, and how each capture was made. HDF5 keeps
checksums of all these, which are compared when they are read. Pixels are radiance, averaged over the lens. What is
unknown is NaN, the depth of nothing infinite. Arrays `views_...` are ground truth of the decoded views (v, u, t, s), of
the rays that `decode` makes samples of.

## Reading

In this folder:

```python
import mitsuba_plenoptic as mp
import torch  # pip install torch
from mitsuba_plenoptic.dataset import DataSet
from mitsuba_plenoptic.extensions.data.torch_data import TorchDataset

sample = DataSet(".")[0]
light_field = mp.decode(sample.capture("{model}"), truth=sample.truth)
loader = torch.utils.data.DataLoader(TorchDataset(".", {arrays}), batch_size=8, shuffle=True)
```

## What it is good for, and what not

For training and judging what reads light fields (depth, views, refocusing), and for what diffraction and noise do.
Scenes are synthetic: random shapes have neither the statistics nor the materials of photographs. Lenses are thin and
without aberrations but those of the recipe's camera; waves are scalar and monochromatic per channel, and objects do not
diffract. Split by sample number: samples are independent of one another.

## Recipe

```yaml
{recipe}```

Software: {software}; source of mitsuba_plenoptic {version}.
"""


def write_card(path: Path, recipe: Recipe, data_set: DataSet) -> None:
    """Write the data card of a data set as Markdown."""
    lines = ["| array | shape | meaning |", "|---|---|---|"]
    first = data_set[0]
    meanings = _MEANINGS | first.facts.get("arrays", {})
    for name, array in sorted(first.arrays.items()):
        base = name.removeprefix("views_")
        if name in meanings:
            meaning = meanings[name]
        elif base != name:
            meaning = f"the same as `{base}`, of the samples of the views"
        else:
            capture = max((model_array for model_array in _MEANINGS if name.startswith(f"{model_array}_")), key=len)
            meaning = f"sums of the pixels of `{capture}` below each lens that lie {name[len(capture) + 1 :]}"
        lines.append(f"| `{name}` | {' x '.join(map(str, np.shape(array)))} | {meaning} |")
    software = dict(data_set.manifest["software"])
    model = recipe.models[-1]
    names = first.arrays
    pair = [name for name in names if name.startswith(f"{model}_") and "exposed" not in name]
    text = _TEXT.format(
        name=recipe.name,
        count=recipe.count,
        version=software.pop("mitsuba_plenoptic"),
        preview=PREVIEW,
        table="\n".join(lines),
        model=model,
        arrays=json.dumps([*pair, "lens_depth"] if "lens_depth" in names else [model, *({"depth"} & set(names))]),
        recipe=yaml.safe_dump(data_set.manifest["recipe"], sort_keys=False, allow_unicode=True),
        software=", ".join(f"{name} {version}" for name, version in sorted(software.items())),
    )
    write_text(path, text)


def write_preview(path: Path, samples: DataSet) -> None:
    """Write a figure with a labelled row for each of the first eight samples: captures, and depth (near is white)."""
    rows = []
    for index in range(min(8, len(samples))):
        arrays = samples[index].arrays
        depth = arrays.get("lens_depth", arrays.get("depth"))
        pictures = {name: array for name, array in arrays.items() if name.startswith(("ray", "wave"))}
        if "lens_depth" in arrays:
            shape = arrays["lens_depth"].shape
            pictures = {name: array for name, array in pictures.items() if array.shape[:2] == shape}
        peak = max(float(np.percentile(capture, 99.5)) for capture in pictures.values()) or 1.0
        pictures = {name: capture / peak for name, capture in pictures.items()}
        if depth is not None:
            pictures["depth, near in white"] = inverse_distance(depth)
        rows.append({name: images.shrink(picture, 256) for name, picture in pictures.items()})
    first = next(iter(rows[0].values()))
    plot = plots.Plot(1 + 2.0 * len(rows[0]))
    panels = plot.panels(len(rows), len(rows[0]), first.shape[0] / first.shape[1])
    for index, row in enumerate(rows):
        for axes, (name, picture) in zip(panels[index], row.items(), strict=True):
            plots.show(axes, picture, name.replace("_", " ") if index == 0 else "", peak=1.0)
        plots.annotate(panels[index, 0], title=panels[index, 0].get_title("left"), side=f"sample {index}")
    plot.save(path)


def inverse_distance(depth: Array) -> Array:
    """Return inverse depth scaled to the range 0.1 (farthest) to 1 (nearest), and 0 where depth is unknown."""
    finite = np.isfinite(depth)
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=finite & (depth > 0))
    if not finite.any():
        return inverse
    low = inverse[finite].min()
    extent = np.ptp(inverse[finite])
    return np.asarray(np.where(finite, 0.1 + 0.9 * (inverse - low) / max(extent, 1e-12), 0), np.float32)
