"""What tests of stopped runs share: runs that end in their midst, keepers of their state, and limited processes."""

import contextlib
import copy
import os
import resource
import signal
import subprocess
import sys

import pytest

from mitsuba_plenoptic.io import checkpoints

# The command, with a checkpoint after every batch instead of every ten seconds, and batches handed out one by one.
COMMAND = """
import os, signal, sys
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.io import checkpoints
from mitsuba_plenoptic.runtime import batches, progress
progress.FIRST_LINE = 2.0**20  # no lines that come with time
checkpoints.INTERVAL, checkpoints.FRACTION, batches._GROUP_SAMPLES = 0.0, 1e9, 1
write, last = checkpoints._write, int(os.environ.get("INTERRUPT_AFTER", -1))
def counted(*arguments):
    global last
    write(*arguments)
    last -= 1
    if last == 0:
        os.kill(os.getpid(), signal.SIGINT)
checkpoints._write = counted
sys.exit(main(sys.argv[1:]))
"""


class StoppedError(Exception):
    """Stands in for whatever ends a run."""


@contextlib.contextmanager
def stopped_before(unwanted):
    """Have a checkpoint written after every batch, and the run ended before one that is not wanted.

    `unwanted` is given what this yields: the number of finished sums in each checkpoint that was written.
    """
    write, sums = checkpoints._write, []

    def counted(temporary, run, snapshot, prepared):
        if unwanted(sums):
            raise StoppedError
        write(temporary, run, snapshot, prepared)
        sums.append(snapshot.sums)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoints, "INTERVAL", 0.0)
        patch.setattr(checkpoints, "FRACTION", 1e9)
        patch.setattr(checkpoints, "_write", counted)
        yield sums


class CheckpointStore:
    """Keeps every snapshot of a job, or hands it to a function, and lets the job go on from one."""

    def __init__(self, start=None, save=None):
        self.start, self.kept = start, []
        self.save = save or (lambda snapshot: self.kept.append(copy.deepcopy(snapshot)))

    def begin(self, shape, **facts):
        return copy.deepcopy(self.start)


def start_command(*words, limit=None, interrupt_after=-1):
    """Start the command in a process of its own.

    It may be allowed to write files of limited size only, or be interrupted as by hand after so many checkpoints.
    """

    def prepare():
        # Shells start programs in the background with this signal ignored.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        if limit is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    environment = os.environ | {"DRJIT_NUM_THREADS": "1", "INTERRUPT_AFTER": str(interrupt_after)}
    if limit is not None:
        # What measures the tests' coverage could not write its own file either.
        environment.pop("COVERAGE_PROCESS_CONFIG", None)
    return subprocess.Popen(
        [sys.executable, "-c", COMMAND, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=prepare,
        env=environment,
    )
