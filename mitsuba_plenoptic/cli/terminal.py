"""Progress of commands on standard error, and the handling of Ctrl-C."""

from __future__ import annotations

import contextlib
import logging
import signal
import threading
from collections.abc import Iterator
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from ..io.checkpoints import Checkpoint
from ..report.stage_store import StageOptions
from ..runtime.progress import ProgressBar, plain_lines

_log = logging.getLogger(__name__)


@contextlib.contextmanager
def stopped_by_hand(checkpoint: Checkpoint, progress: ProgressBar) -> Iterator[None]:
    """Let Ctrl-C end a run with its checkpoint written, and say how to resume; a second Ctrl-C ends it at once."""
    # Only the main thread receives signals.
    on_main = threading.current_thread() is threading.main_thread()
    before: Any = signal.getsignal(signal.SIGINT)

    def stop(number: int, frame: Any) -> None:
        signal.signal(signal.SIGINT, before)
        if not checkpoint.stop():
            raise KeyboardInterrupt
        _log.info("stopping after the current batch; Ctrl-C again stops at once")

    if on_main:
        signal.signal(signal.SIGINT, stop)
    try:
        yield
    except KeyboardInterrupt:
        hint = ": resume with --resume" if checkpoint.path.exists() else ""
        _log.info("stopped at %.0f %%%s", 100 * progress.fraction, hint)
        raise
    finally:
        if on_main:
            signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def stage_lines(resume: bool) -> Iterator[StageOptions]:
    """Print a line for each stage that is done, and show the progress of the current one."""
    console = Console(stderr=True, highlight=False)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    with (
        Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar,
        plain_lines("starting") as line,
    ):
        tasks: dict[str, TaskID] = {}

        def notify(name: str, done: int, total: int) -> None:
            line.label = _words(name)
            line(done, total)
            if name not in tasks:
                tasks[name] = bar.add_task(_words(name), total=None)
            bar.update(tasks[name], completed=done, total=total or None)

        def finished(name: str, seconds: float, was_there: bool) -> None:
            if name in tasks:
                bar.remove_task(tasks.pop(name))
            console.print(f"{_words(name):<28} {'reused' if was_there else f'{seconds:.1f} s'}")

        yield StageOptions(notify, finished, resume)


def _words(name: str) -> str:
    return name.replace("_", " ")
