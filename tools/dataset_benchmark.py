"""Make a data set of paired captures, kill it twice, resume it, read it back: the table quoted in the documentation.

Samples are captures of the same random shapes by rays and by waves, with depth, normals and camera. The command runs on
worker processes; it is killed, workers too, when a third and when two thirds of the samples are there, and started
again. Some samples, those about the kills among them, are then made once more in this process, and compared bit by bit.
Times are those of the wall clock, the starts after kills in them; what 1,000 samples would take follows from the rate
in the second half, and their memory from its growth.

    python tools/dataset_benchmark.py --output out/dataset_benchmark [--count 100] [--size 512] [--workers 2]
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import accuracy
import mitsuba as mi
import numpy as np
import psutil
import yaml

from mitsuba_plenoptic import InputError
from mitsuba_plenoptic.dataset import DataSet, make_sample, read_recipe

MORE = 1000
"""Samples for which time and memory are extrapolated."""

PIXEL = 0.002
"""Of the paper's camera, in millimetres, of which the benchmark's is a part."""

COMPARED = 6


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
        """Run the command until so many samples are there, and kill it; or to its end."""
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


def same_bits(source: Path, folder: Path, indices: list[int]) -> bool:
    """Make samples once more, here, and compare."""
    samples, wanted = DataSet(folder), read_recipe(source)
    for index in indices:
        again, found = make_sample(wanted, index).arrays, samples[index].arrays
        if set(again) != set(found) or any(again[name].tobytes() != found[name].tobytes() for name in again):
            return False
    return True


def reading_rate(folder: Path, fields: list[str] | None) -> float | None:
    """Return the samples that PyTorch's loader gives each second, on the second reading; None without PyTorch."""
    try:
        import torch

        from mitsuba_plenoptic.dataset.torch_data import TorchDataset
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


def main() -> None:
    """Run the benchmark and write the table."""
    parser: argparse.ArgumentParser = accuracy.options("dataset_benchmark", __doc__)
    parser.add_argument("--count", type=int, default=100, help="samples")
    parser.add_argument("--size", type=int, default=512, help="pixels of a capture along each side")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    arguments = accuracy.start(parser)
    folder, source = arguments.output / "data", arguments.output / "recipe.yaml"
    shutil.rmtree(folder, ignore_errors=True)
    source.write_text(yaml.safe_dump(recipe(arguments.count, arguments.size)))
    run = Run(source, folder, arguments.workers)
    kills = [arguments.count // 3, 2 * arguments.count // 3]
    for count in (*kills, None):
        run.until(count)
    mi.set_variant("llvm_ad_mono")
    spread = np.linspace(0, arguments.count - 1, COMPARED).astype(int).tolist()
    near = [index for kill in kills for index in (kill, kill + 1) if index < arguments.count]
    compared = sorted({*spread, *near})
    # The first samples of a run compile its kernels.
    log = np.array(run.log)
    late = log[log[:, 1] >= kills[1] + 2]
    rate, growth = (np.polyfit(late[:, 1], late[:, column], 1)[0] if len(late) > 2 else np.nan for column in (0, 2))
    rates = {
        name: reading_rate(folder, fields) for name, fields in (("all", None), ("pairs", ["ray", "wave", "depth"]))
    }
    size = sum(path.stat().st_size for path in folder.rglob("*.h5"))

    same = same_bits(source, folder, compared)

    def told(value: float | None, unit: str) -> str:
        return "PyTorch is not installed" if value is None else f"{value:.0f} {unit}"

    rows = [
        ("samples, pairs of captures", f"{arguments.count} of {arguments.size} x {arguments.size} pixels"),
        ("workers", f"{arguments.workers}"),
        ("kills", f"2, at {kills[0]} and {kills[1]} samples"),
        ("time, restarts in it", f"{run.seconds / 60:.1f} min"),
        ("time of one more sample", f"{rate:.1f} s"),
        (f"time of {MORE}, extrapolated", f"{(run.seconds + rate * (MORE - arguments.count)) / 3600:.1f} h"),
        ("largest memory of all processes", f"{log[:, 2].max() / 1024:.1f} GiB"),
        ("its growth per sample", f"{growth:.1f} MiB"),
        (f"samples {', '.join(map(str, compared))} made again", "same bits" if same else "OTHER BITS"),
        ("files that differ from their checksums", f"{len(DataSet(folder).damaged())}"),
        ("size of a sample", f"{size / arguments.count / 2**20:.1f} MiB"),
        ("read by PyTorch, all arrays", told(rates["all"], "samples/s")),
        ("read by PyTorch, both captures and depth", told(rates["pairs"], "samples/s")),
    ]  # fmt: skip
    table = [{"what": what, "found": found} for what, found in rows]
    accuracy.finish(arguments, table, accuracy.markdown({"what": "{what}", "found": "{found}"}, table))


if __name__ == "__main__":
    main()
