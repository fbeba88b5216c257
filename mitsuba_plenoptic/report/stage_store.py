"""Long computations in stages, each stored on disk and repeated only if something changed on which it depends.

A stage is a step (see `io.checkpoints`) that depends on its name, its settings, the keys of the stages before it and
the software. Its file is written completely or not at all, so that a killed run resumes where it was.
"""

from __future__ import annotations

import hashlib
import json
import re
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ..io.captures import Capture, read_capture, write_capture
from ..io.checkpoints import (
    SUFFIX,
    Checkpoint,
    finished_step,
    hash_of,
    lock_of,
    locked,
    note_step,
    step_key,
    write_json,
)
from ..io.exr import read_exr, write_exr
from ..light.scene import LARGEST_SCENE
from ..runtime.files import FilesUsed, read_text, require_size
from ..runtime.limits import software as versions
from ..scene_files import scene_path

_LARGEST_JSON = 2**26

Progress = Callable[[int, int], None]


def _ignore(*_: Any) -> None:
    pass


@dataclass(frozen=True)
class StageOptions:
    """Settings of stages: report of progress, and treatment of checkpoints.

    Parameters
    ----------
    notify : callable
        Called during a stage with its name and the finished and total amounts of work (0 of 0 at the start).
    finished : callable
        Called when a stage is finished, with its name, its seconds and whether it was stored already.
    resume : bool
        Whether the checkpoint of another capture is refused, instead of being replaced.
    """

    notify: Callable[[str, int, int], None] = _ignore
    finished: Callable[[str, float, bool], None] = _ignore
    resume: bool = False


class Stages:
    """The stages of an experiment, as files of one folder, which is made with the first stage."""

    def __init__(self, folder: Path, options: StageOptions | None = None) -> None:
        options = options or StageOptions()
        self.folder = folder
        self.seconds: dict[str, float] = {}
        self.notify = options.notify
        self.resume = options.resume
        self._finished = options.finished

    def capture(self, name: str, inputs: Any, make: Callable[[Progress, Checkpoint], Capture]) -> tuple[Capture, str]:
        """Return a capture computed as a stage, with a checkpoint, and the stage's key."""
        with Checkpoint(self.folder / f"{name}{SUFFIX}", "resume" if self.resume else "resume_if_same") as checkpoint:
            return self._get(
                f"{name}.exr", inputs, lambda progress: make(progress, checkpoint), write_capture, read_capture
            )

    def image(
        self, name: str, inputs: Any, make: Callable[[Progress], tuple[np.ndarray, dict[str, Any]]]
    ) -> tuple[np.ndarray, str]:
        """Return an image computed as a stage, and the stage's key; facts about it go into the file's header."""
        (image, *_), key = self._get(f"{name}.exr", inputs, make, lambda path, made: write_exr(path, *made), read_exr)
        return np.asarray(image, dtype=np.float32), key

    def facts(self, name: str, inputs: Any, make: Callable[[Progress], dict[str, Any]]) -> dict[str, Any]:
        """Return a dictionary of plain JSON values computed as a stage."""

        def read(path: Path) -> dict[str, Any]:
            return dict(json.loads(read_text(path, _LARGEST_JSON)))

        return self._get(f"{name}.json", inputs, make, write_json, read)[0]

    def _get(
        self,
        file: str,
        inputs: Any,
        make: Callable[[Progress], Any],
        write: Callable[[Path, Any], None],
        read: Callable[[Path], Any],
    ) -> tuple[Any, str]:
        path, log, name = self.folder / file, self.folder / "stages.json", file.rpartition(".")[0]
        settings = {"stage": name, "inputs": inputs, "experiment": _experiment()}
        entry = finished_step(log, settings)
        was_there = entry is not None
        if entry is not None:
            value = read(path)
        else:
            with locked(lock_of(path), f"{path}: another process is making this stage"):
                start = time.perf_counter()
                self.notify(name, 0, 0)
                value = make(lambda done, total: self.notify(name, done, total))
                entry = {"seconds": round(time.perf_counter() - start, 3)}
                write(path, value)
                # Another process may make another stage meanwhile.
                with locked(lock_of(log)):
                    note_step(log, settings, FilesUsed(written={path.absolute()}), **entry)
        self.seconds[name] = entry["seconds"]
        self._finished(name, self.seconds[name], was_there)
        return value, step_key(settings)


def scene_fingerprint(scene: str | Path, parameters: Mapping[str, str]) -> str:
    """Return a hash of a scene file, its parameters, and the meshes, textures and scenes it names."""
    path = Path(scene) if Path(scene).is_file() else scene_path(str(scene))
    return hash_of({"files": _content(path, dict(parameters)), "parameters": dict(parameters)})


# The source text is read once: it does not change while a process runs.
@cache
def _experiment() -> str:
    """Return a hash of the source file of the stages, which `limits.software` does not contain."""
    return hashlib.sha256(Path(__file__).with_name("experiment.py").read_bytes()).hexdigest()[:16]


def software() -> dict[str, str]:
    """Return {package: version} for stages; for this package, hashes of source files."""
    return {**versions(), "experiment": _experiment()}


def time_summary(seconds: dict[str, float]) -> str:
    """Return a sentence on the total time of all stages and on the longest stage."""
    total = sum(seconds.values())
    longest = max(seconds, key=lambda name: seconds[name])
    return f"{total:.0f} s, of which {seconds[longest]:.0f} s for {longest.replace('_', ' ')}"


def _content(path: Path, parameters: dict[str, str]) -> list[tuple[str, str]]:
    """Return a scene's files as {name: hash}; names with parameters get the parameters' values."""
    with path.open("rb") as file:
        found = [(path.name, hashlib.file_digest(file, "sha256").hexdigest())]
    if path.suffix.lower() != ".xml":
        return found
    try:
        root = ElementTree.fromstring(require_size(path, LARGEST_SCENE).read_bytes())
    except ElementTree.ParseError:
        return found
    values = {item.get("name", ""): item.get("value", "") for item in root.iter("default")} | parameters
    names = [item.get("value", "") for item in root.iter("string") if item.get("name") == "filename"]
    names += [item.get("filename", "") for item in root.iter("include")]
    for name in names:
        filled = re.sub(r"\$(\w+)", lambda match: values.get(match.group(1), match.group(0)), name)
        if (path.parent / filled).is_file():
            found += _content(path.parent / filled, values)
    return found
