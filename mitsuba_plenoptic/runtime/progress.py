"""A bar that shows the progress of long computations, on terminals and in notebooks."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


class ProgressBar:
    """Takes progress as every long computation of this package reports it, and shows it.

    Attributes
    ----------
    fraction : float
        What was done at the last report, from 0 to 1.
    """

    def __init__(self, bar: Progress, label: str) -> None:
        self.fraction = 0.0
        self._bar, self._task = bar, bar.add_task(label, total=None)

    def __call__(self, done: int, total: int) -> None:
        """Show that so much of the total is done."""
        self.fraction = done / max(total, 1)
        self._bar.update(self._task, completed=done, total=total)


@contextlib.contextmanager
def progress_bar(label: str) -> Iterator[ProgressBar]:
    """Show a bar on standard error, or in the notebook; elsewhere, as in a file, nothing.

    Parameters
    ----------
    label : str
        What is going on.

    Yields
    ------
    ProgressBar
        To be given as `progress` to `render_capture`, `reconstruct`, `focal_stack` and others.

    Examples
    --------
    >>> with progress_bar("Rendering") as progress:
    ...     capture = render_capture(scene, progress=progress)
    """
    console = Console(stderr=True)
    shown = console.is_terminal or console.is_jupyter
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    times = (TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, *times, console=console, transient=True, disable=not shown) as bar:
        yield ProgressBar(bar, label)
