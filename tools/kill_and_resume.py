"""Kill a small wave capture at random moments, resume it, and compare with a capture that was left in peace.

Each trial starts the command, kills it (SIGKILL) at a random moment between the beginning of the sum, or a little
earlier, and its end, and resumes it. Checkpoints are written all the time instead of every ten seconds. Prints a table;
the exit status is 1 if a single bit differs or anything is left behind.

    python tools/kill_and_resume.py [--kills 20] [--seed 0]
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SCENE = {"resolution": "512", "detector_width": "1.024", "letter_scale": "0.125"}
# A fast clock decides when a checkpoint is due, so that they are written as often as their share of the time allows.
COMMAND = """
import sys, time
from unittest import mock
from mitsuba_plenoptic import cli
clock = time.monotonic
if __name__ == "__main__":
    with mock.patch("time.monotonic", lambda: 1e4 * clock()):
        sys.exit(cli.main(sys.argv[1:]))
"""


def start(output: Path, *extra: str) -> subprocess.Popen[str]:
    """Start the capture."""
    words = ["render", "letters", "--model", "wave", "--method", "points", "--spp", "16", *extra]
    words += ["-o", str(output), *(word for name, value in SCENE.items() for word in ("-D", f"{name}={value}"))]
    return subprocess.Popen(
        [sys.executable, "-c", COMMAND, *words], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )


def finish(process: subprocess.Popen[str]) -> str:
    """Wait for a run that must succeed, and return what it printed."""
    _, errors = process.communicate()
    if process.returncode:
        raise SystemExit(f"the capture ended with status {process.returncode}:\n{errors}")
    return errors


def await_sum(process: subprocess.Popen[str], checkpoint: Path) -> None:
    """Wait until a run has written its first checkpoint."""
    while process.poll() is None and not checkpoint.exists():
        time.sleep(0.02)


def kill_after(process: subprocess.Popen[str], seconds: float) -> bool:
    """Kill a run some seconds after its start; return whether it was still running."""
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.kill()
    process.communicate()
    return process.returncode < 0


def main() -> int:
    """Run the trials."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20, help="trials")
    parser.add_argument("--seed", type=int, default=0, help="of the random moments")
    arguments = parser.parse_args()
    rng = random.Random(arguments.seed)
    worst = 0
    with tempfile.TemporaryDirectory() as name:
        clean, output = Path(name) / "clean.exr", Path(name) / "raw.exr"
        checkpoint = Path(f"{output}.checkpoint")
        began = time.perf_counter()
        process = start(clean)
        await_sum(process, Path(f"{clean}.checkpoint"))
        first = time.perf_counter() - began
        finish(process)
        duration = time.perf_counter() - began
        print(f"The clean run took {duration:.1f} s, {first:.1f} s of them to its first checkpoint.\n")
        print("| trial | killed after, s | checkpoint, KiB | resumed from it | same bits |\n|---|---|---|---|---|")
        for trial in range(1, arguments.kills + 1):
            moment = rng.uniform(0.9 * first, duration)
            while not kill_after(start(output), moment):
                # The run was faster than the moment: again, sooner.
                output.unlink()
                moment *= 0.9
            size = checkpoint.stat().st_size // 1024 if checkpoint.exists() else 0
            resumed = "resuming from there" in finish(start(output, "--resume"))
            same = output.read_bytes() == clean.read_bytes()
            left = sorted(path.name for path in Path(name).iterdir() if path not in (clean, output))
            worst |= not same or bool(left) or resumed != bool(size)
            verdict = ("yes" if same else "NO") + (f", but left {', '.join(left)}" if left else "")
            print(f"| {trial} | {moment:.2f} | {size or '-'} | {'yes' if resumed else 'no'} | {verdict} |", flush=True)
            output.unlink()
    return worst


if __name__ == "__main__":
    sys.exit(main())
