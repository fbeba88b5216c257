"""Where the parts of a data set lie in its folder, and which recipe made it."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError, refuse_if, short_repr
from ..io.files import read_text
from ..report.stage_store import scene_fingerprint, write_json
from ..runtime.limits import software
from .recipe import Recipe

if sys.platform != "win32":
    import fcntl

MANIFEST, CARD, PREVIEW, CHECKSUMS = "dataset.json", "README.md", "preview.png", "checksums.sha256"

LARGEST_LIST = 2**27
"""Bytes of the manifest or of the checksums, at most: of a million shards."""

_LOCK = ".lock"

_GROWING = "recipe.count"
"""The entry that may differ, if it grows."""


@dataclass(frozen=True)
class Layout:
    """Files of a data set."""

    folder: Path
    count: int
    samples_per_shard: int

    @property
    def shards(self) -> int:
        """Number of files of samples."""
        return -(-self.count // self.samples_per_shard)

    def shard(self, number: int) -> Path:
        """Return the file of a shard."""
        return self.folder / "shards" / f"shard-{number:05d}.h5"

    def members(self, number: int) -> range:
        """Return the samples of a shard."""
        first = number * self.samples_per_shard
        return range(first, min(first + self.samples_per_shard, self.count))

    def sample(self, index: int) -> Path:
        """Return the file of a sample that is in no shard yet."""
        return self.folder / "samples" / f"{index:06d}.h5"


def facts_of(recipe: Recipe) -> dict[str, Any]:
    """Return what the bits of a data set depend on, in plain JSON values."""
    scenes = {
        f"scene {number + 1}": scene_fingerprint(source.scene, {})
        for number, source in enumerate(recipe.scenes)
        if source.scene
    }
    facts = {"recipe": dict(recipe.content), "files": scenes, "software": software()}
    return dict(json.loads(json.dumps(facts)))


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read which recipe made a data set."""
    path = folder / MANIFEST
    text = read_text(path, LARGEST_LIST)
    try:
        content = json.loads(text)
        numbers = [content["count"], content["samples_per_shard"]]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise InputError(f"{path}: it is not the manifest of a data set") from None
    refuse_if(
        not all(isinstance(number, int) and number > 0 for number in numbers),
        f"{path}: count, samples_per_shard = {short_repr(numbers)}: they must be whole numbers above 0",
    )
    return dict(content)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Make the folder of a data set and keep other processes from making it, too.

    The lock belongs to this process: the system releases it however the process ends. Windows has no such lock.
    """
    path = folder / _LOCK
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = path.open("w")
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror}") from None
    with file:
        try:
            if sys.platform != "win32":
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # The process that had it may have removed the file between the two calls.
            mine = os.path.samestat(os.fstat(file.fileno()), path.stat())
        except (BlockingIOError, FileNotFoundError):
            mine = False
        except OSError as error:
            raise InputError(f"{folder}: it cannot be locked: {error.strerror}") from None
        refuse_if(not mine, f"{folder}: another process is making this data set; wait until it has ended")
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def claim(folder: Path, recipe: Recipe) -> Layout:
    """Find that a folder is empty, or that it holds samples of the same recipe, and write its manifest."""
    facts = facts_of(recipe)
    if (folder / MANIFEST).exists():
        found = read_manifest(folder)
        before, now = _flat(found), _flat(facts)
        for name in sorted(set(now) | {key for key in before if key.partition(".")[0] in facts}):
            if before.get(name) != now.get(name) and name != _GROWING:
                kind = "made by other software" if name.startswith("software.") else "of another recipe"
                raise InputError(
                    f"{folder}: it holds samples {kind}: {name} was {short_repr(before.get(name))}, is "
                    f"{short_repr(now.get(name))}; choose another folder"
                )
        if found["count"] > recipe.count:
            raise InputError(f"count = {recipe.count}: {folder} holds {found['count']} samples; it may only grow")
    elif any(path.name != _LOCK for path in folder.iterdir()):
        raise InputError(f"{folder}: it holds something else; choose an empty folder, or one that is not there")
    sizes = {"count": recipe.count, "samples_per_shard": recipe.samples_per_shard}
    write_json(folder / MANIFEST, {**sizes, "name": recipe.name, **facts})
    layout = Layout(folder, recipe.count, recipe.samples_per_shard)
    for part in (layout.shard(0), layout.sample(0)):
        part.parent.mkdir(exist_ok=True)
    return layout


def recorded_checksums(folder: Path) -> dict[str, str]:
    """Return the checksums that were written for a data set, by file; an empty dictionary if there are no checksums."""
    path = folder / CHECKSUMS
    if not path.exists():
        return {}
    try:
        pairs = [line.partition("  ") for line in read_text(path, LARGEST_LIST).splitlines()]
    except InputError:
        return {}
    return {name: expected for expected, _, name in pairs}


def checksum(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _flat(values: Any, name: str = "") -> dict[str, Any]:
    """Return nested values by dotted names."""
    if isinstance(values, Mapping):
        pairs = list(values.items())
    elif isinstance(values, list):
        pairs = list(enumerate(values))
    else:
        return {name: values}
    found: dict[str, Any] = {}
    for key, value in pairs:
        found |= _flat(value, f"{name}.{key}" if name else str(key))
    return found
