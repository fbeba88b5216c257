"""The folder of a data set: its layout, the recipe that made it, and its samples in HDF5 files.

A file has a group for each sample, named by the index in six digits, with the sample's arrays and facts. Its
``digests``, in JSON by array name, are compared whenever an array is read, so that a damaged sample is detected. The
same samples give the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from ...choices import MODELS
from ...errors import NO_RECORD, InputError, naming, refuse_if, refusing, require_count, short_repr, warn
from ...io.checkpoints import digest, flattened, write_json
from ...io.versions import KEY, is_of_1_0, stamped
from ...report.stage_store import scene_fingerprint
from ...runtime.files import Sink, atomic_output, h5py_module, read_text, require_file, stored_array
from ...runtime.limits import require_memory, software
from .recipe import Recipe
from .sample import Sample

MANIFEST, CARD, PREVIEW, CHECKSUMS = "dataset.json", "README.md", "preview.png", "checksums.sha256"

LARGEST_LIST = 2**27
"""Bytes of the manifest or of the checksums, at most: of a million shards."""

LOCK = ".lock"

_FREE = {"recipe.count", "recipe.name"}
"""Entries that may differ: the count may grow, and the name, which is that of the file, changes no bits."""


@dataclass(frozen=True)
class DataFolder:
    """Paths of the files in the folder of a data set."""

    folder: Path
    count: int
    samples_per_shard: int

    @property
    def shards(self) -> int:
        """Number of shards, the files that hold several samples each."""
        return -(-self.count // self.samples_per_shard)

    def shard(self, number: int) -> Path:
        """Return the path of a shard."""
        return self.folder / "shards" / f"shard-{number:05d}.h5"

    def members(self, number: int) -> range:
        """Return the range of indices of a shard's samples."""
        first = number * self.samples_per_shard
        return range(first, min(first + self.samples_per_shard, self.count))

    def sample(self, index: int) -> Path:
        """Return the file of a sample that has not yet been packed into a shard."""
        return self.folder / "samples" / f"{index:06d}.h5"


def facts_of(recipe: Recipe) -> dict[str, Any]:
    """Return everything that determines the bits of a data set, as plain JSON values."""
    scenes = {
        f"scene {index + 1}": scene_fingerprint(source.scene, {})
        for index, source in enumerate(recipe.scenes)
        if source.scene
    }
    facts = {"recipe": dict(recipe.content), "files": scenes, "software": software()}
    return dict(json.loads(json.dumps(stamped(facts))))


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the recipe that made a data set, read from its manifest."""
    path = folder / MANIFEST
    text = read_text(path, LARGEST_LIST)
    with refusing(f"{path}: it is not the manifest of a data set", *NO_RECORD):
        content = json.loads(text)
        numbers = [content["count"], content["samples_per_shard"]]
    refuse_if(
        not all(isinstance(number, int) and number > 0 for number in numbers),
        f"{path}: count, samples_per_shard = {short_repr(numbers)}: they must be whole numbers above 0",
    )
    return dict(content)


def claim(folder: Path, recipe: Recipe) -> DataFolder:
    """Return the folder of a data set after writing its manifest; refuse a folder of another recipe."""
    facts = facts_of(recipe)
    if (folder / MANIFEST).exists():
        found = read_manifest(folder)
        before, now = flattened(found), flattened(facts)
        names = {*now, *(key for key in before if key.partition(".")[0] in facts)}
        # Another version comes with other scenes and software.
        for name in [KEY, *sorted(names - {KEY})]:
            if before.get(name) != now.get(name) and name not in _FREE:
                kind = "made by other software" if name.startswith(("software.", KEY)) else "of another recipe"
                raise InputError(
                    f"{folder}: it holds samples {kind}: {name} was {short_repr(before.get(name))}, is "
                    f"{short_repr(now.get(name))}; choose another folder"
                )
        refuse_if(
            found["count"] > recipe.count,
            f"count = {recipe.count}: {folder} holds {found['count']} samples; it may only grow",
        )
    elif any(path.name != LOCK for path in folder.iterdir()):
        raise InputError(f"{folder}: it holds something else; choose an empty folder, or one that is not there")
    sizes = {"count": recipe.count, "samples_per_shard": recipe.samples_per_shard}
    write_json(folder / MANIFEST, {**sizes, "name": recipe.name, **facts})
    layout = DataFolder(folder, recipe.count, recipe.samples_per_shard)
    for part in (layout.shard(0), layout.sample(0)):
        part.parent.mkdir(exist_ok=True)
    return layout


def recorded_checksums(folder: Path) -> dict[str, str]:
    """Return the checksums of a data set by file, as written with it; empty if there are none."""
    try:
        return _checksums(folder)
    except InputError:
        return {}


def _checksums(folder: Path) -> dict[str, str]:
    pairs = [line.partition("  ") for line in read_text(folder / CHECKSUMS, LARGEST_LIST).splitlines()]
    return {name: expected for expected, _, name in pairs}


def checksum(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


_FACTS, _DIGESTS = "facts", "digests"

_MOST_OPEN = 32
"""Files that a data set keeps open: systems allow a process a few hundred, and large data sets have thousands."""

_log = logging.getLogger(__name__)


def group_name(index: int) -> str:
    """Return the name of a sample's group in an HDF5 file."""
    return f"{index:06d}"


def write_samples(path: Path, samples: Iterable[Sample]) -> None:
    """Write samples to a file, completely or not at all."""
    h5py = h5py_module("a data set")
    with atomic_output(path) as temporary, Sink(temporary, "w+") as sink:
        with h5py.File(sink, "w") as file:
            for sample in samples:
                arrays: dict[str, Any] = {name: np.asarray(array, np.float32) for name, array in sample.arrays.items()}
                arrays[_FACTS] = _as_bytes(sample.facts)
                arrays[_DIGESTS] = _as_bytes({name: digest(array) for name, array in arrays.items()})
                group = file.create_group(group_name(sample.index))
                for name, array in arrays.items():
                    group.create_dataset(name, data=array)
                sink.check(path)
        sink.check(path)


def _as_bytes(values: dict[str, Any]) -> NDArray[np.uint8]:
    """Return a text as an array of bytes, since HDF5 attributes hold at most 64 KiB."""
    return np.frombuffer(json.dumps(values, sort_keys=True).encode(), np.uint8)


def open_shard(path: Path) -> Any:
    """Open a file of samples for reading."""
    h5py = h5py_module("a data set")
    with refusing(f"{path}: it is damaged:", OSError):
        return h5py.File(require_file(path), "r")


def read_sample(
    file: Any, path: Path, index: int, names: Collection[str] | None = None, *, with_digests: bool = True
) -> Sample:
    """Read a sample from an open file and compare its digests, which may be missing unless `with_digests`.

    Data sets of version 0.2.0 have no digests.
    """
    damaged = OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError, RecursionError
    with naming(path), refusing(f"sample {index} is damaged:", *damaged):
        refuse_if(group_name(index) not in file, f"it has no sample {index}")
        group = file[group_name(index)]

        def read(name: str) -> NDArray[Any]:
            stored = stored_array(group, name)
            refuse_if(stored is None, f"sample {index}: it has no {name}; it has {', '.join(group)}")
            require_memory(float(stored.size) * stored.dtype.itemsize, f"{name} of sample {index}")
            return np.asarray(stored[()])

        compared = with_digests or _DIGESTS in group
        digests, arrays = json.loads(read(_DIGESTS).tobytes()) if compared else {}, {}
        if not compared:
            warn(
                f"{path.parent.parent}: its samples have no digests, as those of version 0.2.0: what is damaged in "
                f"them is not noticed, other than by DataSet.damaged()"
            )
        for name in (digests or set(group) - {_DIGESTS}) if names is None else [*names, _FACTS]:
            arrays[name] = read(name)
            if compared and digest(arrays[name]) != digests[name]:
                raise ValueError(f"{name} is not what was written")
        facts = json.loads(arrays.pop(_FACTS).tobytes())
    return Sample(index, arrays, facts)


def whole_samples(path: Path) -> set[int]:
    """Return the indices of undamaged samples in a file, if the file exists, and log the damaged ones."""
    if not path.exists():
        return set()
    found = set()
    try:
        with open_shard(path) as file:
            for name in file:
                try:
                    found.add(read_sample(file, path, int(name)).index)
                except (InputError, ValueError) as error:
                    _log.warning("%s; it is rendered again", error)
    except (InputError, RuntimeError) as error:
        _log.warning("%s; its samples are rendered again", error)
    return found


def _remark(folder: Path, manifest: dict[str, Any]) -> None:
    """Log how the wave captures of a data set of version 1.0 or earlier are read."""
    recipe = manifest.get("recipe")
    models = recipe.get("models", MODELS) if isinstance(recipe, dict) else ()
    if is_of_1_0(manifest) and "wave" in models:
        _log.info(
            "%s: a data set of version 1.0 or earlier: the lens_model of its wave captures is read as parabolic, "
            "unless they have a main_lens or lenses of fewer than 20 wavelengths",
            folder,
        )


class DataSet:
    """A data set in a folder; ``dataset[17]`` is a `Sample`.

    Samples are read on request. A data set may be pickled and used in forked processes; each opens the files anew.

    Parameters
    ----------
    folder : path
        The folder of `make_dataset` or ``mitsuba-plenoptic dataset``.
    fields : collection of str, optional
        Names of the arrays to read. Default: all.

    Raises
    ------
    InputError
        If the folder holds no data set, or one whose shards are not all there.
    """

    def __init__(self, folder: str | Path, fields: Collection[str] | None = None) -> None:
        self.folder = Path(folder)
        self.manifest = read_manifest(self.folder)
        self.fields = None if fields is None else tuple(fields)
        self._layout = DataFolder(self.folder, self.manifest["count"], self.manifest["samples_per_shard"])
        self._files: dict[int, Any] = {}
        self._process = os.getpid()
        _remark(self.folder, self.manifest)
        for index in range(self._layout.shards):
            refuse_if(
                not self._layout.shard(index).is_file(),
                f"{self._layout.shard(index)}: it is missing: run the command that makes the data set again",
            )

    def __len__(self) -> int:
        return self._layout.count

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> list[Sample]: ...
    def __getitem__(self, index: int | slice) -> Sample | list[Sample]:
        """Return the sample with an index, or the samples of a slice."""
        if isinstance(index, slice):
            return [self[number] for number in range(*index.indices(len(self)))]
        if index >= len(self):
            raise IndexError(f"sample {index}: there are {len(self)}")
        index = require_count("sample", index, minimum=0)
        number = index // self._layout.samples_per_shard
        return read_sample(self._open(number), self._layout.shard(number), index, self.fields, with_digests=False)

    def __iter__(self) -> Iterator[Sample]:
        for index in range(len(self)):
            yield self[index]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_files": {}}

    def damaged(self) -> list[str]:
        """Return the names of files that are missing or differ from their checksums.

        Raises
        ------
        InputError
            If there are no checksums.
        """
        found = []
        for name, expected in _checksums(self.folder).items():
            # No name in the file leads out of the folder.
            path = self.folder / name
            inside = path.resolve().is_relative_to(self.folder.resolve())
            if not inside or not path.is_file() or checksum(path) != expected:
                found.append(name)
        return found

    def _open(self, number: int) -> Any:
        if self._process != os.getpid():
            # HDF5's handles are those of the process that opened them.
            self._files, self._process = {}, os.getpid()
        if number not in self._files:
            if len(self._files) >= _MOST_OPEN:
                # It is closed once no other thread reads it.
                del self._files[next(iter(self._files))]
            self._files[number] = open_shard(self._layout.shard(number))
        return self._files[number]
