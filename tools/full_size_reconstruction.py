"""Cameras like the Lytro and the Raytrix R12, refocused by waves at full size: time, memory, and pictures.

The scenes `lytro` and `raytrix` are captured by rays and refocused, coherently and lens by lens (`auto`), to the
camera's focus and to infinity, each in a process of its own. The table has the processor time, the peak memory of the
process, and the range of the bins; the pictures are written beside it. Exits with 1 if one takes more memory than it
may or leaves bins that no light reaches.

    python tools/full_size_reconstruction.py --output out [--cameras lytro] [--methods coherent] [--distances inf]
"""

from __future__ import annotations

import math
import multiprocessing
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import accuracy
import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import load_scene, read_capture, reconstruct, render_capture, write_capture
from mitsuba_plenoptic.report.output_files import write_png

METHODS = {"coherent": {"method": "coherent"}, "auto": {"method": "partial", "interleave": "auto"}}
LIMIT = 8.0
"""GiB of a process."""

COLUMNS = {
    "camera": "{camera}",
    "bins": "{columns} x {rows}",
    "method": "{method}",
    "g (mm)": "{distance:g}",
    "CPU s": "{seconds:.0f}",
    "GiB": "{memory:.2f}",
    "limit": "{limit:g}",
    "not reached": "{unreached:.1%}",
    "least, mean, most": "{least:.3f}, {mean:.3f}, {most:.3f}",
}
_WAVELENGTH = 550.0


def main() -> int:
    """Capture, refocus, and write table and pictures; 1 if a reconstruction is beyond its limit."""
    parser = accuracy.options("full_size_reconstruction", __doc__, spp=4)
    parser.add_argument("--cameras", nargs="*", choices=["lytro", "raytrix"], default=["lytro", "raytrix"])
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=list(METHODS))
    parser.add_argument("--distances", type=float, nargs="*", default=[], help="default: the focus, and infinity")
    arguments = accuracy.start(parser)
    rows = []
    for name in arguments.cameras:
        path = arguments.output / f"{name}.exr"
        if not path.exists():
            write_capture(path, render_capture(load_scene(name), model="ray", spp=arguments.spp))
        distances = arguments.distances or [round(float(read_capture(path).camera.focus_distance), 3), math.inf]
        for method in arguments.methods:
            for distance in distances:
                rows.append(_alone(path, method, distance))
                print(accuracy.markdown(COLUMNS, rows[-1:]).splitlines()[-1], flush=True)
    accuracy.finish(arguments, rows, accuracy.markdown(COLUMNS, rows))
    return int(any(row["memory"] > row["limit"] or row["unreached"] for row in rows))


def _alone(path: Path, method: str, distance: float) -> accuracy.Row:
    """Call `_refocus` in a process of its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        return process.submit(_refocus, path, method, distance).result()


def _refocus(path: Path, method: str, distance: float) -> accuracy.Row:
    """Refocus a capture, write its picture, and tell what it took."""
    mi.set_variant("llvm_ad_mono")
    capture = read_capture(path)
    start = time.process_time()
    image = reconstruct(capture, distance, wavelength=_WAVELENGTH, **METHODS[method]).image
    seconds = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    lit = np.nan_to_num(image)
    write_png(path.with_name(f"{path.stem}_{method}_{distance:g}.png"), lit, peak=float(np.percentile(lit, 99.5)))
    return {
        "camera": path.stem,
        "columns": image.shape[1],
        "rows": image.shape[0],
        "method": method,
        "distance": distance,
        "seconds": seconds,
        "memory": peak / 2**30,
        "limit": LIMIT,
        "unreached": float(np.isnan(image).mean()),
        "least": float(np.nanmin(image)),
        "mean": float(np.nanmean(image)),
        "most": float(np.nanmax(image)),
    }


if __name__ == "__main__":
    sys.exit(main())
