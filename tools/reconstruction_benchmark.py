"""Times and memory of the reconstructions at the paper's size, on one core.

Two captures of 4096 x 4096 pixels: one with every pixel lit, where nothing can be skipped, and the letters. "FFTs"
are the Fourier transforms that the coherent method performed, the same shapes again on arrays of their own, timed in
the same run. Beside them the paper's seconds, on one core of about 2012.

    python tools/reconstruction_benchmark.py --output out [--capture letters.exr] [--repeats 3]
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

# Before Dr.Jit or a BLAS start their threads.
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
os.environ["DRJIT_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np

from mitsuba_plenoptic import Capture, PlenopticCamera, load_scene, read_capture, reconstruct, render_capture
from mitsuba_plenoptic.reconstruction import _legs

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
        return lambda: reconstruct(capture, distance, wavelength=633.0, **options)

    work = {
        "coherent": run(method="coherent"),
        "FFTs": _bare_transforms(run(method="coherent")),
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
            start = time.perf_counter()
            call()
            seconds[what] = min(seconds[what], time.perf_counter() - start)
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


def _bare_transforms(call: Callable[[], Any]) -> Callable[[], None]:
    """Note which transforms a computation does, and give a callable that does these alone."""
    transform = _legs._fft
    calls: Counter[tuple[tuple[int, ...], int, bool]] = Counter()

    def noted(field: np.ndarray, axis: int, *, inverse: bool = False) -> np.ndarray:
        calls[field.shape, axis, inverse] += 1
        return transform(field, axis, inverse=inverse)

    _legs._fft = noted
    call()
    _legs._fft = transform

    def again() -> None:
        for (shape, axis, inverse), count in calls.items():
            field = np.ones(shape, np.complex64)
            for _ in range(count):
                transform(field, axis, inverse=inverse)
                field[...] = 1

    return again


if __name__ == "__main__":
    main()
