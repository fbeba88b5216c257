"""Reading a data set, as NumPy arrays."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from ..errors import InputError, require_count
from ..io.files import read_text
from .layout import CHECKSUMS, LARGEST_LIST, Layout, checksum, read_manifest
from .sample import Sample
from .shards import open_shard, read_sample


class DataSet:
    """A data set in its folder: ``dataset[17]`` is a `Sample`.

    Samples are read when they are asked for. It may be pickled and used in forked processes; each opens the files anew.

    Parameters
    ----------
    folder : path
        What `make_dataset` or ``mitsuba-plenoptic dataset`` wrote.
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
        self._layout = Layout(self.folder, self.manifest["count"], self.manifest["samples_per_shard"])
        self._files: dict[int, Any] = {}
        self._process = os.getpid()
        for number in range(self._layout.shards):
            if not self._layout.shard(number).is_file():
                raise InputError(f"{self._layout.shard(number)}: it is missing: make the data set again to go on")

    def __len__(self) -> int:
        return self._layout.count

    def __getitem__(self, index: int) -> Sample:
        """Read a sample by its number."""
        if index >= len(self):
            raise IndexError(f"sample {index}: there are {len(self)}")
        index = require_count("sample", index, minimum=0)
        number = index // self._layout.samples_per_shard
        return read_sample(self._open(number), self._layout.shard(number), index, self.fields)

    def __iter__(self) -> Iterator[Sample]:
        for index in range(len(self)):
            yield self[index]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_files": {}}

    def damaged(self) -> list[str]:
        """Compare all files with their checksums, and return the names of those that differ or are missing.

        Raises
        ------
        InputError
            If there are no checksums.
        """
        lines = read_text(self.folder / CHECKSUMS, LARGEST_LIST).splitlines()
        found = []
        for expected, _, name in (line.partition("  ") for line in lines):
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
            self._files[number] = open_shard(self._layout.shard(number))
        return self._files[number]
