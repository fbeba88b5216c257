"""Run on a CUDA device what the tests run with a stand-in, and captures of full size; write one table of the results.

Each check has a process of its own and a time limit: none can stop the others, and the whole takes at most 30 minutes.
The small works run several at a time, so that their times and peaks of memory are upper bounds.
Without a device, the table says "not run" of each. ``--dry-run`` tries the script itself anywhere: on the processor, at
a small size, with nothing installed.

    python tools/first_gpu_run.py [--wheels FOLDER] [-o FOLDER] [--only WORD] [--dry-run]

No network is needed: this package, CuPy, and what else is missing, is installed from the wheels in a folder.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests/runtime")]

SECONDS = 1800.0
"""Time of all checks together."""

DRY_SIZE = {"resolution": "128"}
"""Parameters of the scenes in a dry run."""

SCENES = ("letters", "still_life", "vitrine")
MODELS = ("ray", "wave")

DIFFERENCE = 1e-4
"""Largest relative difference (L2) of the same work on the processor and on the device."""

MEANS, SIGMAS = 1e-3, 3.0
"""Largest relative difference of the means of captures of a scene, beside so many standard deviations of its noise."""

NOISE = (0.9, 1.1)
"""Limits of the RMS of the differences of such captures over the RMS of their estimated noise.

Both are sums over all pixels first: four passes estimate a single pixel's noise so badly that the RMS of the quotients
is 1.6 for two seeds on one processor.
"""

WORKERS = max(1, min(8, (os.cpu_count() or 1) // 2))
"""Works that run at a time."""

DRY = "llvm_ad_mono"
"""Variant of a dry run."""

Row = dict[str, Any]
Check = tuple[float, Callable[[str, bool], Row]]
"""The seconds that a check may take, and its function of the variant and of whether the run is a dry one."""


def works() -> dict[str, Callable[[], list[np.ndarray]]]:
    """Return the works of all kinds that the tests run with the stand-in."""
    import test_cuda

    return test_cuda.WORKS | test_cuda.ADJOINTS


def checks() -> dict[str, Check]:
    """Return all checks by name, in order."""
    return {
        "doctor": (120.0, lambda variant, dry: command("-m", "mitsuba_plenoptic", "doctor")),
        **{
            f"scene: {scene}, {model}": (
                300.0,
                lambda variant, dry, scene=scene, model=model: compare(scene, model, variant, DRY_SIZE if dry else {}),
            )
            for scene in SCENES
            for model in MODELS
        },
        **{f"agreement: {name}": (60.0, lambda variant, dry, name=name: agreement(name, variant)) for name in works()},
        "bench: speed.gpu": (
            240.0,
            lambda variant, dry: command("-m", "tools.bench", "run", "speed.gpu", *["--quick"] * dry),
        ),
        "tests marked gpu": (
            420.0,
            lambda variant, dry: command("-m", "pytest", "-q", "-m", "gpu", "-n", str(WORKERS), "tests/runtime"),
        ),
    }


def command(*words: str) -> Row:
    """Run a command of the repository, and return whether it succeeded and the end of what it printed."""
    answer = subprocess.run(
        [sys.executable, *words], cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )
    lines = (answer.stdout + answer.stderr).strip().splitlines()
    note = lines[-1] if lines else ""
    # Tests that are all skipped have not passed, and a case of the bench may refuse to run.
    unseen = "NOT RUN" in note or ("skipped" in note and " passed" not in note and "failed" not in note)
    return {"passed": None if unseen else answer.returncode == 0, "note": note, "output": lines[-60:]}


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
    difference = max(apart(ours, theirs) for ours, theirs in zip(found, expected, strict=True))
    return {"passed": difference <= DIFFERENCE, "difference": difference, "cold": cold, "warm": warm, "peak": peak[0]}


def apart(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return the relative difference (L2) of two arrays, infinite where one alone has bins that are not known."""
    known = np.isfinite(theirs)
    if not np.array_equal(known, np.isfinite(ours)):
        return float("inf")
    return float(np.linalg.norm((ours - theirs)[known]) / (np.linalg.norm(theirs[known]) or 1.0))


def compare(scene: str, model: str, variant: str, parameters: dict[str, str]) -> Row:
    """Compare captures of a scene by the processor and the device: means and noise with other seeds, and with one seed.

    With one seed both trace the same rays, of which a few meet another surface after rounding.
    """
    from device_stand_in import forget

    from mitsuba_plenoptic import load_scene, render_capture

    def capture(variant: str, seed: int) -> Any:
        forget()
        loaded = load_scene(scene, variant=variant, parameters=parameters)
        return render_capture(loaded, model=model, spp=16, seed=seed, noise=True)

    with peak_memory() as peak:
        cold, ours = timed(lambda: capture(variant, 1))
        warm, _ = timed(lambda: capture(variant, 1))
    theirs, alike = capture("llvm_ad_mono", 2), capture("llvm_ad_mono", 1)
    means = float(ours.image.mean() / theirs.image.mean() - 1)
    rms = over_noise(ours, theirs)
    noise = float(np.hypot(*(np.sqrt(np.sum(each.noise**2)) / each.image.sum() for each in (ours, theirs))))
    passed = abs(means) <= MEANS + SIGMAS * noise and NOISE[0] <= rms <= NOISE[1]
    figures = {"means": means, "over_noise": rms, "cold": cold, "warm": warm, "peak": peak[0]}
    return {
        "passed": passed,
        "difference": apart(ours.image, alike.image),
        **figures,
        "note": f"noise of the means {noise:.1e}",
    }


def over_noise(one: Any, other: Any) -> float:
    """Return the RMS of the difference of two captures over the RMS of its estimated noise."""
    difference = (one.image - other.image).astype(np.float64)
    return float(np.linalg.norm(difference) / np.linalg.norm(np.hypot(one.noise, other.noise).astype(np.float64)))


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Return the seconds that some work takes, with all that was started for it, and its result."""
    import drjit as dr

    start = time.perf_counter()
    result = work()
    dr.sync_thread()
    # Rays need no CuPy; where it is missing, nothing of it is at work.
    if cupy := sys.modules.get("cupy"):
        cupy.cuda.Device().synchronize()
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


def install(wheels: Path, dry: bool) -> Row:
    """Install this package, what it needs, and CuPy from a folder of wheels; in a dry run, see whether that works."""
    cupy = "cuda13" if list(wheels.glob("cupy_cuda13x*")) else "cuda"
    words = ["-m", "pip", "install", "--disable-pip-version-check", "--no-index", "--find-links", str(wheels)]
    words += ["--no-build-isolation", *["--dry-run"] * dry]
    return command(*words, "-e", f"{ROOT}[{cupy}]", "pytest", "pytest-xdist")


def in_own_process(name: str, variant: str, seconds: float, dry: bool) -> Row:
    """Run one check in a process of its own, with kernels not compiled yet, and return its row."""
    start = time.perf_counter()
    row: Row = {"passed": False}
    with tempfile.TemporaryDirectory() as home:
        # Dr.Jit and CuPy keep compiled kernels in the home folder.
        answer = Path(home) / "row.json"
        words = [sys.executable, __file__, "--variant", variant, "--check", name, "--row", str(answer)]
        words += ["--dry-run"] * dry
        environment = os.environ | {"HOME": home, "CUPY_CACHE_DIR": f"{home}/cupy", "PYTHONPATH": str(ROOT)}
        try:
            status, lines = ended(words, environment, seconds)
            row["note"] = lines[-1] if lines else f"exit status {status}"
            row["output"] = lines[-60:]
            if answer.exists():
                row = json.loads(answer.read_text())
        except subprocess.TimeoutExpired:
            row["note"] = f"stopped after {seconds:.0f} s"
        except (OSError, ValueError) as error:
            row["note"] = f"{type(error).__name__}: {error}"
    return row | {"seconds": time.perf_counter() - start}


def ended(words: list[str], environment: dict[str, str], seconds: float) -> tuple[int, list[str]]:
    """Return the exit status and the errors of a command; one that takes too long is killed with all it has started."""
    with subprocess.Popen(
        words,
        cwd=ROOT,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            _, errors = process.communicate(timeout=seconds)
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            raise
    return process.returncode, errors.strip().splitlines()


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
    parser.add_argument("--dry-run", action="store_true", help="try the script on the processor, at a small size")
    parser.add_argument("--variant", default="cuda_ad_mono", help=argparse.SUPPRESS)
    parser.add_argument("--check", help=argparse.SUPPRESS)
    parser.add_argument("--row", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    dry = options.dry_run
    variant = DRY if dry else options.variant
    if options.check:
        options.row.write_text(json.dumps(checks()[options.check][1](variant, dry)))
        return
    end = time.perf_counter() + SECONDS
    rows = {"wheels": install(options.wheels, dry)} if options.wheels else {}
    problem = device_problem(variant)
    device = "the processor, at a small size: a dry run, whose figures say nothing" if dry else device_name()
    options.output.mkdir(parents=True, exist_ok=True)
    chosen = {name: seconds for name, (seconds, _) in checks().items() if options.only in name}
    rows |= {name: {"note": problem or "no time was left"} for name in chosen}

    def run(name: str) -> None:
        left = end - time.perf_counter()
        if not problem and left >= 10:
            rows[name] = in_own_process(name, variant, min(chosen[name], left), dry)

    for together, names in itertools.groupby(chosen, lambda name: name.startswith("agreement")):
        with ThreadPoolExecutor(WORKERS if together else 1) as pool:
            for _ in pool.map(run, names):
                (options.output / "table.md").write_text(table(rows, device))
                (options.output / "rows.json").write_text(json.dumps(rows, indent=1))
    print(table(rows, device))


if __name__ == "__main__":
    main()
