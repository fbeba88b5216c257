"""How the bins of one cell light the samples of the cells around: a few dense blocks of a mostly dark array.

Through one lens a bin lights a spot; the lens beside it has that spot elsewhere. So of all pairs of a cell and a block
of its samples few hold light, and the others are left out. What they would hold is given to those that stay, all alike,
so that no power is lost.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...runtime.backend import backend, backend_of
from ...runtime.batches import Part
from ...runtime.fft import worker_count
from ...runtime.limits import single_threaded_blas
from .cells import Cells, CellSet

_BLOCK = 8
"""Samples along an axis of a block, about."""

LEAST = 2e-3
"""Fraction of the power that is left out."""


@dataclass(frozen=True)
class Block:
    """What one block of a cell's samples gets.

    Attributes
    ----------
    rows, columns : slice
        The samples.
    steps : int64 array (n,)
        Numbers of the kernel's steps from where light comes.
    matrix : float32 array (n * bins, samples)
        The light of each bin in each sample.
    """

    rows: slice
    columns: slice
    steps: NDArray[np.int64]
    matrix: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Kernel:
    """The response of the bins of any cell near some place.

    Attributes
    ----------
    steps : int64 array (steps, 2)
        From a cell with bins to the cells whose samples they light.
    blocks : list of Block
        Blocks of samples.
    """

    steps: NDArray[np.int64]
    blocks: list[Block]

    @property
    def memory(self) -> int:
        """Bytes of its matrices."""
        return sum(block.matrix.nbytes for block in self.blocks)


def on_disk(kernels: Sequence[Kernel], path: Path) -> list[Kernel]:
    """Write the matrices of kernels into one file, and return kernels that read them from there.

    What is read is kept by the system as long as there is memory for it, and dropped when there is not.

    Raises
    ------
    InputError
        If the disk has no room.
    """
    try:
        with path.open("wb") as file:
            for kernel in kernels:
                for block in kernel.blocks:
                    file.write(block.matrix.data)
    except OSError as error:
        raise InputError(
            f"{path.parent}: the response needs room there: {error.strerror}; TMPDIR names another folder"
        ) from None
    values, place, found = np.memmap(path, np.float32, "r"), 0, []
    for kernel in kernels:
        blocks = []
        for block in kernel.blocks:
            matrix = values[place : place + block.matrix.size].reshape(block.matrix.shape)
            blocks.append(replace(block, matrix=matrix))
            place += matrix.size
        found.append(Kernel(kernel.steps, blocks))
    return found


def make_kernel(cells: Cells, cell: NDArray[np.int64], spreads: Iterable[list[Part]]) -> Kernel:
    """Gather the point spreads of a cell's bins.

    Parameters
    ----------
    cells : Cells
        The cells.
    cell : int64 array (2,)
        The cell whose bins they are.
    spreads : iterable of lists of Part
        For each bin what is to be added, in units of intensity on samples of the grid.

    Returns
    -------
    Kernel
    """
    found = []
    for number, parts in enumerate(spreads):
        for part in parts:
            reached = cells.holding(part.box)
            sums = backend_of(part.sums).to_host(part.sums)
            values = cells.split(sums[0], part.box, reached)
            found.append((number, reached.index - cell, values))
    low = np.min([index.min(0) for _, index, _ in found], axis=0)
    high = np.max([index.max(0) for _, index, _ in found], axis=0)
    size = high - low + 1
    count = len({number for number, _, _ in found})
    dense = np.zeros((size[1], size[0], count, *found[0][2].shape[1:]), np.float32)
    for number, index, values in found:
        place = index - low
        dense[place[:, 1], place[:, 0], number] += values
    steps = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), axis=-1).reshape(-1, 2) + low
    return sparse_kernel(steps, dense.reshape(-1, *dense.shape[2:]))


def sparse_kernel(steps: NDArray[np.int64], dense: NDArray[np.float32]) -> Kernel:
    """Leave out of a response, (steps, bins, rows, columns), what is next to dark."""
    np.maximum(dense, 0, out=dense)  # what interpolation leaves below zero between samples is not light
    edges = [
        np.linspace(0, length, max(1, round(length / _BLOCK)) + 1).round().astype(int) for length in dense.shape[2:]
    ]
    parts = [
        (slice(*rows), slice(*columns))
        for rows, columns in itertools.product(*(itertools.pairwise(edge.tolist()) for edge in edges))
    ]
    power = np.stack([dense[:, :, rows, columns].sum(axis=(1, 2, 3), dtype=np.float64) for rows, columns in parts])
    order = np.sort(power, axis=None)
    upto = np.cumsum(order)
    dark = int(np.searchsorted(upto, LEAST * upto[-1]))
    least = order[dark]
    scale = np.float32(upto[-1] / (upto[-1] - (upto[dark - 1] if dark else 0)))
    blocks, used = [], power >= least
    kept = np.flatnonzero(used.any(axis=0))
    number = np.cumsum(used.any(axis=0)) - 1
    for (rows, columns), lit in zip(parts, used, strict=True):
        which = np.flatnonzero(lit)
        if len(which):
            matrix = dense[which][:, :, rows, columns].reshape(len(which) * dense.shape[1], -1) * scale
            blocks.append(Block(rows, columns, number[which], np.ascontiguousarray(matrix)))
    return Kernel(steps[kept], blocks)


Result = TypeVar("Result")


@dataclass(frozen=True)
class Zone:
    """Cells that get their light by one kernel.

    Attributes
    ----------
    members : int64 array (n,)
        Numbers of the cells whose samples it gives.
    kernel : Kernel
        The response of the bins about its middle.
    """

    members: NDArray[np.int64]
    kernel: Kernel


def zones(cells: CellSet, width: int) -> list[NDArray[np.int64]]:
    """Cut cells into zones of so many rows, and as many cells of each.

    Returns
    -------
    list of int64 arrays
        Numbers of each zone's cells.
    """
    row = np.repeat(np.arange(len(cells.count)), cells.count)
    column = np.arange(len(cells)) - cells.start[row]
    along, down = (-(-int(count) // width) for count in (cells.count.max(), len(cells.count)))
    # as even as they can be
    zone = row * down // len(cells.count) * along + np.minimum(column * along // int(cells.count.max()), along - 1)
    return [np.flatnonzero(zone == number) for number in np.unique(zone)]


class PlaneResponse:
    """What the samples of all cells get of the bins of a plane.

    Parameters
    ----------
    cells : Cells
        The cells.
    sampled : CellSet
        The cells whose samples are recorded.
    zones : list of Zone
        Zones of these cells.

    Attributes
    ----------
    lit : CellSet
        The cells whose bins light them.
    """

    def __init__(self, cells: Cells, sampled: CellSet, zones: list[Zone]) -> None:
        self._cells = cells
        steps = np.concatenate([zone.kernel.steps for zone in zones])
        self.lit = sampled.grown(-steps.max(0), -steps.min(0))
        asarray = backend().arrays.asarray
        self._zones = [
            _Placed(
                zone.kernel.blocks,
                [asarray(block.steps) for block in zone.kernel.blocks],
                asarray(zone.members),
                asarray(self.lit.find(sampled.index[zone.members][:, None] - zone.kernel.steps).astype(np.int32)),
            )
            for zone in zones
        ]

    @property
    def shape(self) -> tuple[int, int]:
        """Cells and their bins."""
        return len(self.lit), self._cells.bins[0] * self._cells.bins[1]

    def add_forward(self, values: NDArray[np.float32], samples: Any) -> None:
        """Add the light of bins to samples.

        Parameters
        ----------
        values : float32 array (cells, bins)
            Of the cells of `lit`.
        samples : float32 array (cells, rows, columns)
            Of the sampled cells, on the backend's device.
        """
        arrays = backend().arrays
        padded = arrays.asarray(np.concatenate([values, np.zeros((1, values.shape[1]), np.float32)]))

        def work(zone: _Placed) -> None:
            around = padded[zone.sources]
            for block, steps in zip(zone.blocks, zone.steps, strict=True):
                light = around[:, steps].reshape(len(around), -1) @ arrays.asarray(block.matrix)
                target = samples[zone.members, block.rows, block.columns]
                samples[zone.members, block.rows, block.columns] = target + light.reshape(target.shape)

        for _ in _each(work, self._zones):
            pass

    def adjoint(self, samples: Any) -> NDArray[np.float32]:
        """Weigh the samples of cells by the light of each bin.

        Parameters
        ----------
        samples : float32 array (cells, rows, columns)
            Of the sampled cells, on the backend's device.

        Returns
        -------
        float32 array (cells, bins)
        """
        arrays, bins = backend().arrays, self.shape[1]
        result = arrays.zeros((len(self.lit) + 1, bins), np.float32)

        def work(zone: _Placed) -> Any:
            around = arrays.zeros((*zone.sources.shape, bins), np.float32)
            for block, steps in zip(zone.blocks, zone.steps, strict=True):
                part = samples[zone.members, block.rows, block.columns].reshape(len(around), -1)
                light = part @ arrays.asarray(block.matrix).T
                around[:, steps] += light.reshape(len(around), len(block.steps), -1)
            return around

        for zone, around in zip(self._zones, _each(work, self._zones), strict=True):
            for step in range(around.shape[1]):
                # A step takes every cell to another; only what no bin lights is met twice.
                result[zone.sources[:, step]] += around[:, step]
        return np.asarray(backend().to_host(result))[:-1]


@dataclass(frozen=True)
class _Placed:
    """A zone: its blocks, and on the backend's device the steps of each, its members and where their light is from."""

    blocks: list[Block]
    steps: list[Any]
    members: Any
    sources: Any


def _each(work: Callable[[_Placed], Result], zones: list[_Placed]) -> Iterator[Result]:
    """Compute zones on all cores, and yield their results in order; a CUDA device takes its work from one."""
    with single_threaded_blas(), ThreadPoolExecutor(1 if backend().is_cuda else worker_count()) as pool:
        yield from pool.map(work, zones)
