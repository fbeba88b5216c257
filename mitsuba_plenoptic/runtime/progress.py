"""The progress of long computations: a bar on terminals and in notebooks, plain lines in files and pipes."""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from rich.progress import Progress

FIRST_LINE = 4.5
INTERVAL = 10.0
LONGEST_INTERVAL = 60.0
_LOOK = 0.25
"""Seconds to the first plain line, between two of them at least and at most, and between looks whether one is due."""

INTERRUPTED = threading.Event()
"""Set by commands on Ctrl-C: where C++ libraries try to convert an object of Python they drop the KeyboardInterrupt."""

SETTLED = 5.0
MINUTE = 60.0
"""Seconds of work after which its speed is known, and seconds in a minute."""

_REPORTS = 256
"""Reports from which the speed of work is taken, at most."""

_step = ""
_steps: ContextVar[Callable[[str, float], None] | None] = ContextVar("steps", default=None)


def begin_step(name: str, work: float = 1.0) -> None:
    """Tell the display of progress, by its name, that a step of preparation begins, and its work in any unit."""
    if begin := _steps.get():
        begin(name, work)


@contextlib.contextmanager
def steps_counted(progress: Callable[[float], None], total: float) -> Iterator[None]:
    """Report the fraction of the expected work of preparation that is done; lines show the steps' names meanwhile."""
    begun = 0.0

    def begin(name: str, work: float) -> None:
        global _step
        nonlocal begun
        _step = name
        progress(begun / max(total, begun))
        begun += work

    before = _steps.set(begin)
    try:
        yield
    finally:
        _steps.reset(before)
        begin("", 0.0)


def in_words(seconds: float) -> str:
    """Return a time as text in a suitable unit: seconds, minutes or hours."""
    if seconds < MINUTE:
        return f"{seconds:.3g} s"
    minutes = seconds / MINUTE
    return f"{minutes:.0f} min" if minutes < 60 else f"{minutes / 60:.1f} h"


class ProgressBar:
    """Display of progress, for the argument `progress` of this package's long computations."""

    def __init__(self, label: str, show: Callable[[int, int], None] | None = None, hint: str = ""):
        self._show = show
        self._hint = hint
        self.begin(label)

    def begin(self, label: str) -> None:
        """Begin work that is shown by a label, such as a stage."""
        self.label = label
        self.fraction = 0.0
        self.start = time.monotonic()
        self.skip()

    def skip(self) -> None:
        """Take what is done as the work of an earlier run, which tells nothing of the speed."""
        self._reports: list[tuple[float, float]] = []

    def __call__(self, done: int, total: int) -> None:
        """Show the fraction of the total that is done; end the work if Ctrl-C was pressed."""
        if INTERRUPTED.is_set():
            raise KeyboardInterrupt
        self.fraction = done / max(total, 1)
        if not self._reports or self.fraction > self._reports[-1][1]:
            if len(self._reports) == _REPORTS:
                del self._reports[1::2]
            self._reports.append((time.monotonic(), self.fraction))
        if self._show:
            self._show(done, total)

    def left(self) -> float | None:
        """Return the seconds that the rest takes at the speed of the last three quarters; None if not known."""
        if len(self._reports) < 2:
            return None
        # Before, plans are made, kernels compiled and memory mapped.
        middle = self.start + (self._reports[-1][0] - self.start) / 4
        later = next((report for report in self._reports[:-1] if report[0] >= middle), self._reports[-2])
        # Of the farthest report: repetitions of a stage go back to where it began.
        done = self._reports[-1][1]
        gained = done - later[1]
        # The first step after a pause, in which a kernel is compiled, tells the pause's length rather than the speed,
        # unless it adds a hundredth of the work.
        if later is self._reports[-2] and gained < 0.01:
            return None
        return (time.monotonic() - later[0]) * (1 - done) / gained

    def line(self) -> str:
        """Return the label, the percentage and the times as text."""
        done = f"{100 * self.fraction:.{0 if self.fraction >= 0.01 else 1}f} %, " if self.fraction else ""
        elapsed = time.monotonic() - self.start
        left = self.left() or 0.0
        remaining = f", about {in_words(left)} left" if left >= 1 else ""
        hint = self.hint_of_long_work()
        names = f"{self.label}: {f'{_step}, ' if _step else ''}{done}{elapsed:.0f} s{remaining}"
        return f"{names}{'; ' * bool(hint)}{hint}"

    def hint_of_long_work(self) -> str:
        """Return what makes the work shorter, once, with the first fraction; nothing for a minute's work."""
        begun = self._reports[0][1] if len(self._reports) > 1 else 0.0
        advised = self.fraction > 0 and time.monotonic() - self.start > MINUTE * (self.fraction - begun)
        hint, self._hint = (self._hint, "") if advised else ("", self._hint)
        return hint


class Forecast(ProgressBar):
    """Passes progress on, and reports once, when it can be estimated, how many seconds the whole work takes.

    The fraction `least` of the work must be done.
    """

    def __init__(
        self, tell: Callable[[float], None], progress: Callable[[int, int], None] | None = None, least: float = 0.0
    ):
        super().__init__("", progress)
        self._least = least
        self._tell: Callable[[float], None] | None = tell

    def __call__(self, done: int, total: int) -> None:
        """Pass on the finished fraction of the total; see `ProgressBar`."""
        super().__call__(done, total)
        now = time.monotonic()
        left = self.left()
        moments = [moment for moment, fraction in self._reports if fraction]
        # A first step may be the compilation of a kernel.
        settled = len(moments) > 2 and now - moments[0] >= SETTLED
        if self._tell and left is not None and settled and self.fraction >= self._least:
            tell, self._tell = self._tell, None
            tell(now - self.start + left)


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

        def show(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)
            if time.monotonic() - display.start >= FIRST_LINE and (text := display.hint_of_long_work()):
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
def plain_lines(label: str = "", hint: str = "") -> Iterator[ProgressBar]:
    """Print progress and elapsed time at intervals on standard error, unless a bar can move there.

    Of nested contexts the outer one prints, with the progress that the inner one reports. Without a label nothing is
    printed before an inner context or stage begins.
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
    start = time.monotonic()
    wait = due = FIRST_LINE
    while not ended.wait(due if due < _LOOK else _LOOK) and _under_way:
        line = _under_way[-1]
        now = time.monotonic()
        # A command that has not begun its work yet, or has just begun, says nothing.
        if now - start < due or not (line.label and (line.fraction or now - line.start >= FIRST_LINE)):
            continue
        try:
            if not is_quiet():
                print(f"mitsuba-plenoptic: {line.line()}\n", end="", file=output, flush=True)
        except (OSError, ValueError):
            return  # Nobody reads it any more.
        wait = min(max(INTERVAL, wait * 1.1), LONGEST_INTERVAL)
        due = now - start + wait
