"""How long reconstructions take on one core: run as a program of its own, which can be held to one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

from ..errors import InputError
from ..io.captures import read_capture
from ..reconstruction import reconstruct
from ..runtime.variant import set_variant
from .experiment import METHODS

# The methods of the paper's comparison.
TIMED = ("ray", "coherent", "partial")
_REPEATS = 3


def seconds_on_one_core(capture: Path, distance: float) -> dict[str, float]:
    """Time the reconstruction of a capture's file at a distance on one processor core: seconds by method.

    What counts is processor time, which does not grow with what else the machine does, and of several runs the
    shortest, in which kernels are compiled. Where the system allows it (Linux does), the process is held to one core.

    Raises
    ------
    InputError
        If a reconstruction fails.
    """

    def hold() -> None:
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

    answer = subprocess.run(
        [sys.executable, "-m", __name__, str(capture), f"{distance!r}"],
        env={**os.environ, "DRJIT_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        preexec_fn=hold if os.name == "posix" else None,
        capture_output=True,
        text=True,
        check=False,
    )
    if answer.returncode:
        raise InputError(f"timing of {capture}: {answer.stderr.strip().splitlines()[-1]}")
    return dict(json.loads(answer.stdout))


def _main() -> None:
    set_variant(None)
    capture, distance = read_capture(sys.argv[1]), float(sys.argv[2])
    found = {}
    for method in METHODS:
        if method.name in TIMED:
            runs = []
            for _ in range(_REPEATS):
                start = time.process_time()
                reconstruct(capture, distance, **method.options)
                runs.append(time.process_time() - start)
            found[method.name] = round(min(runs), 3)
    print(json.dumps(found))


if __name__ == "__main__":
    _main()
