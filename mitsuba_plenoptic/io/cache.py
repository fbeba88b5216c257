"""Results of long computations, kept on disk by a key of all that they depend on, so that a stopped run goes on.

An entry is a file that is written completely or not at all, with its key in a small file beside it. The key is a hash
of the entry's settings, of the keys of the entries that it was made from, and of the software. An entry with another
key, or one that cannot be read, is made again. While an entry is made its lock keeps other processes out, which may
make others in the same folder. A sum within an entry goes on from its checkpoint (`io.checkpoints`).
"""

import itertools
import json
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..runtime import Array, Forecast, Named, Progress, in_words, lock_of, locked, read_text, software, write_text
from .captures import Capture, read_capture, write_capture
from .checkpoints import CHECKPOINT_SUFFIX, Checkpoint, hash_of, write_json
from .exr import read_exr, write_exr

_log = logging.getLogger(__name__)


def _ignore(*_: Any) -> None:
    pass


@dataclass(frozen=True)
class StageOptions:
    """Settings of a computation in stages, each an entry of a cache: report of progress, and treatment of checkpoints.

    Parameters
    ----------
    notify : callable
        Called during a stage with its name and the finished and total amounts of work (0 of 0 at the start); where
        the work of all stages is expected, with those of all.
    finished : callable
        Called when a stage is finished, with its name, its seconds and whether it was stored already.
    resume : bool
        Whether the checkpoint of another capture is refused, instead of being replaced.
    number : iterator of int
        Numbers of the stages of all caches with these settings, in the order in which they are asked for.
    """

    notify: Callable[[str, int, int], None] = _ignore
    finished: Callable[[str, float, bool], None] = _ignore
    resume: bool = False
    number: Iterator[int] = field(default_factory=lambda: itertools.count(1))


class Cache:
    """Entries in a folder, which is made with the first of them."""

    def __init__(self, folder: Path, options: StageOptions | None = None):
        options = options or StageOptions()
        self.folder = folder
        self.seconds: dict[str, float] = {}
        self.notify = options.notify
        self.resume = options.resume
        self._finished = options.finished
        self._number = options.number
        self.expected: Sequence[float] = ()
        self._forecast = Forecast(lambda seconds: None)

    def expect(self, work: Sequence[float]) -> None:
        """Count the stages to come and log the time of all, from the work of each in their order, in any unit.

        Where all work is 0, they are counted alone.
        """
        self.expected = work
        self._forecast = Forecast(
            lambda seconds: _log.info("all %d stages: about %s", len(work), in_words(seconds)), least=0.1
        )

    def capture(self, name: str, inputs: Any, make: Callable[[Progress, Checkpoint], Capture]) -> tuple[Capture, str]:
        """Return a capture, made with a checkpoint, and its key."""
        path = self.folder / f"{name}{CHECKPOINT_SUFFIX}"
        with Checkpoint(path, "resume" if self.resume else "resume_if_same") as checkpoint:
            return self._get(
                f"{name}.exr", inputs, lambda progress: make(progress, checkpoint), write_capture, read_capture
            )

    def image(self, name: str, inputs: Any, make: Callable[[Progress], tuple[Array, Named]]) -> tuple[Array, str]:
        """Return an image and its key; facts about it go into the file's header."""
        (image, *_), key = self._get(f"{name}.exr", inputs, make, lambda path, made: write_exr(path, *made), read_exr)
        return np.asarray(image, dtype=np.float32), key

    def facts(self, name: str, inputs: Any, make: Callable[[Progress], Named]) -> Named:
        """Return a dictionary of plain JSON values."""

        def read(path: Path) -> Named:
            return dict(json.loads(read_text(path, 2**26)))

        return self._get(f"{name}.json", inputs, make, write_json, read)[0]

    def _get(
        self,
        file: str,
        inputs: Any,
        make: Callable[[Progress], Any],
        write: Callable[[Path, Any], None],
        read: Callable[[Path], Any],
    ) -> tuple[Any, str]:
        """Return the value of an entry, read or made, and its key."""
        path = self.folder / file
        beside = self.folder / f".{file}.key"
        name = file.rpartition(".")[0]
        number = next(self._number)
        label = f"{name}, {number} of {len(self.expected)}" if number <= len(self.expected) else name
        before, work = sum(self.expected[: number - 1]), sum(self.expected[number - 1 : number])

        def progress(done: int, total: int) -> None:
            # A stage that was made with the one before has no work of its own.
            if self.expected:
                done = round(1e3 * (before + work * done / max(total, 1)))
                total = round(1e3 * sum(self.expected))
                self._forecast(done, total)
            self.notify(label, done, total)

        key = hash_of({"entry": name, "inputs": inputs, "software": software()})
        value = None
        seconds = "0"
        try:
            stored, seconds = read_text(beside, 2**10).split()
            if stored == key:
                value = read(path)
        except (InputError, ValueError):
            pass
        was_there = value is not None
        if not was_there:
            with locked(lock_of(path), f"{path}: another process is making this stage"):
                start = time.perf_counter()
                progress(0, 0)
                value = make(progress)
                seconds = f"{time.perf_counter() - start:.3f}"
                # A file of another key is never taken for this one, wherever the process ends.
                beside.unlink(missing_ok=True)
                write(path, value)
                write_text(beside, f"{key} {seconds}\n")
        self.seconds[name] = float(seconds)
        self._finished(label, self.seconds[name], was_there)
        return value, key
