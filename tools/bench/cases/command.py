"""Processor time until the package is imported and the command says something, over that of importing Mitsuba."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections.abc import Iterator

import numpy as np

from .. import Row, at_most, case

_COMPLETE = {"_MITSUBA_PLENOPTIC_COMPLETE": "complete_bash", "COMP_WORDS": "mitsuba-plenoptic re", "COMP_CWORD": "1"}

# What is run, the environment, and the largest ratio.
STARTS: dict[str, tuple[list[str], dict[str, str], float | None]] = {
    "import mitsuba_plenoptic": (["-c", "import mitsuba_plenoptic"], {}, 2.0),
    "--help": (["-m", "mitsuba_plenoptic", "--help"], {}, 3.0),
    "completion of a command": (["-m", "mitsuba_plenoptic"], _COMPLETE, 3.0),
    "a misspelt command": (["-m", "mitsuba_plenoptic", "rendr"], {}, 3.0),
    "render --help": (["-m", "mitsuba_plenoptic", "render", "--help"], {}, 3.0),
    "a misspelt option of render": (["-m", "mitsuba_plenoptic", "render", "--misspelt"], {}, 3.0),
    "reconstruct --help": (["-m", "mitsuba_plenoptic", "reconstruct", "--help"], {}, 3.0),
    "view --help": (["-m", "mitsuba_plenoptic", "view", "--help"], {}, 3.0),
}


@case(
    "command.start",
    "Processor time of a new process, over that of one that imports Mitsuba alone",
    {"what": "{what}", "seconds": "{seconds:.2f}", "over `import mitsuba`": "{ratio:.1f}"},
    (at_most("ratio", "limit"),),
    page="docs/theory/cost.md",
    quick={"runs": 1, "names": ("--help",)},
)
def start(*, runs: int = 7, names: tuple[str, ...] = tuple(STARTS)) -> Iterator[Row]:
    """Start each process several times, in turn with one that imports Mitsuba."""
    for name in names:
        words, environment, limit = STARTS[name]
        times = np.array([(_seconds(["-c", "import mitsuba"], {}), _seconds(words, environment)) for _ in range(runs)])
        ratio = np.median(times[:, 1] / times[:, 0])
        yield {"what": name, "seconds": np.median(times[:, 1]), "ratio": ratio, "limit": limit}


def _seconds(words: list[str], environment: dict[str, str]) -> float:
    """Return the processor time of a process of Python, which may refuse what it is asked."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, *words],
        env={**os.environ, **environment},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
