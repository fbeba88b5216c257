"""Time and memory, side by side with what they are measured against: the figures quoted in the README.

Every figure is a ratio of two things timed in turn in the same run, so that it holds on a noisy machine; the table
gives the median over the runs. Written as Markdown and JSON.

    python tools/benchmark.py --output out/benchmark [--resolution 4096] [--runs 7]
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import load_scene, reconstruct, render_capture

Row = dict[str, Any]


def paired(first: Callable[[], object], second: Callable[[], object], runs: int) -> tuple[float, float, float]:
    """Median seconds of both, timed in turn after a warm-up, and the median of their ratios pair by pair."""
    times: list[tuple[float, float]] = []
    for run in range(runs + 1):
        pair = []
        for work in (first, second):
            start = time.perf_counter()
            work()
            pair.append(time.perf_counter() - start)
        if run:
            times.append((pair[0], pair[1]))
    ratio = statistics.median(a / b for a, b in times)
    return statistics.median(a for a, _ in times), statistics.median(b for _, b in times), ratio


def ray_capture(resolution: int, runs: int) -> list[Row]:
    """Compare samples per second of the sensor with those of `thinlens`, same film, same scene, `path`."""
    scene = load_scene("letters", parameters={"resolution": str(resolution)})
    film = scene.sensors()[0].film()
    camera = scene.sensors()[0].camera
    thin_lens = mi.load_dict(
        {
            "type": "thinlens",
            "aperture_radius": camera.aperture_radius,
            "focus_distance": camera.focus_distance,
            "fov": math.degrees(2 * math.atan(camera.detector_width / (2 * camera.mla_distance))),
            "film": film,
        }
    )
    path = mi.load_dict({"type": "path"})

    def render(sensor: Any) -> None:
        # Until the image is computed: rendering returns before that.
        dr.eval(path.render(scene, sensor, seed=0, spp=1))
        dr.sync_thread()

    ours, theirs, ratio = paired(lambda: render(scene.sensors()[0]), lambda: render(thin_lens), runs)
    samples = resolution**2 / 1e6
    return [
        {
            "what": "ray capture, letters, `path`, million samples per second",
            "ours": samples / ours,
            "against": "`thinlens`",
            "theirs": samples / theirs,
            "ratio": 1 / ratio,
        }
    ]


def ray_reconstruction(resolution: int, runs: int) -> list[Row]:
    """Compare refocusing on one core against NumPy's (I * I).sum() over the same image."""
    scene = load_scene("letters", parameters={"resolution": str(resolution)})
    capture = render_capture(scene, spp=1)
    image = capture.image
    threads = dr.thread_count()
    dr.set_thread_count(1)
    rows = []
    for footprint in ("point", "lens"):
        ours, theirs, ratio = paired(
            lambda footprint=footprint: reconstruct(capture, 280.0, footprint=footprint),
            lambda: (image * image).sum(),
            runs,
        )
        rows.append(
            {
                "what": f"ray reconstruction, {footprint} version, one core, ms",
                "ours": 1e3 * ours,
                "against": "`(I * I).sum()`",
                "theirs": 1e3 * theirs,
                "ratio": ratio,
            }
        )
    dr.set_thread_count(threads)
    return rows


def command_memory(resolution: int, spp: int) -> list[Row]:
    """Measure peak memory and time of the command that renders a capture, against the size of the capture itself."""
    folder = tempfile.TemporaryDirectory()
    output = Path(folder.name) / "raw.exr"
    command = ["render", "letters", "-o", str(output), "--spp", str(spp), "-D", f"resolution={resolution}"]
    script = (
        "import resource, sys, time; start = time.perf_counter()\n"
        "from mitsuba_plenoptic.cli import main; status = main(sys.argv[1:])\n"
        "peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "print(status, peak, time.perf_counter() - start)"
    )
    with folder:
        printed = subprocess.run(
            [sys.executable, "-c", script, *command], check=True, capture_output=True, text=True
        ).stdout
    status, peak, seconds = printed.split()[-3:]
    if status != "0":
        raise SystemExit(f"mitsuba-plenoptic {' '.join(command)} ended with status {status}")
    size = resolution**2 * 4 / 2**30
    # ru_maxrss is in KiB on Linux and in bytes on macOS.
    gib = int(peak) / 2**20 if sys.platform != "darwin" else int(peak) / 2**30
    return [
        {"what": f"`render letters --spp {spp}`, GiB", "ours": gib, "against": "the capture's own size", "theirs": size,
         "ratio": gib / size},
        {"what": f"`render letters --spp {spp}`, s", "ours": float(seconds), "against": "", "theirs": None,
         "ratio": None},
    ]  # fmt: skip


def main() -> None:
    """Run all and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out/benchmark"))
    parser.add_argument("--resolution", type=int, default=4096, help="pixels across the detector")
    parser.add_argument("--runs", type=int, default=7, help="counted runs of each")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    mi.set_variant("llvm_ad_mono")
    rows = [
        *ray_capture(arguments.resolution, arguments.runs),
        *command_memory(arguments.resolution, 16),
        *ray_reconstruction(arguments.resolution, arguments.runs),
    ]

    def number(value: float | None) -> str:
        return "" if value is None else f"{value:.3g}"

    lines = [f"{arguments.resolution} x {arguments.resolution} pixels, {dr.thread_count()} threads", ""]
    lines += ["| what | ours | against | theirs | ratio |", "|---|---|---|---|---|"]
    lines += [
        f"| {r['what']} | {number(r['ours'])} | {r['against']} | {number(r['theirs'])} | {number(r['ratio'])} |"
        for r in rows
    ]
    table = "\n".join(lines) + "\n"
    np_version = {"numpy": np.__version__, "mitsuba": mi.__version__}
    (arguments.output / "benchmark.json").write_text(json.dumps({"rows": rows, "versions": np_version}, indent=1))
    (arguments.output / "benchmark.md").write_text(table)
    print(table)


if __name__ == "__main__":
    main()
