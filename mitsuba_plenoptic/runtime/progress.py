"""The progress of long computations: a bar on terminals and in notebooks, plain lines in files and pipes."""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from rich.progress import Progress

FIRST_LINE = 5.0
INTERVAL = 10.0
LONGEST_INTERVAL = 60.0
"""Seconds to the first plain line, and between two of them at least and at most."""

INTERRUPTED = threading.Event()
"""Set by commands on Ctrl-C: where C++ libraries try to convert an object of Python they drop the KeyboardInterrupt."""

SETTLED = 5.0
FORESEEN = 0.05
MINUTE = 60.0
"""Seconds of work after which its speed is known, the fraction of it from which lines tell how long the rest takes, and
seconds in a minute."""


def in_words(seconds: float) -> str:
    """Return a time as text in a suitable unit: seconds, minutes or hours."""
    if seconds < MINUTE:
        return f"{seconds:.3g} s"
    minutes = seconds / MINUTE
    return f"{minutes:.0f} min" if minutes < 60 else f"{minutes / 60:.1f} h"


class ProgressBar:
    """Display of progress, for the argument `progress` of this package's long computations."""

    def __init__(self, label: str, show: Callable[[int, int], None] | None = None, hint: str = "") -> None:
        self._show = show
        self._hint = hint
        self.begin(label)

    def begin(self, label: str) -> None:
        """Begin work that is shown by a label, such as a stage."""
        self.label = label
        self.fraction = 0.0
        self.begun: float | None = None  # the first fraction: what was done by an earlier run
        self.start = time.monotonic()

    def __call__(self, done: int, total: int) -> None:
        """Show the fraction of the total that is done; end the work if Ctrl-C was pressed."""
        if INTERRUPTED.is_set():
            raise KeyboardInterrupt
        self.fraction = done / max(total, 1)
        self.begun = self.fraction if self.begun is None else self.begun
        if self._show:
            self._show(done, total)

    def hint_after(self, seconds: float) -> str:
        """Return what makes the work shorter, once, with the first fraction; nothing for a minute's work."""
        advised = self.fraction > 0 and seconds > MINUTE * (self.fraction - (self.begun or 0.0))
        hint, self._hint = (self._hint, "") if advised else ("", self._hint)
        return hint


class Forecast:
    """Passes progress on, and reports once, when it can be estimated, how many seconds the whole work takes.

    The fraction `least` of the work must be done.
    """

    def __init__(
        self,
        tell: Callable[[float], None],
        progress: Callable[[int, int], None] | None = None,
        least: float = 0.0,
    ) -> None:
        self._progress = progress
        self._least = least
        self._tell = tell
        self._start = time.monotonic()
        self._first: tuple[float, float] | None = None
        self._known = False

    def __call__(self, done: int, total: int) -> None:
        """Pass on the finished fraction of the total; see `ProgressBar`."""
        if self._progress:
            self._progress(done, total)
        now = time.monotonic()
        fraction = done / max(total, 1)
        if self._known or fraction == 0:
            return
        if self._first is None:
            # Before, plans are made and kernels compiled.
            self._first = now, fraction
        elapsed = now - self._first[0]
        done_since = fraction - self._first[1]
        if elapsed >= SETTLED and fraction >= self._least and done_since > 0:
            self._known = True
            self._tell(now - self._start + (1 - fraction) * elapsed / done_since)


@contextlib.contextmanager
def progress_bar(label: str, hint: str = "") -> Iterator[ProgressBar]:
    """Show a bar on standard error, or in the notebook; elsewhere, as in a file, print plain lines.

    Parameters
    ----------
    label : str
        Name of the work.
    hint : str
        What makes the work shorter, said with the first fraction of work that takes more than a minute.

    Yields
    ------
    ProgressBar
        To be given as `progress` to `render_capture`, `reconstruct`, `focal_stack` and others.

    Examples
    --------
    >>> with progress_bar("Rendering") as progress:
    ...     capture = render_capture(scene, progress=progress)
    """
    if not has_screen():
        with plain_lines(label, hint) as line:
            yield line
        return
    with moving_bar() as bar:
        task = bar.add_task(label, total=1)
        start = time.monotonic()

        def show(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)
            elapsed = time.monotonic() - start
            if elapsed >= FIRST_LINE and (text := display.hint_after(elapsed)):
                bar.console.print(text)

        display = ProgressBar(label, show, hint)
        yield display


def moving_bar() -> Progress:
    """Return progress bars with percentage and remaining time on standard error, shown where they can move."""
    # Not needed for the help of commands, which imports this module.
    from rich import progress
    from rich.console import Console

    columns = (progress.SpinnerColumn(), "{task.description}", progress.BarColumn(), progress.TaskProgressColumn())
    times = (progress.TimeElapsedColumn(), progress.TimeRemainingColumn())
    console = Console(stderr=True, highlight=False)
    return progress.Progress(*columns, *times, console=console, transient=True, disable=is_quiet() or not has_screen())


def is_quiet() -> bool:
    """Return whether progress is hidden, which is so if the package logs only critical messages."""
    return logging.getLogger("mitsuba_plenoptic").level == logging.CRITICAL


def has_screen() -> bool:
    """Return whether standard error is a terminal or a notebook with widgets, where a bar can move."""
    from rich.console import Console

    console = Console(stderr=True)
    if console.is_jupyter:
        return importlib.util.find_spec("ipywidgets") is not None
    return console.is_terminal


_under_way: list[ProgressBar] = []
"""Labels of the plain lines, the innermost last."""


@contextlib.contextmanager
def plain_lines(label: str, hint: str = "") -> Iterator[ProgressBar]:
    """Print progress and elapsed time at intervals on standard error, unless a bar can move there.

    Of nested contexts the outer one prints, with the progress that the inner one reports.
    """
    line = ProgressBar(label, hint=hint)
    _under_way.append(line)
    ended = threading.Event()
    try:
        if len(_under_way) == 1 and not has_screen():
            # Taken now, as it may be another one, closed already, by the time of a line.
            threading.Thread(target=_print_lines, args=(ended, sys.stderr), daemon=True).start()
        yield line
    finally:
        ended.set()
        _under_way.remove(line)


def _print_lines(ended: threading.Event, output: TextIO) -> None:
    wait = FIRST_LINE
    while not ended.wait(wait) and _under_way:
        line = _under_way[-1]
        elapsed = time.monotonic() - line.start
        done = f"{100 * line.fraction:.0f} %, " if line.fraction else ""
        done_here = line.fraction - (line.begun or 0.0)
        left = elapsed * (1 - line.fraction) / max(done_here, FORESEEN)
        remaining = f", about {in_words(left)} left" if done_here >= FORESEEN and left >= 1 else ""
        hint = line.hint_after(elapsed)
        try:
            if not is_quiet():
                text = f"mitsuba-plenoptic: {line.label}: {done}{elapsed:.0f} s{remaining}{'; ' * bool(hint)}{hint}\n"
                print(text, end="", file=output, flush=True)
        except (OSError, ValueError):
            return  # Nobody reads it any more.
        wait = min(max(INTERVAL, wait * 1.1), LONGEST_INTERVAL)
