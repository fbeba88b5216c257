"""The data card, which tells a stranger what a data set holds and how it was made, and the checksums of its files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from ..io.files import atomic_output
from ..report.images import shrink, write_png
from .layout import CARD, MANIFEST, PREVIEW, Layout, checksum
from .reader import DataSet
from .recipe import Recipe

_MEANINGS = {
    "ray": "capture by geometric optics",
    "wave": "capture by wave optics (scalar diffraction through both lenses)",
    "ray_exposed": "the capture by rays with the noise of a detector (EMVA 1288)",
    "wave_exposed": "the capture by waves with the noise of a detector (EMVA 1288)",
    "depth": "distance along the axis from the main lens, mm; of the chief ray of each pixel",
    "position": "where the pixel's chief ray meets the scene, world frame, mm",
    "normal": "shading normal there, world frame",
    "albedo": "diffuse reflectance there",
    "shape_index": "number of the shape there, 0 for none",
}

_TEXT = """# {name}

{count} samples of plenoptic (light-field) captures, simulated from the recipe below.
Sample k depends on the seed and k alone: the same recipe and software make the same bits.

![The first samples: captures, and depth with near in white]({preview})

## Contents

`shards/*.h5`: HDF5, one group per sample (`000000`, ...), with these float32 arrays (sizes of the first sample):

{table}

and `facts`, UTF-8 JSON: the camera, all that was drawn, names of the shapes, and how each capture was made; and
`digests` of all these, which are compared when they are read. Pixels are
radiance, averaged over the lens. What is unknown is NaN, the depth of nothing infinite. Arrays `views_...` are ground
truth of the decoded views (v, u, t, s), of the rays that `decode` makes samples of.

## Reading

```python
from mitsuba_plenoptic.dataset import DataSet
from mitsuba_plenoptic.dataset.torch_data import TorchDataset  # pip install torch

sample = DataSet("{folder}")[0]
light_field = mitsuba_plenoptic.decode(sample.capture("{model}"), truth=sample.truth)
loader = torch.utils.data.DataLoader(TorchDataset("{folder}", ["{model}", "depth"]), batch_size=8, shuffle=True)
```

`sha256sum -c checksums.sha256` finds damaged files.

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


def write_card(path: Path, recipe: Recipe, made: DataSet) -> None:
    """Write the data card as Markdown."""
    lines = ["| array | shape | meaning |", "|---|---|---|"]
    for name, array in sorted(made[0].arrays.items()):
        base = name.removeprefix("views_")
        meaning = _MEANINGS[base] if base == name else f"the same as `{base}`, of the samples of the views"
        lines.append(f"| `{name}` | {' x '.join(map(str, np.shape(array)))} | {meaning} |")
    software = dict(made.manifest["software"])
    text = _TEXT.format(
        name=recipe.name,
        count=recipe.count,
        version=software.pop("mitsuba_plenoptic"),
        preview=PREVIEW,
        table="\n".join(lines),
        folder=recipe.name,
        model=recipe.models[-1],
        recipe=yaml.safe_dump(made.manifest["recipe"], sort_keys=False, allow_unicode=True),
        software=", ".join(f"{name} {version}" for name, version in sorted(software.items())),
    )
    with atomic_output(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_checksums(path: Path, layout: Layout) -> None:
    """Write the SHA-256 of every file of a data set, in the form that ``sha256sum -c`` reads."""
    files = [layout.folder / name for name in (MANIFEST, CARD, PREVIEW)]
    files += [layout.shard(number) for number in range(layout.shards)]
    lines = [f"{checksum(file)}  {file.relative_to(layout.folder).as_posix()}\n" for file in files]
    with atomic_output(path) as temporary:
        temporary.write_text("".join(lines))


_ROWS, _WIDTH = 8, 256


def write_preview(path: Path, samples: DataSet) -> None:
    """Write a PNG with a row for each of the first eight samples: its captures, and depth, near in white."""
    rows = []
    for index in range(min(_ROWS, len(samples))):
        arrays = samples[index].arrays
        captures = [array for name, array in arrays.items() if name.startswith(("ray", "wave"))]
        peak = max(float(np.percentile(capture, 99.5)) for capture in captures) or 1.0
        pictures = [_grey(capture) / peak for capture in captures]
        if "depth" in arrays:
            pictures.append(_nearness(arrays["depth"]))
        rows.append(np.concatenate([shrink(picture, _WIDTH) for picture in pictures], axis=1))
    width = min(row.shape[1] for row in rows)
    write_png(path, np.concatenate([row[:, :width] for row in rows]), peak=1.0)


def _grey(image: np.ndarray) -> np.ndarray:
    return image.mean(axis=2) if image.ndim == 3 else image


def _nearness(depth: np.ndarray) -> np.ndarray:
    """Return the inverse of depths from 0, as far as any, to 1."""
    known = np.isfinite(depth)
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=known & (depth > 0))
    if not known.any():
        return inverse
    low, high = inverse[known].min(), inverse[known].max()
    return np.asarray(np.where(known, 0.1 + 0.9 * (inverse - low) / max(high - low, 1e-12), 0), np.float32)
