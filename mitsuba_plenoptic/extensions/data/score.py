"""Scores of submitted files against the truth of a benchmark, and the table of several submissions with ranks.

A submission is a folder with a file ``SCENE/CAMERA/CAPTURE/TASK.npy`` (or ``.nc``, ``.exr``) for each answered capture,
such as ``mirror/square/wave_dim/depth.npy``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import skimage.metrics
import xarray as xr

from ...errors import naming, refuse_if, refusing, require_choice
from ...io.exr import read_exr_parts
from ...runtime.files import require_file, require_size
from .contents import CAPTURES, FINER, PUPIL_POINTS, Benchmark, central_truth
from .dataset import Sample

BOUNDS = (0.01, 0.03, 0.07)
"""Relative errors beyond which a depth is bad."""

_MARGIN = 8
"""Parts of the field of which one at each border is not scored: neighbouring views do not see it."""

_PERFECT = 100.0
"""Peak signal-to-noise ratio in decibels that counts as perfect."""

_WINDOW = 7

_LARGEST = 2**28
"""Bytes of a submitted file at most."""

Scores = dict[str, float]


def inner(size: int) -> slice:
    """Return the part of an axis of the field that is scored."""
    return slice(size // _MARGIN, size - size // _MARGIN)


def depth_scores(found: np.ndarray, truth: dict[str, np.ndarray]) -> Scores:
    """Return the scores of a central view's depth map; unknown depths, NaN or infinite, are bad.

    Outside of mirrors and glass: fractions of bad bins, the relative root mean square error and the fraction of the
    depths that are known. In plane mirrors: fractions of bins that are more than 3 % off the mirror image, and off the
    mirror's surface.

    Parameters
    ----------
    found : (t, s) array
        Depths in millimetres.
    truth : dict
        Arrays (t, s): ``depth``, ``virtual_depth``, and ``glass``, which marks the bins that are left out.
    """
    part = tuple(inner(size) for size in found.shape)
    found = np.asarray(found, np.float64)[part]
    surface, image, glass = (truth[name][part] for name in ("depth", "virtual_depth", "glass"))
    known, mirror = np.isfinite(surface), image > surface
    with np.errstate(invalid="ignore", divide="ignore"):
        error, off_image = (np.abs(found / np.where(known, one, np.nan) - 1) for one in (surface, image))
    plain = known & ~mirror & ~glass
    scores = {f"bad_{100 * bound:g}": _fraction(~(error <= bound), plain) for bound in BOUNDS}
    estimated = error[plain & np.isfinite(error)]
    return scores | {
        # Squares of the largest numbers that files can hold would be infinite.
        "rmse": math.hypot(*estimated) / math.sqrt(estimated.size) if estimated.size else math.nan,
        "known": _fraction(np.isfinite(error), plain),
        "mirror_bad_3": _fraction(~(off_image <= BOUNDS[1]), mirror & np.isfinite(image)),
        "mirror_surface_bad_3": _fraction(~(error <= BOUNDS[1]), mirror & np.isfinite(image)),
    }


def _fraction(mask: np.ndarray, region: np.ndarray) -> float:
    """Return the fraction of a region in which a mask is true, NaN for an empty region."""
    return float(mask[region].mean()) if region.any() else math.nan


def picture_scores(found: np.ndarray, truth: np.ndarray) -> Scores:
    """Return means over pictures of the peak signal-to-noise ratio in decibels and of the structural similarity.

    Values are clipped to 0 to 1, so that highlights do not dominate, and NaN counts as 0. Pictures of less than 7
    pixels have no structural similarity.

    Parameters
    ----------
    found, truth : (pictures, rows, columns) array
        The pictures and what they should be.
    """
    part = (slice(None), *(inner(size) for size in truth.shape[1:]))
    pairs = [
        np.clip(np.nan_to_num(np.asarray(each, np.float64)[part], posinf=1.0, neginf=0.0), 0, 1)
        for each in (found, truth)
    ]
    ratios, likenesses = [], []
    for picture, true in zip(*pairs, strict=True):
        error = float(np.mean((picture - true) ** 2))
        ratios.append(min(_PERFECT, -10 * math.log10(error)) if error > 0 else _PERFECT)
        if min(true.shape) >= _WINDOW:
            likeness = skimage.metrics.structural_similarity(picture, true, win_size=_WINDOW, data_range=1.0)
            likenesses.append(float(likeness))
    return {"psnr": float(np.mean(ratios)), "ssim": float(np.mean(likenesses)) if likenesses else math.nan}


@dataclass(frozen=True)
class ScoredTask:
    """A task of the benchmark: the quantity asked of a capture, and the scoring of answers."""

    # In a few words, for the data card.
    words: str
    # The true arrays of a sample, of which those that are scored have the shape of the first.
    truth: Callable[[Sample], Any]
    score: Callable[[np.ndarray, Any], Scores]
    # The score by which submissions are ranked, and whether less of it is better.
    main: str
    less: bool

    def shape(self, truth: Any) -> tuple[int, ...]:
        """Return the shape that an answer must have."""
        return tuple((truth["depth"] if isinstance(truth, dict) else truth).shape)


TASKS = {
    "depth": ScoredTask(
        "distance in mm of each bin of the central view (t, s)", central_truth, depth_scores, "bad_3", True
    ),
    "refocus": ScoredTask(
        "pictures (distance, t, s) refocused to the distances of the target",
        lambda sample: sample.arrays["target_refocus"], picture_scores, "psnr", False,
    ),
    "views": ScoredTask(
        f"{len(PUPIL_POINTS)} sharp views (point, {FINER} t, {FINER} s) from the points of the pupil of the target",
        lambda sample: sample.arrays["target_views"], picture_scores, "psnr", False,
    ),
}  # fmt: skip
"""Tasks by name."""

SUFFIXES = (".npy", ".nc", ".exr")


def read_answer(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    """Read a submitted array, which must have the given shape.

    ``.npy`` and NetCDF 3 (``.nc``, one variable) hold the array itself, OpenEXR (one channel) its pictures one below
    the other.

    Raises
    ------
    InputError
        If the file cannot be read, or the array has another shape.
    """
    require_size(path, _LARGEST)
    with refusing(f"{path}: it cannot be read:"):
        if path.suffix == ".npy":
            found = np.load(path, allow_pickle=False)
            refuse_if(not isinstance(found, np.ndarray), f"{path}: it is an archive (.npz): it must be one array")
        elif path.suffix == ".nc":
            found = xr.load_dataarray(path, engine="scipy").values
        else:
            planes = [plane for part in read_exr_parts(path)[0].values() for plane in part.values()]
            refuse_if(len(planes) != 1, f"{path}: it has {len(planes)} channels: it must have one")
            found = planes[0].reshape(shape) if planes[0].shape == (math.prod(shape[:-1]), shape[-1]) else planes[0]
    refuse_if(found.shape != shape, f"{path}: its shape is {found.shape}: it must be {shape}")
    refuse_if(found.dtype.kind not in "fiu", f"{path}: its type is {found.dtype}: it must be real numbers")
    return np.asarray(found, np.float64)


def answer_folder(folder: Path, made: Benchmark, index: int, capture: str) -> Path:
    """Return the folder of the answers to a capture."""
    return folder.joinpath(*made.name(index), capture)


def score(made: Benchmark, folder: str | Path) -> list[dict[str, Any]]:
    """Return the scores of a submission.

    Parameters
    ----------
    made : Benchmark
        The benchmark.
    folder : path
        The submission. For a kind of capture, such as ``wave_dim``, it may answer a task or not; if it does, it must
        for all scenes and cameras.

    Returns
    -------
    list of dict
        One for each file: ``task``, ``capture``, ``scene``, ``camera``, ``split`` and ``scores`` by name.

    Raises
    ------
    InputError
        If there is no answer, one is missing, misspelled or there twice, or one has a wrong shape.
    """
    folder = Path(folder)
    there = set()
    for path in sorted(folder.glob("*/*/*/*")):
        if path.suffix in SUFFIXES:
            # A misspelled name would be ignored.
            names = [*path.relative_to(folder).parts[:-1], path.stem]
            known = {"scene": made.scenes, "camera": made.cameras, "capture": CAPTURES, "task": TASKS}
            for (kind, choices), name in zip(known.items(), names, strict=True):
                with naming(path):
                    require_choice(kind, name, choices)
            there.add((names[2], names[3]))
    wanted = [(capture, task) for capture in CAPTURES for task in TASKS if (capture, task) in there]
    refuse_if(
        not wanted,
        f"{folder}: it has no answers: they are called SCENE/CAMERA/CAPTURE/TASK.npy, with CAPTURE one of "
        f"{', '.join(CAPTURES)} and TASK one of {', '.join(TASKS)}",
    )
    answers = {
        (index, *key): _answer(answer_folder(folder, made, index, key[0]) / key[1])
        for key in wanted
        for index in made.entries()
    }
    rows = []
    for index in made.entries():
        sample = made[index]
        scene, camera = made.name(index)
        about = {"scene": scene, "camera": camera, "split": sample.facts["draws"]["split"]}
        for capture, name in wanted:
            task = TASKS[name]
            truth = task.truth(sample)
            found = read_answer(answers[index, capture, name], task.shape(truth))
            rows.append({"task": name, "capture": capture, **about, "scores": task.score(found, truth)})
    return rows


def _answer(path: Path) -> Path:
    """Return the file of an answer in any format; refuse a missing file."""
    found = [path.with_suffix(suffix) for suffix in SUFFIXES if path.with_suffix(suffix).exists()]
    refuse_if(len(found) > 1, f"{path}: there are {len(found)} answers: {', '.join(each.name for each in found)}")
    return found[0] if found else require_file(path.with_suffix(".npy"))


@dataclass(frozen=True)
class TableLine:
    """A line of the table: one task, one kind of capture and one split, with the score of each submission."""

    task: str
    capture: str
    split: str
    # Means over scenes and cameras of all scores, by submission.
    means: dict[str, Scores]
    # Ranks by the task's main score, from 1.
    ranks: dict[str, int]


def table(scored: Mapping[str, Sequence[dict[str, Any]]]) -> list[TableLine]:
    """Return mean scores of submissions with their ranks, for each task, kind of capture and split."""
    lines = []
    keys = {(row["task"], row["capture"], row["split"]) for rows in scored.values() for row in rows}
    order = list(TASKS), list(CAPTURES), ["training", "held_out"]
    for key in sorted(keys, key=lambda key: [names.index(part) for names, part in zip(order, key, strict=True)]):
        means = {}
        for name, rows in scored.items():
            scores = [row["scores"] for row in rows if (row["task"], row["capture"], row["split"]) == key]
            if scores:
                means[name] = {metric: _mean([each[metric] for each in scores]) for metric in scores[0]}
        task = TASKS[key[0]]
        sign = 1 if task.less else -1
        values = {name: sign * found[task.main] for name, found in means.items() if not math.isnan(found[task.main])}
        ranks = {name: 1 + sum(other < value for other in values.values()) for name, value in values.items()}
        lines.append(TableLine(*key, means, ranks))
    return lines


def _mean(values: Sequence[float]) -> float:
    """Return the mean of the defined values, NaN if none is defined."""
    known = [value for value in values if not math.isnan(value)]
    return float(np.mean(known)) if known else math.nan
