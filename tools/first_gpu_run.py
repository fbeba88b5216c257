"""Run on a CUDA device, for the first time, what has only run with a stand-in; write one table of what came of it.

Each check has a process of its own and a time limit: none can stop the others, and the whole takes at most 30 minutes.
Without a device, the table says "not run" of each. ``--variant llvm_ad_mono`` tries the script itself anywhere.

    python tools/first_gpu_run.py [--wheels FOLDER] [-o FOLDER] [--only WORD]

No network is needed: CuPy, and what else is missing, is installed from the wheels in a folder.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests/runtime")]

SECONDS = 1800.0
"""Time of all checks together."""

SCENES = ("letters", "still_life", "vitrine")
MODELS = ("ray", "wave")

DIFFERENCE = 1e-4
"""Largest relative difference (L2) of the same work on the processor and on the device."""

MEANS = 1e-3
"""Largest relative difference of the means of captures of a scene."""

NOISE = (0.9, 1.1)
"""Limits of the differences of such captures over their estimated noise, as RMS, over that of two by the processor.

The estimate is one of few samples: two captures of the letters by waves on the processor have 0.68, by rays 1.03.
"""

Row = dict[str, Any]
Check = tuple[float, Callable[[str], Row]]
"""The seconds that a check may take, and its function of the variant."""


def works() -> dict[str, Callable[[], list[np.ndarray]]]:
    """Return the works of all kinds that the tests run with the stand-in."""
    import test_cuda

    return test_cuda.WORKS | test_cuda.ADJOINTS


def checks() -> dict[str, Check]:
    """Return all checks by name, in order."""
    return {
        "doctor": (120.0, lambda variant: command("-m", "mitsuba_plenoptic", "doctor")),
        "tests marked gpu": (420.0, lambda variant: command("-m", "pytest", "-q", "-m", "gpu", "tests/runtime")),
        **{
            f"scene: {scene}, {model}": (
                300.0,
                lambda variant, scene=scene, model=model: compare(scene, model, variant),
            )
            for scene in SCENES
            for model in MODELS
        },
        **{f"agreement: {name}": (90.0, lambda variant, name=name: agreement(name, variant)) for name in works()},
        "bench: speed.gpu": (240.0, lambda variant: command("-m", "tools.bench", "run", "speed.gpu")),
    }


def command(*words: str) -> Row:
    """Run a command of the repository, and return whether it succeeded and the end of what it printed."""
    answer = subprocess.run(
        [sys.executable, *words], cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )
    lines = (answer.stdout + answer.stderr).strip().splitlines()
    return {"passed": answer.returncode == 0, "note": lines[-1] if lines else "", "output": lines[-60:]}


def agreement(name: str, variant: str) -> Row:
    """Compare a work's results with the processor's, and time it with cold and with warm kernels."""
    from device_stand_in import forget

    from mitsuba_plenoptic.runtime.backend import set_variant

    work = works()[name]
    set_variant("llvm_ad_mono")
    expected = work()
    forget()
    set_variant(variant)
    with peak_memory() as peak:
        cold, found = timed(work)
        warm, _ = timed(work)
    difference = max(
        float(np.linalg.norm(ours - theirs) / np.linalg.norm(theirs))
        for ours, theirs in zip(found, expected, strict=True)
    )
    return {"passed": difference <= DIFFERENCE, "difference": difference, "cold": cold, "warm": warm, "peak": peak[0]}


def compare(scene: str, model: str, variant: str) -> Row:
    """Compare captures of a scene at full size by the processor and the device, with other seeds."""
    from mitsuba_plenoptic import load_scene, render_capture

    def capture(variant: str, seed: int) -> Any:
        return render_capture(load_scene(scene, variant=variant), model=model, spp=16, seed=seed, noise=True)

    with peak_memory() as peak:
        cold, ours = timed(lambda: capture(variant, 1))
        warm, _ = timed(lambda: capture(variant, 1))
    theirs, others = capture("llvm_ad_mono", 2), capture("llvm_ad_mono", 3)
    means = float(ours.image.mean() / theirs.image.mean() - 1)
    rms = over_noise(ours, theirs) / over_noise(theirs, others)
    passed = abs(means) <= MEANS and NOISE[0] <= rms <= NOISE[1]
    return {"passed": passed, "means": means, "over_noise": rms, "cold": cold, "warm": warm, "peak": peak[0]}


def over_noise(one: Any, other: Any) -> float:
    """Return the RMS of the difference of two captures over its estimated noise."""
    noise = np.hypot(one.noise, other.noise)
    lit = noise > 0
    return float(np.sqrt(np.mean(((one.image - other.image)[lit] / noise[lit]) ** 2)))


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Return the seconds that some work takes, with all that was started for it, and its result."""
    from mitsuba_plenoptic.runtime.backend import backend

    start = time.perf_counter()
    result = work()
    backend().synchronize()
    return time.perf_counter() - start, result


@contextmanager
def peak_memory() -> Iterator[list[float]]:
    """Yield a list whose number becomes the most GiB of the device taken at a time, 0 without CuPy."""
    most, done = [0.0], threading.Event()
    try:
        import cupy

        free = cupy.cuda.runtime.memGetInfo()[0]
    except Exception:
        yield most
        return

    def watch() -> None:
        while not done.wait(0.02):
            most[0] = max(most[0], (free - cupy.cuda.runtime.memGetInfo()[0]) / 2**30)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield most
    finally:
        done.set()
        watcher.join()


def device_problem(variant: str) -> str:
    """Return why nothing can be run, an empty text where it can."""
    import drjit as dr

    if variant.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        return "no CUDA device"
    return ""


def install(wheels: Path) -> str:
    """Install CuPy and other missing packages from a folder of wheels, and return the last line of the answer."""
    names = ["cupy-cuda13x"] if list(wheels.glob("cupy_cuda13x*")) else ["cupy-cuda12x"]
    words = ["-m", "pip", "install", "--no-index", "--find-links", str(wheels), *names]
    answer = subprocess.run([sys.executable, *words], capture_output=True, text=True)
    return ((answer.stdout + answer.stderr).strip().splitlines() or [""])[-1]


def in_own_process(name: str, variant: str, seconds: float) -> Row:
    """Run one check in a process of its own, with kernels not compiled yet, and return its row."""
    start = time.perf_counter()
    row: Row = {"passed": False}
    with tempfile.TemporaryDirectory() as home:
        # Dr.Jit and CuPy keep compiled kernels in the home folder.
        answer = Path(home) / "row.json"
        words = [sys.executable, __file__, "--variant", variant, "--check", name, "--row", str(answer)]
        environment = os.environ | {"HOME": home, "CUPY_CACHE_DIR": f"{home}/cupy", "PYTHONPATH": str(ROOT)}
        try:
            done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=seconds)
            lines = done.stderr.strip().splitlines()
            row["note"] = lines[-1] if lines else f"exit status {done.returncode}"
            row["output"] = lines[-60:]
            if answer.exists():
                row = json.loads(answer.read_text())
        except subprocess.TimeoutExpired:
            row["note"] = f"stopped after {seconds:.0f} s"
    return row | {"seconds": time.perf_counter() - start}


FIGURES = {
    "difference": "{:.1e}",
    "means": "{:+.1e}",
    "over_noise": "{:.3f}",
    "cold": "{:.2f}",
    "warm": "{:.2f}",
    "peak": "{:.2f}",
}
TITLES = ("check", "result", "difference", "means", "over noise", "cold, s", "warm, s", "peak, GiB", "note")


def table(rows: dict[str, Row], device: str) -> str:
    """Return the rows as one table in Markdown."""
    lines = [f"Device: {device}", "", f"| {' | '.join(TITLES)} |", "|---" * len(TITLES) + "|"]
    for name, row in rows.items():
        verdict = {True: "passed", False: "FAILED", None: "not run"}[row.get("passed")]
        figures = [text.format(row[key]) if key in row else "" for key, text in FIGURES.items()]
        lines.append(f"| {' | '.join([name, verdict, *figures, str(row.get('note', '')).replace('|', '/')])} |")
    return "\n".join(lines) + "\n"


def device_name() -> str:
    """Return the name and the driver of the device, as NVIDIA's tool states them."""
    try:
        words = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
        return subprocess.run(words, capture_output=True, text=True, timeout=20).stdout.strip() or "none"
    except (OSError, subprocess.TimeoutExpired):
        return "none"


def main() -> None:
    """Run all checks, and write the table after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--wheels", type=Path, help="folder of wheels, CuPy's among them")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "build/first_gpu_run", help="folder of the table")
    parser.add_argument("--only", default="", help="run the checks whose names contain a word")
    parser.add_argument("--variant", default="cuda_ad_mono", help=argparse.SUPPRESS)
    parser.add_argument("--check", help=argparse.SUPPRESS)
    parser.add_argument("--row", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.check:
        options.row.write_text(json.dumps(checks()[options.check][1](options.variant)))
        return
    end = time.perf_counter() + SECONDS
    installed = install(options.wheels) if options.wheels else ""
    problem, device = device_problem(options.variant), device_name()
    rows: dict[str, Row] = {"wheels": {"passed": "uccess" in installed or "already" in installed, "note": installed}}
    if not installed:
        rows.clear()
    options.output.mkdir(parents=True, exist_ok=True)
    for name, (seconds, _) in checks().items():
        if options.only not in name:
            continue
        left = end - time.perf_counter()
        if problem or left < 10:
            rows[name] = {"note": problem or "no time was left"}
        else:
            rows[name] = in_own_process(name, options.variant, min(seconds, left))
        (options.output / "table.md").write_text(table(rows, device))
        (options.output / "rows.json").write_text(json.dumps(rows, indent=1))
    print(table(rows, device))


if __name__ == "__main__":
    main()
