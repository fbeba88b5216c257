"""Wave captures of whole scenes at full size: time and memory, and what three wavelengths take over one.

`still_life` in one wavelength and in three, `vitrine` and `letters` in one, 4096 x 4096 pixels, 16 light paths, each in
a process of its own, and an estimate before each. Repeated runs are taken in turn; medians count. Writes a table and a
picture of each; exits with 1 if one is beyond its limit.

    python tools/full_size_captures.py --output out/full_size_captures [--runs 3]
"""

from __future__ import annotations

import multiprocessing
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import accuracy
import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import estimate_capture, load_scene, render_capture
from mitsuba_plenoptic.report.output_files import write_png

LIMITS = {
    ("still_life", "llvm_ad_mono"): (150.0, 4.0),
    ("still_life", "llvm_ad_rgb"): (None, None),
    ("vitrine", "llvm_ad_mono"): (300.0, None),
    ("letters", "llvm_ad_mono"): (None, None),
}
"""Seconds and GiB of each capture."""

TIMES = 2.3
"""Three wavelengths over one."""

COLUMNS = {
    "scene": "{scene}",
    "variant": "{variant}",
    "estimate (s)": "{estimate:.0f}",
    "told after (s)": "{told:.1f}",
    "median (s)": "{seconds:.1f}",
    "all runs (s)": "{runs}",
    "limit (s)": "{limit}",
    "GiB": "{memory:.2f}",
    "limit (GiB)": "{most}",
}


def main() -> int:
    """Capture, and write table and pictures; 1 if something is beyond its limit."""
    parser = accuracy.options("full_size_captures", __doc__, spp=16)
    parser.add_argument("--runs", type=int, default=1, help="of each capture, in turn")
    arguments = accuracy.start(parser)
    found = [{key: _alone(*key, arguments.spp, arguments.output) for key in LIMITS} for _ in range(arguments.runs)]
    rows = []
    for key, (seconds, memory) in LIMITS.items():
        runs = [run[key] for run in found]
        rows.append({
            "scene": key[0],
            "variant": key[1],
            "estimate": runs[0]["estimate"],
            "told": runs[0]["told"],
            "seconds": float(np.median([run["seconds"] for run in runs])),
            "runs": ", ".join(f"{run['seconds']:.1f}" for run in runs),
            "limit": seconds,
            "memory": max(run["memory"] for run in runs),
            "most": memory,
        })  # fmt: skip
    one, three = (
        next(row for row in rows if row["variant"] == f"llvm_ad_{name}")["seconds"] for name in ("mono", "rgb")
    )
    table = accuracy.markdown(COLUMNS, rows)
    table += f"\n\nThree wavelengths take {three / one:.2f} times one (limit {TIMES})."
    accuracy.finish(arguments, rows, table)
    late = [row for row in rows if row["limit"] and row["seconds"] > row["limit"]]
    large = [row for row in rows if row["most"] and row["memory"] > row["most"]]
    return int(bool(late or large or three / one > TIMES))


def _alone(scene: str, variant: str, spp: int, output: Path) -> accuracy.Row:
    """Estimate and capture a scene, each in a process of its own, and tell what it took."""
    row: accuracy.Row = {}
    for work in (_estimate, _capture):
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            row |= process.submit(work, scene, variant, spp, output).result()
    print(f"{scene} {variant}: {row['seconds']:.1f} s, {row['memory']:.2f} GiB", flush=True)
    return row


def _estimate(name: str, variant: str, spp: int, _: Path) -> accuracy.Row:
    mi.set_variant(variant)
    scene = load_scene(name)
    start = time.perf_counter()
    estimate = estimate_capture(scene, model="wave", method="signed_rays", spp=spp).seconds
    return {"estimate": estimate, "told": time.perf_counter() - start}


def _capture(name: str, variant: str, spp: int, output: Path) -> accuracy.Row:
    mi.set_variant(variant)
    scene = load_scene(name)
    start = time.perf_counter()
    image = render_capture(scene, model="wave", method="signed_rays", spp=spp).image
    seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    write_png(output / f"{name}_{variant}.png", image, peak=float(np.percentile(image, 99.5)))
    return {"seconds": seconds, "memory": peak / 2**30}


if __name__ == "__main__":
    sys.exit(main())
