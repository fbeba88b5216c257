"""The folder of a data set: its layout, the recipe that made it, and its samples in HDF5 files.

A file has a group for each sample, named by the index in six digits, with the sample's arrays and facts. HDF5 keeps a
checksum with each, so that a damaged sample is refused when it is read. The same samples give the same bytes.
"""

import json
import logging
import operator
import os
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np

from ...capture_spec import scene_fingerprint
from ...errors import NO_RECORD, InputError, naming, refuse_if, refusing, require_number, short_repr
from ...io import differences, versions, write_json
from ...runtime import (
    Named,
    Sink,
    atomic_output,
    h5py_module,
    read_text,
    require_file,
    require_memory,
    software,
    stored_array,
)
from .recipe import Recipe
from .sample import Sample

MANIFEST = "dataset.json"
CARD = "README.md"
PREVIEW = "preview.png"

LOCK = ".lock"


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

    def shard(self, index: int) -> Path:
        """Return the path of a shard."""
        return self.folder / "shards" / f"shard-{index:05d}.h5"

    def members(self, index: int) -> range:
        """Return the range of indices of a shard's samples."""
        first = index * self.samples_per_shard
        return range(first, min(first + self.samples_per_shard, self.count))

    def sample(self, index: int) -> Path:
        """Return the file of a sample that has not yet been packed into a shard."""
        return self.folder / "samples" / f"{index:06d}.h5"


def read_manifest(folder: Path) -> Named:
    """Return the recipe that made a data set, read from its manifest."""
    path = folder / MANIFEST
    text = read_text(path, 2**27)
    with refusing(f"{path}: it is not the manifest of a data set", *NO_RECORD):
        content = json.loads(text)
        counts = [content["count"], content["samples_per_shard"]]
        content["recipe"] = dict(content["recipe"])
    refuse_if(
        not all(isinstance(count, int) and count > 0 for count in counts),
        f"{path}: count, samples_per_shard = {short_repr(counts)}: they must be whole numbers above 0",
    )
    return dict(content)


def claim(folder: Path, recipe: Recipe) -> DataFolder:
    """Return the folder of a data set after writing its manifest; refuse a folder of another recipe or software."""

    def fixed(record: Named) -> Named:
        # Entries of a recipe that may differ: the count may grow, and the name, which is that of the file, changes no
        # bits.
        entries = {name: value for name, value in record["recipe"].items() if name not in {"count", "name"}}
        return {**{name: record[name] for name in facts if name in record}, "recipe": entries}

    scenes = {
        f"scene {index + 1}": scene_fingerprint(source.scene, {})
        for index, source in enumerate(recipe.scenes)
        if source.scene
    }
    facts = {**versions.stamped({}), "software": software(), "recipe": dict(recipe.content), "files": scenes}
    facts = dict(json.loads(json.dumps(facts)))
    if (folder / MANIFEST).exists():
        manifest = read_manifest(folder)
        changed = differences(fixed(manifest), fixed(facts))
        refuse_if(changed, f"{folder}: it holds other samples: {''.join(changed[:1])}; choose another folder")
        refuse_if(
            manifest["count"] > recipe.count,
            f"count = {recipe.count}: {folder} holds {manifest['count']} samples; it may only grow",
        )
    elif any(path.name != LOCK for path in folder.iterdir()):
        raise InputError(f"{folder}: it holds something else; choose an empty folder, or one that is not there")
    sizes = {"count": recipe.count, "samples_per_shard": recipe.samples_per_shard}
    write_json(folder / MANIFEST, {**sizes, "name": recipe.name, **facts})
    layout = DataFolder(folder, recipe.count, recipe.samples_per_shard)
    for part in (layout.shard(0), layout.sample(0)):
        part.parent.mkdir(exist_ok=True)
    return layout


_FACTS = "facts"

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
                group = file.create_group(group_name(sample.index))
                # An array of bytes, since HDF5's attributes hold at most 64 KiB.
                facts = np.frombuffer(json.dumps(sample.facts, sort_keys=True).encode(), np.uint8)
                for name, array in {**sample.arrays, _FACTS: facts}.items():
                    data = array if name == _FACTS else np.asarray(array, np.float32)
                    checked = {"chunks": data.shape, "fletcher32": True} if data.size else {}
                    group.create_dataset(name, data=data, **checked)
                sink.check(path)
        sink.check(path)


def open_shard(path: Path) -> Any:
    """Open a file of samples for reading."""
    h5py = h5py_module("a data set")
    with refusing(f"{path}: it is damaged:", OSError):
        return h5py.File(require_file(path), "r")


def samples_in(path: Path) -> set[int]:
    """Return the indices of the samples in a file, which may be missing; log that a file is damaged."""
    try:
        with open_shard(path) as file:
            return {int(name) for name in file}
    except InputError as error:
        if path.exists():
            _log.warning("%s; its samples are rendered again", error)
        return set()


def read_sample(file: Any, path: Path, index: int, names: Collection[str] | None = None) -> Sample:
    """Read a sample, or those of its arrays that are named, from an open file."""
    damaged = OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError, RecursionError
    with naming(path), refusing(f"sample {index} is damaged:", *damaged):
        refuse_if(group_name(index) not in file, f"it has no sample {index}")
        group = file[group_name(index)]
        arrays = {}
        for name in sorted(group) if names is None else [*names, _FACTS]:
            stored = stored_array(group, name)
            refuse_if(stored is None, f"sample {index}: it has no {name}; it has {', '.join(group)}")
            require_memory(float(stored.size) * stored.dtype.itemsize, f"{name} of sample {index}")
            arrays[name] = np.asarray(stored[()])
        facts = json.loads(arrays.pop(_FACTS).tobytes())
    return Sample(index, arrays, facts)


class DataSet:
    """A data set in a folder; ``dataset[17]`` is a `Sample`.

    Samples are read on request. A data set may be pickled and used in forked processes; each opens the files anew.

    Parameters
    ----------
    folder : path
        The folder of `make_dataset` or ``mitsuba-plenoptic dataset``.
    fields : collection of str, optional
        Names of the arrays to read. Default: all.
    """

    def __init__(self, folder: str | Path, fields: Collection[str] | None = None):
        self.folder = Path(folder)
        refuse_if(not self.folder.is_dir(), f"{folder}: there is no such folder of a data set")
        self.manifest = read_manifest(self.folder)
        self.fields = None if fields is None else tuple(fields)
        self._layout = DataFolder(self.folder, self.manifest["count"], self.manifest["samples_per_shard"])
        self._files: dict[int, Any] = {}
        self._process = os.getpid()
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
            return [self[shard] for shard in range(*index.indices(len(self)))]
        try:
            operator.index(index)
        except TypeError:
            kind = type(index).__name__
            raise TypeError(f"sample {short_repr(index)} of type {kind}: give a whole number, or a slice") from None
        number = int(require_number("sample", index))
        if not -len(self) <= number < len(self):
            raise IndexError(f"sample {index}: there are {len(self)}")
        index = number % len(self)
        shard = index // self._layout.samples_per_shard
        return read_sample(self._open(shard), self._layout.shard(shard), index, self.fields)

    def __iter__(self) -> Iterator[Sample]:
        for index in range(len(self)):
            yield self[index]

    def __getstate__(self) -> Named:
        return {**self.__dict__, "_files": {}}

    def _open(self, shard: int) -> Any:
        if self._process != os.getpid():
            # HDF5's handles are those of the process that opened them.
            self._files = {}
            self._process = os.getpid()
        if shard not in self._files:
            # Files that a data set keeps open: systems allow a process a few hundred, and large data sets have
            # thousands.
            if len(self._files) >= 32:
                # It is closed once no other thread reads it.
                del self._files[next(iter(self._files))]
            self._files[shard] = open_shard(self._layout.shard(shard))
        return self._files[shard]
