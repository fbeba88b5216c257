"""A data set of paired captures that is killed twice, resumed and read back."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import yaml

from mitsuba_plenoptic import InputError
from mitsuba_plenoptic.dataset import DataSet, make_sample, read_recipe

from .. import Row, case, figure

MORE = 1000
"""Samples for which time and memory are extrapolated."""

PIXEL = 0.002
"""Of the paper's camera, in millimetres, of which the benchmark's is a part."""

COMPARED = 6


@case(
    "data-set",
    "A data set made by worker processes, killed when a third and two thirds of it are there, resumed, compared bit by "
    "bit and read by PyTorch",
    page="docs/datasets.md",
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
    yield figure("files that differ from their checksums", len(DataSet(folder).damaged()), at_most=0)
    yield figure("samples", len(DataSet(folder)), at_least=count)
    total = sum(path.stat().st_size for path in folder.rglob("*.h5"))
    yield figure("size of a sample", total / count / 2**20, unit="MiB")
    for name, fields in (("all arrays", None), ("both captures and depth", ["ray", "wave", "depth"])):
        speed = reading_rate(folder, fields)
        if speed is not None:
            yield figure(f"read by PyTorch, {name}", speed, at_least=50, unit="samples/s")


def recipe(count: int, size: int) -> dict[str, Any]:
    """Return the recipe of the benchmark."""
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
