"""What commands show on the terminal while they compute; all of it on standard error."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from ..report.stage_store import StageOptions


@contextlib.contextmanager
def progress_bar(label: str) -> Iterator[Callable[[int, int], None]]:
    """Show a bar, if standard error is a terminal; yields a callable(done, total)."""
    console = Console(stderr=True)
    columns = (TextColumn(label), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(label, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


@contextlib.contextmanager
def stage_lines(resume: bool) -> Iterator[StageOptions]:
    """Print a line for each stage that is done, and on a terminal show a bar for the one under way."""
    console = Console(stderr=True, highlight=False)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        tasks: dict[str, TaskID] = {}

        def notify(name: str, done: int, total: int) -> None:
            if name not in tasks:
                tasks[name] = bar.add_task(_words(name), total=None)
            bar.update(tasks[name], completed=done, total=total or None)

        def finished(name: str, seconds: float, was_there: bool) -> None:
            if name in tasks:
                bar.remove_task(tasks.pop(name))
            console.print(f"{_words(name):<28} {'kept' if was_there else f'{seconds:.1f} s'}")

        yield StageOptions(notify, finished, resume)


def _words(name: str) -> str:
    return name.replace("_", " ")
