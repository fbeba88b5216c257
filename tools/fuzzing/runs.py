"""Checkpoints of runs that were stopped, and grids of sweeps: damaged and lying."""

from __future__ import annotations

import io
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from mitsuba_plenoptic import render_capture
from mitsuba_plenoptic.io import checkpoints as checkpoints
from mitsuba_plenoptic.io.checkpoints import Checkpoint
from mitsuba_plenoptic.report.sweep import check_grid, merge_grids, parse_grid, read_grid

from . import arrays, corpus
from .cases import Case
from .values import NOT_FINITE_TEXTS, mutate, pick

GRID = b"aperture_radius: [3, 4.5, 5]\nwavelength: 633\ndistance: [210.0, 240, 2.8e2]\n"


@cache
def _stopped() -> tuple[Any, bytes, np.ndarray]:
    """Give a scene, the checkpoint of its capture by waves when half was done, and the whole image."""
    scene = arrays.wall(corpus.camera(), 240.0)
    path = Path("stopped.checkpoint")
    seconds, checkpoints.INTERVAL = checkpoints.INTERVAL, 0.0
    kept = Checkpoint(path)
    kept.save = _saving(kept)  # type: ignore[method-assign]
    with kept:
        image = _render(scene, kept).image
        data = path.read_bytes()
    checkpoints.INTERVAL = seconds
    return scene, data, image


def _saving(kept: Checkpoint) -> Any:
    """Write every time that it can."""
    save = kept.save

    def always(snapshot: Any) -> None:
        kept._due = 0.0
        save(snapshot)

    return always


def _render(scene: Any, kept: Checkpoint) -> Any:
    return render_capture(scene, model="wave", spp=1, radiators_per_lens=2, checkpoint=kept)


def checkpoint_case(random: np.random.Generator, folder: Path) -> Case:
    """Make a checkpoint that is damaged or lies: refused, or the bits of the whole run."""
    scene, data, image = _stopped()
    forbidden = False
    if random.random() < 0.5:
        data, what = mutate(random, data)
    else:
        name, value = pick(random, LIES)
        data, what, forbidden = _lie(data, name, value), f"{name} = {ascii(value)[:60]}", True
    path = folder / "raw.checkpoint"
    path.write_bytes(data)

    def run() -> Any:
        with Checkpoint(path, "resume") as kept:
            capture = _render(scene, kept)
        assert np.array_equal(capture.image, image), "resumed to other bits"
        return capture

    return Case(what, run, forbidden)


LIES: tuple[tuple[str, Any], ...] = (
    ("format", 99), ("format", "1"), ("sums", -1), ("sums", 10**9), ("sums", "a"), ("sums", 0.5), ("sums", None),
    ("batches", -1), ("batches", 10**9), ("batches", []), ("batches", 0.5), ("arrived", []), ("arrived", None),
    ("run", {}), ("run", None), ("run", []), ("image", np.nan), ("image", np.inf), ("partial", np.nan),
)  # fmt: skip


def _lie(data: bytes, name: str, value: Any) -> bytes:
    """Write a whole checkpoint anew with one thing changed in its header, or one number in an array."""
    with np.load(io.BytesIO(data)) as archive:
        arrays = dict(archive)
    if name in arrays:
        arrays[name].flat[arrays[name].size // 2] = value
    elif name in ("image", "partial"):
        name, value = "format", "nothing to change"
    header = json.loads(str(arrays.pop("header")))
    if name not in arrays:
        header[name] = value
    buffer = io.BytesIO()
    np.savez(buffer, header=json.dumps(header), **arrays)
    return buffer.getvalue()


def grid_case(random: np.random.Generator, folder: Path) -> Case:
    """Make the grid of a sweep that is damaged or forbidden."""
    path = folder / "grid.yaml"
    if random.random() < 0.3:
        data, what = mutate(random, GRID * 3 if random.random() < 0.5 else GRID)
        path.write_bytes(data)
        return Case(f"YAML: {what}", lambda: list(check_grid(read_grid(path)).values()))
    if random.random() < 0.5:
        text = pick(random, BAD_YAML)
        path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8", "surrogatepass"))
        return Case(f"YAML {ascii(text)[:80]}", lambda: check_grid(read_grid(path)), forbidden=True)
    texts = pick(random, BAD_GRIDS)
    return Case(f"--vary {ascii(texts)[:80]}", lambda: check_grid(merge_grids(parse_grid(texts))), forbidden=True)


BAD_YAML: tuple[str | bytes, ...] = (
    "", "[]", "3", "text", "a: []", "a: {b: 1}", "a: [1, [2]]", "a: [true]", "a: [null]", "a: [1, 1]", "a: .nan",
    "a: .inf", "1: [2]", "a b: [1]", "? [1]\n: [2]", "a: !!python/object/apply:os.system ['touch hacked']",
    "a: 2020-01-01", "!!python/name:os.system", "a: [", "\t", "a: *nowhere", b"\xff\xfe\0", b"a: [1]\0",
    "a: [1]\na: [2]",
    "[" * 10_000, "a: [" * 5_000, "x0: &x0 [1, 1]\n" + "".join(f"x{i}: &x{i} [{', '.join([f'*x{i - 1}'] * 10)}]\n"
    for i in range(1, 12)), "a: [" + "0.5, " * 100_000 + "1]", "a: [" + ", ".join(map(str, range(150_001))) + "]",
    "a: " + "9" * 10_000, "a: &a [*a]", "\u202e: [1]", "---\na: 1\n---\nb: 2",
)  # fmt: skip
BAD_GRIDS: tuple[list[str], ...] = (
    [], ["a"], ["=1"], ["a="], ["a=1", "a=2"], ["a=1,1"], ["a=1,"], ["a=,"], ["a=wide"], ["a b=1"], ["1=1"], ["\0=1"],
    ["a=1e999"], ["a=1,2", "b=" + ",".join(map(str, range(60_000)))], *([f"a={text}"] for text in NOT_FINITE_TEXTS),
)  # fmt: skip
