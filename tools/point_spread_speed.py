"""Compare the incoherent sum of the letters' radiators with the FFTs it would take, bare, on the same machine.

Writes ``point_spread_speed.md`` and ``.json`` to the folder that ``--output`` names. The bare time is that of the
transforms of every radiator's own patch, complex64, in place, warm, on one thread, divided by the threads.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np
import scipy.fft

from mitsuba_plenoptic.camera import PlenopticCamera
from mitsuba_plenoptic.propagation.fft import resting_drjit, worker_count
from mitsuba_plenoptic.propagation.incoherent import _PatchSum, incoherent_sum
from mitsuba_plenoptic.propagation.patch import ACCURACIES, PatchBatch, Workspace, _blocks

WAVELENGTH = 633.0
GLYPHS = {
    210.0: (".###.", "#...#", "#...#", ".###.", "#...#", "#...#", ".###."),
    240.0: ("#####", "#....", "#....", "####.", "#....", "#....", "#...."),
    280.0: (".#.#.", ".#.#.", "#####", ".#.#.", "#####", ".#.#.", ".#.#."),
}


def letter_radiators(camera: PlenopticCamera, per_lens: int, cell: int) -> np.ndarray:
    """Radiators of three letters at three distances, at the same places of every lens they cover."""
    rng = np.random.default_rng(0)
    phase = (np.arange(per_lens) + rng.uniform()) / per_lens
    inside = np.stack(np.meshgrid(phase, phase), -1).reshape(-1, 2)
    found = []
    for (g, glyph), x in zip(GLYPHS.items(), (-1.6, 0.0, 1.6), strict=True):
        bits = np.kron(np.array([[sign == "#" for sign in row] for row in glyph]), np.ones((cell, cell), bool))
        lens = np.argwhere(bits)[:, ::-1] - np.array(bits.shape)[::-1] // 2 + [round(x / camera.mla_pitch), 0]
        image = ((lens[:, None] + inside[None]) * camera.mla_pitch).reshape(-1, 2)
        found.append(np.column_stack([-image * g / camera.mla_distance, np.full(len(image), g)]))
    return np.concatenate(found)


def bare_time(batch: PatchBatch, repeats: int = 15) -> float:
    """Seconds of one radiator's transforms, on one thread."""
    work, n, m = Workspace(batch), batch.samples, batch.mla_samples
    work.rows[:], work.columns[:], work.field[:] = 0, 0, 0

    def transform(field: np.ndarray, axis: int) -> None:
        scipy.fft.ifft(field, axis=axis, overwrite_x=True, norm="forward", workers=1)

    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        transform(work.rows, 2)
        transform(work.rows, 2)
        for block in _blocks(n, m):
            columns = work.columns[:, : block.stop - block.start]
            transform(columns, 2)
            transform(columns, 2)
            transform(columns[..., :n], 2)
        for block in _blocks(n, n):
            transform(work.field[..., block], 1)
        times.append(time.perf_counter() - start)
    return float(np.median(times)) / batch.together


def measure(camera: PlenopticCamera, positions: np.ndarray, accuracy: str) -> dict[str, Any]:
    """Time the sum and the bare transforms side by side."""
    threads = worker_count()
    weights = np.ones(len(positions))
    work = _PatchSum(camera, positions, weights[:, None], None, WAVELENGTH, ACCURACIES[accuracy])
    batches = {}
    for chunk in work.chunks:
        batches.setdefault(int(work.placement.samples[chunk[0]]), chunk)
    with resting_drjit():
        ready = {size: work._prepare(chunk[:4])[0] for size, chunk in batches.items()}
    before = {size: bare_time(batch) for size, batch in ready.items()}
    start, busy = time.perf_counter(), time.process_time()
    incoherent_sum(camera, positions, weights, wavelength=WAVELENGTH, accuracy=accuracy)
    seconds, busy = time.perf_counter() - start, time.process_time() - busy
    after = {size: bare_time(batch) for size, batch in ready.items()}
    bare = {size: (before[size] + after[size]) / 2 for size in ready}
    members = work.last - work.first
    every = sum(bare[int(size)] * count for size, count in zip(work.placement.samples, members, strict=True))
    own = sum(bare[int(size)] for size in work.placement.samples)
    return {
        "accuracy": accuracy,
        "radiators": len(positions),
        "patterns": len(work.positions),
        "sizes": {str(size): 1e3 * value for size, value in sorted(bare.items())},
        "threads": threads,
        "seconds": seconds,
        "cpu_seconds": busy,
        "bare_every": every / threads,
        "bare_patterns": own / threads,
        "ratio": seconds / (every / threads),
        "ratio_patterns": seconds / (own / threads),
        "cpu_ratio": busy / every,
        "cpu_ratio_patterns": busy / own,
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def main() -> None:
    """Measure the letters, and radiators that share nothing, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, required=True, help="folder for the table")
    parser.add_argument("--per-lens", type=int, default=8, help="radiators per lens and axis")
    parser.add_argument("--cell", type=int, default=5, help="lenses across a stroke of a letter")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    camera = PlenopticCamera()
    letters = letter_radiators(camera, arguments.per_lens, arguments.cell)
    rng = np.random.default_rng(1)
    some = letters[rng.choice(len(letters), min(len(letters), 3000), replace=False)]
    some[:, 2] *= 1 + 1e-3 * rng.standard_normal(len(some))
    measure(camera, some[:20], "standard")  # compiles the kernels
    results = {
        "letters": measure(camera, letters, "standard"),
        "letters, fast": measure(camera, letters, "fast"),
        "nothing shared": measure(camera, some, "standard"),
    }
    lines = [
        "| radiators | number | patterns | ms of bare FFTs by patch width | seconds | over all FFTs | over FFTs done "
        "| CPU seconds | over all FFTs | over FFTs done "
        "| peak GiB |",
        "|" + " --- |" * 11,
    ]
    for name, row in results.items():
        sizes = ", ".join(f"{size}: {value:.2f}" for size, value in row["sizes"].items())
        lines.append(
            f"| {name} | {row['radiators']} | {row['patterns']} | {sizes} | {row['seconds']:.1f} "
            f"| {row['ratio']:.2f} | {row['ratio_patterns']:.2f} "
            f"| {row['cpu_seconds']:.1f} | {row['cpu_ratio']:.2f} | {row['cpu_ratio_patterns']:.2f} "
            f"| {row['peak_gib']:.2f} |"
        )
    (arguments.output / "point_spread_speed.md").write_text("\n".join(lines) + "\n")
    (arguments.output / "point_spread_speed.json").write_text(json.dumps(results, indent=1) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
