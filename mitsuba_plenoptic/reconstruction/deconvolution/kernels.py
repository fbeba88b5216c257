"""How the bins of one cell light the samples of the cells around: a few dense blocks of a mostly dark array.

Through one lens a bin lights a spot; the lens beside it has that spot elsewhere. So of all pairs of a cell and a block
of its samples few hold light, and the others are left out. What they would hold is given to those that stay, all alike,
so that no power is lost.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...runtime.backend import backend_of
from ...runtime.batches import Part
from .cells import Cells

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
