"""Commands that are stopped: the handling of Ctrl-C, and of the checkpoints that are left."""

from __future__ import annotations

import contextlib
import logging
import signal
import threading
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from ..runtime.progress import ProgressBar

if TYPE_CHECKING:
    from ..io.checkpoints import Checkpoint, Existing

_log = logging.getLogger(__name__)

_within_run = False
"""Whether the command is a step of a run file."""


@contextlib.contextmanager
def within_run() -> Iterator[None]:
    """Let commands resume from the checkpoints of the same computation, and replace those of others."""
    global _within_run
    _within_run = True
    try:
        yield
    finally:
        _within_run = False


def existing_checkpoint(resume: bool) -> Existing:
    """Return what a command does with a checkpoint that is there."""
    if resume:
        return "resume"
    return "resume_if_same" if _within_run else "refuse"


@contextlib.contextmanager
def stopped_by_hand(checkpoint: Checkpoint, progress: ProgressBar) -> Iterator[None]:
    """Let Ctrl-C end a run with its checkpoint written, and say how to resume; a second Ctrl-C ends it at once."""
    # Only the main thread receives signals.
    on_main = threading.current_thread() is threading.main_thread()
    before: Any = signal.getsignal(signal.SIGINT)

    def stop(signal_number: int, frame: Any) -> None:
        signal.signal(signal.SIGINT, before)
        if not checkpoint.stop():
            raise KeyboardInterrupt
        _log.info("stopping after the current batch; Ctrl-C again stops at once")

    if on_main:
        signal.signal(signal.SIGINT, stop)
    try:
        yield
    except KeyboardInterrupt:
        option = "the same command resumes" if _within_run else "resume with --resume"
        hint = f": {option}" if checkpoint.path.exists() else ""
        _log.info("stopped at %.0f %%%s", 100 * progress.fraction, hint)
        raise
    finally:
        if on_main:
            signal.signal(signal.SIGINT, before)
