"""Making a data set: sample by sample, so that a run that was killed goes on where it stood."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..io.files import remove_leftovers
from ..runtime.batches import BatchMap
from ..runtime.jobs import Progress
from ..runtime.variant import set_variant
from .card import write_card, write_checksums, write_preview
from .layout import CARD, CHECKSUMS, PREVIEW, Layout, checksum, claim, locked, recorded_checksums
from .reader import DataSet
from .recipe import Recipe
from .sample import Sample, make_sample, open_sample
from .shards import open_shard, read_sample, whole_samples, write_samples

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SampleTask:
    """Renders one sample and writes it to a file of its own, in this process or in another."""

    recipe: Recipe
    index: int
    # The file, which a worker elsewhere must see under the same name.
    path: Path

    @property
    def samples(self) -> int:
        """Of fields: so many that it travels alone."""
        return 2**62

    def prepare(self) -> Callable[[], int]:
        """Return the function that does it, and returns the sample's number."""
        return partial(_make, self.recipe, self.index, self.path)


def make_dataset(
    recipe: Recipe, folder: str | Path, *, batch_map: BatchMap | None = None, progress: Progress | None = None
) -> DataSet:
    """Make a data set, or go on making it.

    Every sample is a file of its own until all of its shard are there. A run that was killed, at whatever moment,
    goes on when it is started again, and ends with the bytes of one that was not. A data set of the same recipe with a
    smaller count grows. Samples that are there are compared with their digests first; damaged ones are named in the log
    and rendered again. One process at a time makes a data set.

    Parameters
    ----------
    recipe : Recipe
        What `read_recipe` returned.
    folder : path
        Where it is to lie; made if it is not there.
    batch_map : callable, optional
        Who renders, for example `Cluster`; workers must see folder and scene files under the same names. Default: this
        process.
    progress : callable, optional
        Called with the samples that are done and their number.

    Returns
    -------
    DataSet

    Raises
    ------
    InputError
        If the folder holds something else, another process is making it, or a sample cannot be rendered.
    """
    folder = Path(folder).absolute()
    set_variant(recipe.variant)
    _try_scenes(recipe)
    with locked(folder):
        _produce(recipe, claim(folder, recipe), batch_map, progress)
    return DataSet(folder)


def _produce(recipe: Recipe, layout: Layout, batch_map: BatchMap | None, progress: Progress | None) -> None:
    # Whatever is there is compared with its digests before anything of it is dropped.
    kept = {
        number: whole_samples(layout.shard(number)).intersection(layout.members(number))
        for number in range(layout.shards)
    }
    recorded = recorded_checksums(layout.folder)
    unchanged = {number for number in kept if _as_recorded(layout, number, recorded)}
    missing = []
    for number, there in kept.items():
        for index in layout.members(number):
            if index not in there and index not in whole_samples(layout.sample(index)):
                layout.sample(index).unlink(missing_ok=True)
                missing.append(index)
    _clear(layout, kept)
    done = recipe.count - len(missing)
    tasks = [SampleTask(recipe, index, layout.sample(index)) for index in missing]
    results: Iterable[int] = batch_map(tasks) if batch_map and tasks else (task.prepare()() for task in tasks)
    waiting = set(missing)

    def pack() -> None:
        for number in [number for number in kept if not waiting.intersection(layout.members(number))]:
            there = kept.pop(number)
            if there != set(layout.members(number)) or number not in unchanged:
                _pack(layout, number, there)

    pack()
    if progress:
        progress(done, recipe.count)
    for index in results:
        waiting.discard(index)
        done += 1
        pack()
        if progress:
            progress(done, recipe.count)
    shutil.rmtree(layout.sample(0).parent)
    made = DataSet(layout.folder)
    write_preview(layout.folder / PREVIEW, made)
    write_card(layout.folder / CARD, recipe, made)
    write_checksums(layout.folder / CHECKSUMS, layout)


def _as_recorded(layout: Layout, number: int, recorded: Mapping[str, str]) -> bool:
    """Return whether a shard has the checksum that an earlier run wrote, if one did."""
    path = layout.shard(number)
    expected = recorded.get(path.relative_to(layout.folder).as_posix())
    if expected is None or not path.exists() or checksum(path) == expected:
        return True
    _log.warning("%s: its checksum differs from the recorded one; it is written again from its undamaged samples", path)
    return False


def _make(recipe: Recipe, index: int, path: Path) -> int:
    try:
        write_samples(path, [make_sample(recipe, index)])
    except InputError as error:
        raise InputError(f"sample {index}: {error}") from None
    return index


def _try_scenes(recipe: Recipe) -> None:
    """Load one scene of each source, so that what is wrong with a file is told before anything is rendered."""
    left = set(range(len(recipe.scenes)))
    for index in range(min(recipe.count, 1000)):
        plan = recipe.plan(index)
        if plan.source in left:
            left.discard(plan.source)
            open_sample(recipe, plan)
        if not left:
            return


def _clear(layout: Layout, kept: Mapping[int, set[int]]) -> None:
    """Remove what processes that were killed left behind, and samples that are in shards already."""
    for path in (layout.sample(0).parent, layout.shard(0).parent):
        for leftover in path.glob(".*"):
            shutil.rmtree(leftover, ignore_errors=True)
    for name in (CARD, PREVIEW, CHECKSUMS):
        remove_leftovers(layout.folder / name)
        # They tell of a data set that is complete.
        (layout.folder / name).unlink(missing_ok=True)
    for index in set().union(*kept.values()):
        layout.sample(index).unlink(missing_ok=True)


def _pack(layout: Layout, number: int, there: set[int]) -> None:
    """Put the samples of a shard into its file, with those that are in it."""
    path = layout.shard(number)

    def samples() -> Iterator[Sample]:
        for index in layout.members(number):
            source = path if index in there else layout.sample(index)
            file: Any
            with open_shard(source) as file:
                yield read_sample(file, source, index)

    write_samples(path, samples())
    for index in layout.members(number):
        layout.sample(index).unlink(missing_ok=True)
