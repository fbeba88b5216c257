"""Runs that may be stopped: their checkpoints, the handling of Ctrl-C, and the lines of experiments with stages."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from ..runtime import ProgressBar, in_words, is_quiet, moving_bar, plain_lines
from .program import StoppedError, checkpoints, stoppable

if TYPE_CHECKING:
    from ..io import Checkpoint, StageOptions

_log = logging.getLogger(__name__)


def checkpoint_of(output: Path, resume: bool, path: Path | None = None) -> Checkpoint:
    """Return the checkpoint of a command's output, next to it or at `path`, that continues as ``--resume`` says."""
    from ..io import CHECKPOINT_SUFFIX, Checkpoint
    from ..runtime import require_writable

    path = require_writable(path or output.with_name(output.name + CHECKPOINT_SUFFIX))
    checkpoints.append(path)
    return Checkpoint(path, "resume" if resume else "resume_if_same")


@contextlib.contextmanager
def resumable(progress: ProgressBar | None = None, checkpoint: Checkpoint | None = None) -> Iterator[None]:
    """Let a signal that ends the command end a run after its checkpoint is written, and say how to go on.

    A second signal ends it at once. A run without a checkpoint keeps its stages itself.
    """
    stoppable[:] = [checkpoint] if checkpoint else []
    try:
        yield
    except KeyboardInterrupt:
        if checkpoint and not checkpoint.path.exists():
            raise
        done = f" at {100 * progress.fraction:.0f} %" if progress and progress.fraction else ""
        raise StoppedError(f"stopped{done}: the same command goes on from there") from None
    finally:
        stoppable.clear()


@contextlib.contextmanager
def stage_lines(resume: bool) -> Iterator[StageOptions]:
    """Print a line for each finished stage, and show the progress of the current one, while the context is open."""
    from ..io import StageOptions

    with moving_bar() as bar, plain_lines("starting") as line, resumable():
        tasks = {}

        def notify(name: str, done: int, total: int) -> None:
            if name not in tasks:
                if done:
                    line.label = name.replace("_", " ")
                else:
                    line.begin(name.replace("_", " "))
                tasks[name] = bar.add_task(line.label, total=1)
            line(done, total)
            bar.update(tasks[name], completed=done, total=total or 1)

        def finished(name: str, seconds: float, was_there: bool) -> None:
            if name in tasks:
                bar.remove_task(tasks.pop(name))
            if was_there:
                line.skip()
            if not is_quiet():
                bar.console.print(f"{name.replace('_', ' '):<28} {'reused' if was_there else in_words(seconds)}")

        yield StageOptions(notify, finished, resume)
