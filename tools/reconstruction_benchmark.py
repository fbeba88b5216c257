"""Times and memory of the reconstructions at the paper's size, on one core.

Two captures of 4096 x 4096 pixels: one with every pixel lit, where nothing can be skipped, and the letters. "FFTs"
are the Fourier transforms that the coherent method performs, of the same lengths and in the same number, done by SciPy
along the axes of whole arrays in the same run. Times are processor seconds of the process, which runs on one core and
so would take as long on the clock if nobody else used it. Beside them the paper's seconds, on one core of about 2012.

    python tools/reconstruction_benchmark.py --output out [--capture letters.exr] [--repeats 3]
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

# ruff: noqa: E402
# Before Dr.Jit or a BLAS start their threads.
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
os.environ["DRJIT_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np
import scipy.fft

from mitsuba_plenoptic import Capture, PlenopticCamera, load_scene, read_capture, reconstruct, render_capture
from mitsuba_plenoptic.reconstruction._plan import plan
from mitsuba_plenoptic.reconstruction.coherent import lit_window

WAVELENGTH = 633.0
DISTANCES = [210.0, 240.0, 280.0]
PAPER = {"ray, point": 330, "coherent": 65, "K = 2": 195}


def main() -> None:
    """Time everything and write a table as Markdown and JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out/reconstruction_benchmark"))
    parser.add_argument("--capture", type=Path, help="a capture of the letters; default: a ray capture is rendered")
    parser.add_argument("--repeats", type=int, default=3, help="the fastest of so many runs counts")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    letters = read_capture(arguments.capture) if arguments.capture else render_capture(load_scene("letters"), spp=4)
    camera = PlenopticCamera()
    white = Capture(np.random.default_rng(0).random(camera.shape, dtype=np.float32) + 0.1, camera)
    rows = [
        row
        for name, capture in (("all lit", white), ("letters", letters))
        for row in _rows(name, capture, arguments.repeats)
    ]
    (arguments.output / "reconstruction_benchmark.json").write_text(json.dumps(rows, indent=1))
    lines = ["| capture | what | s | ratio | memory so far, GiB | paper, s |", "|---|---|---|---|---|---|"]
    lines += [
        f"| {r['capture']} | {r['what']} | {r['seconds']:.2f} | {r['ratio']} | {r['memory_gib']:.2f} | {r['paper']} |"
        for r in rows
    ]
    text = "\n".join(lines) + "\n"
    (arguments.output / "reconstruction_benchmark.md").write_text(text)
    print(text)


def _rows(name: str, capture: Capture, repeats: int) -> list[dict[str, Any]]:
    def run(distance: float | list[float] = 280.0, **options: Any) -> Callable[[], Any]:
        return lambda: reconstruct(capture, distance, wavelength=WAVELENGTH, **options)

    work = {
        "coherent": run(method="coherent"),
        "FFTs": _bare_transforms(capture, 280.0),
        "K = 2": run(method="partial", interleave=2),
        "coherent, 3 distances": run(DISTANCES, method="coherent"),
        "K = 2, 3 distances": run(DISTANCES, method="partial", interleave=2),
        "auto": run(method="partial", interleave="auto"),
        "ray, point": run(footprint="point"),
        "ray, lens": run(footprint="lens"),
    }
    seconds = dict.fromkeys(work, float("inf"))
    memory = {}
    for _ in range(repeats):
        for what, call in work.items():
            start = time.process_time()
            call()
            seconds[what] = min(seconds[what], time.process_time() - start)
            memory[what] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    ratios = {
        "coherent": f"{seconds['coherent'] / seconds['FFTs']:.2f} of FFTs",
        "K = 2": f"{seconds['K = 2'] / seconds['coherent']:.2f} of coherent",
        "coherent, 3 distances": f"{seconds['coherent, 3 distances'] / 3 / seconds['coherent']:.2f} per distance",
        "K = 2, 3 distances": f"{seconds['K = 2, 3 distances'] / 3 / seconds['K = 2']:.2f} per distance",
    }
    return [
        {
            "capture": name,
            "what": what,
            "seconds": round(seconds[what], 3),
            "ratio": ratios.get(what, ""),
            "memory_gib": round(memory[what], 2),
            "paper": PAPER.get(what, ""),
        }
        for what in work
    ]


def _bare_transforms(capture: Capture, distance: float) -> Callable[[], None]:
    """Do nothing but the transforms of the coherent method."""
    lit = lit_window(capture.image, capture.camera)
    assert lit is not None
    grids = plan(capture.camera, WAVELENGTH, [distance], lit)
    shapes = []
    for leg in (grids.detector, grids.main_lens, *grids.objects):
        x, y = leg.x, leg.y
        shapes += [
            ((y.count, x.padded), 1, False),
            ((y.padded, x.kept), 0, False),
            ((y.kept, x.kept), 0, True),
            ((y.wanted, x.kept), 1, True),
        ]
    memory = np.ones(max(rows * columns for (rows, columns), _, _ in shapes), np.complex64)

    def transforms() -> None:
        for shape, axis, inverse in shapes:
            field = memory[: shape[0] * shape[1]].reshape(shape)
            transform = scipy.fft.ifft if inverse else scipy.fft.fft
            transform(field, axis=axis, overwrite_x=True, workers=1, norm="ortho")

    return transforms


if __name__ == "__main__":
    main()
