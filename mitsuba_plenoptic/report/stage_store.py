"""Long computations in stages, each stored on disk and repeated only when something it depends on has changed.

A stage's key is a hash of its name, its settings, the keys of the stages before it and the software. Its file
carries the key and appears whole or not at all, so that a killed run resumes where it was.
"""

from __future__ import annotations

import hashlib
import json
import re
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ..errors import InputError
from ..io.captures import Capture, read_capture, write_capture
from ..io.checkpoints import SUFFIX, Checkpoint, Existing
from ..io.exr import read_exr, write_exr
from ..io.files import FilesUsed, read_text, require_size, write_text
from ..light.scene import LARGEST_SCENE
from ..runtime.limits import software as versions
from ..scene_files import scene_path

_LARGEST_JSON = 2**26

Value = TypeVar("Value")
Progress = Callable[[int, int], None]


def _ignore(*_: Any) -> None:
    pass


@dataclass(frozen=True)
class StageOptions:
    """Settings of stages: report of progress, and treatment of checkpoints."""

    # Called while a stage is computed, with its name, what is done and how much there is (0 of 0: it has begun).
    notify: Callable[[str, int, int], None] = _ignore
    # Called when a stage is there, with its name, its seconds and whether it was there already.
    finished: Callable[[str, float, bool], None] = _ignore
    # Whether the checkpoint of another capture is refused, instead of being replaced.
    resume: bool = False


class StageStore:
    """A folder of finished stages of a run."""

    def __init__(
        self,
        # Where the files lie; it is made with the first stage.
        folder: Path,
        # How progress is reported. Default: not at all.
        options: StageOptions | None = None,
    ) -> None:
        options = options or StageOptions()
        self.folder = folder
        self.seconds: dict[str, float] = {}
        self.notify = options.notify
        self.resume = options.resume
        self._finished = options.finished
        self._existing: Existing = "resume" if options.resume else "resume_if_same"
        self._log = folder / "stages.json"
        self._known = _read_json(self._log)

    def capture(self, name: str, inputs: Any, make: Callable[[Progress, Checkpoint], Capture]) -> tuple[Capture, str]:
        """Return a stage that is a capture, and its key; while it is computed it has a checkpoint."""

        def read(path: Path) -> tuple[Capture, str]:
            value = read_capture(path)
            return value, value.metadata["key"]

        with Checkpoint(self.folder / f"{name}{SUFFIX}", self._existing) as checkpoint:
            return self._get(
                name,
                ".exr",
                inputs,
                lambda progress: make(progress, checkpoint),
                lambda path, value, key: write_capture(path, replace(value, metadata={**value.metadata, "key": key})),
                read,
            )

    def image(
        self, name: str, inputs: Any, make: Callable[[Progress], tuple[np.ndarray, dict[str, Any]]]
    ) -> tuple[np.ndarray, str]:
        """Return a stage that is an image, and its key; the facts about it go into the file's header."""

        def read(path: Path) -> tuple[tuple[np.ndarray, dict[str, Any]], str]:
            image, _, attributes = read_exr(path)
            return (image, attributes), attributes["key"]

        (image, _), key = self._get(
            name,
            ".exr",
            inputs,
            make,
            lambda path, value, key: write_exr(path, value[0], {**value[1], "key": key}),
            read,
        )
        return np.asarray(image, dtype=np.float32), key

    def facts(self, name: str, inputs: Any, make: Callable[[Progress], dict[str, Any]]) -> dict[str, Any]:
        """Return a stage that is a dictionary of plain JSON values."""

        def read(path: Path) -> tuple[dict[str, Any], str]:
            content = json.loads(read_text(path, _LARGEST_JSON))
            return content["value"], content["key"]

        return self._get(
            name, ".json", inputs, make, lambda path, value, key: write_json(path, {"key": key, "value": value}), read
        )[0]

    def _get(
        self,
        name: str,
        suffix: str,
        inputs: Any,
        make: Callable[[Progress], Value],
        write: Callable[[Path, Value, str], None],
        read: Callable[[Path], tuple[Value, str]],
    ) -> tuple[Value, str]:
        key = _hash({"stage": name, "inputs": inputs, "software": software()})
        path = self.folder / f"{name}{suffix}"
        value = _read_stage(path, key, read)
        was_there = value is not None
        if value is None:
            start = time.perf_counter()
            self.notify(name, 0, 0)
            value = make(lambda done, total: self.notify(name, done, total))
            seconds = time.perf_counter() - start
            self.folder.mkdir(parents=True, exist_ok=True)
            write(path, value, key)
            self._known[name] = {"key": key, "seconds": round(seconds, 3)}
            write_json(self._log, self._known)
        log = self._known.get(name, {})
        self.seconds[name] = log.get("seconds", 0.0) if log.get("key") == key else 0.0
        self._finished(name, self.seconds[name], was_there)
        return value, key


class StepLog:
    """A file of the digests of files that finished steps have read and written.

    A step is finished if its settings and the software are those of its entry, and every file that it read or wrote
    has the digest noted there.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._entries = {key: entry for key, entry in _read_json(path).items() if _is_entry(entry)}

    def is_finished(self, settings: Any) -> bool:
        """Return whether a finished step has these settings; a step that wrote nothing has never finished."""
        entry = self._entries.get(_key(settings), _NOTHING)
        noted = [*entry["read"].items(), *entry["written"].items()]
        return bool(entry["written"]) and all(_digest(self._path.parent / name) == digest for name, digest in noted)

    def note(self, settings: Any, used: FilesUsed) -> None:
        """Record the files that a step has read and written; drop entries of steps that wrote one of these files."""
        read, written = (
            {self._name(path): _digest(path) for path in sorted(paths) if path.exists()}
            for paths in (used.read - used.written, used.written)
        )
        others = {key: one for key, one in self._entries.items() if not written.keys() & one["written"].keys()}
        self._entries = {**others, _key(settings): {"read": read, "written": written}}
        write_json(self._path, self._entries)

    def _name(self, path: Path) -> str:
        """Name a file relative to the log where it lies in the log's folder, so that the folder can be moved."""
        folder = self._path.parent.absolute()
        return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.as_posix()


_NOTHING: dict[str, dict[str, str]] = {"read": {}, "written": {}}


def _is_entry(entry: Any) -> bool:
    return isinstance(entry, dict) and all(isinstance(entry.get(part), dict) for part in _NOTHING)


def _key(settings: Any) -> str:
    return _hash({"settings": settings, "software": versions()})


def _digest(path: Path) -> str | None:
    """Hash a file, or all files of a folder with their names; None if there is none."""
    found = hashlib.sha256()
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    try:
        for file in files:
            if file != path:
                found.update(file.relative_to(path).as_posix().encode() + b"\0")
            if not file.is_dir():
                with file.open("rb") as content:
                    found.update(hashlib.file_digest(content, "sha256").digest())
    except OSError:
        return None
    return found.hexdigest()[:32]


def scene_fingerprint(scene: str | Path, parameters: Mapping[str, str]) -> str:
    """Hash a scene file, or a built-in one, with its parameters and with the meshes, textures and scenes it names."""
    path = Path(scene) if Path(scene).is_file() else scene_path(str(scene))
    return _hash({"files": _content(path, dict(parameters)), "parameters": dict(parameters)})


# The source text is read once: it does not change while a process runs.
@cache
def software() -> dict[str, str]:
    """Return {package: version}; for this package, the hash of its source files."""
    experiment = hashlib.sha256(Path(__file__).with_name("experiment.py").read_bytes())
    return {**versions(), "experiment": experiment.hexdigest()[:16]}


def time_summary(seconds: dict[str, float]) -> str:
    """Return a sentence on the time of all stages together, and on the longest stage."""
    total = sum(seconds.values())
    longest = max(seconds, key=lambda name: seconds[name])
    return f"{total:.0f} s, of which {seconds[longest]:.0f} s for {longest.replace('_', ' ')}"


def write_json(path: Path, content: Any) -> None:
    """Write JSON to read and to compare: indented, names sorted, whole or not at all."""
    write_text(path, json.dumps(content, indent=1, sort_keys=True) + "\n")


def _read_stage(path: Path, key: str, read: Callable[[Path], tuple[Value, str]]) -> Value | None:
    """Read a stage if its file is whole and has the key."""
    if not path.is_file():
        return None
    try:
        value, found = read(path)
    except (InputError, KeyError, ValueError, OSError):
        return None
    return value if found == key else None


def _content(path: Path, parameters: dict[str, str]) -> list[tuple[str, str]]:
    """List a scene's files by name and hash; where a name holds parameters, with their values."""
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


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(read_text(path, _LARGEST_JSON))
    except (InputError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _hash(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:32]
