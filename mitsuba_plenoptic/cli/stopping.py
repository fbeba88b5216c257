"""Stopping of commands: the option ``--resume``, the handling of Ctrl-C, and the line on how to go on."""

from __future__ import annotations

import contextlib
import logging
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..runtime.progress import ProgressBar
from . import StoppedError
from .inputs import EXPERT

if TYPE_CHECKING:
    from ..io.checkpoints import Checkpoint

_log = logging.getLogger(__name__)

Resume = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="Refuse what another run has left at the output, instead of replacing it; the same command goes on from "
        "what it has left itself with and without this.",
        rich_help_panel=EXPERT,
    ),
]


def checkpoint_of(output: Path, resume: bool, path: Path | None = None) -> Checkpoint:
    """Return the checkpoint of a command's output, next to it or at `path`, that continues as ``--resume`` says."""
    from ..io.checkpoints import SUFFIX, Checkpoint
    from ..runtime.files import require_writable

    path = require_writable(path or output.with_name(output.name + SUFFIX))
    return Checkpoint(path, "resume" if resume else "resume_if_same")


@contextlib.contextmanager
def resumable(progress: ProgressBar | None = None) -> Iterator[None]:
    """On Ctrl-C, print how much of the run is finished and that the same command continues it."""
    try:
        yield
    except KeyboardInterrupt:
        done = f" at {100 * progress.fraction:.0f} %" if progress else ""
        raise StoppedError(f"stopped{done}: the same command goes on from there") from None


@contextlib.contextmanager
def stopped_by_hand(checkpoint: Checkpoint, progress: ProgressBar) -> Iterator[None]:
    """Let Ctrl-C end a run with its checkpoint written, and say how to go on; a second Ctrl-C ends it at once."""
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
        with resumable(progress):
            yield
    except StoppedError:
        if not checkpoint.path.exists():
            raise KeyboardInterrupt from None
        raise
    finally:
        if on_main:
            signal.signal(signal.SIGINT, before)
