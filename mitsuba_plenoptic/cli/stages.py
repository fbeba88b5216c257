"""Progress lines of experiments with several stages."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

from ..runtime.progress import in_words, is_quiet, moving_bar, plain_lines
from .stopping import resumable

if TYPE_CHECKING:
    from rich.progress import TaskID

    from ..report.stage_store import StageOptions


@contextlib.contextmanager
def stage_lines(resume: bool) -> Iterator[StageOptions]:
    """Print a line for each finished stage, and show the progress of the current one, while the context is open."""
    from ..report.stage_store import StageOptions

    with moving_bar() as bar, plain_lines("starting") as line, resumable():
        tasks: dict[str, TaskID] = {}

        def notify(name: str, done: int, total: int) -> None:
            line.label = name.replace("_", " ")
            line(done, total)
            if name not in tasks:
                tasks[name] = bar.add_task(line.label, total=1)
            bar.update(tasks[name], completed=done, total=total or 1)

        def finished(name: str, seconds: float, was_there: bool) -> None:
            if name in tasks:
                bar.remove_task(tasks.pop(name))
            if not is_quiet():
                bar.console.print(f"{name.replace('_', ' '):<28} {'reused' if was_there else in_words(seconds)}")

        yield StageOptions(notify, finished, resume)
