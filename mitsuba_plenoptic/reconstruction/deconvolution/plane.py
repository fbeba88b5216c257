"""The response of one object plane, cell by cell, and its adjoint."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ...runtime.blas import single_threaded_blas
from ...runtime.fft import worker_count
from .cells import Cells, CellSet
from .kernels import Kernel

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
        self._cells, self._sampled, self._zones = cells, sampled, zones
        steps = np.concatenate([zone.kernel.steps for zone in zones])
        self.lit = sampled.grown(-steps.max(0), -steps.min(0))
        self._sources = [
            self.lit.find(sampled.index[zone.members][:, None] - zone.kernel.steps).astype(np.int32) for zone in zones
        ]

    @property
    def shape(self) -> tuple[int, int]:
        """Cells and their bins."""
        return len(self.lit), self._cells.bins[0] * self._cells.bins[1]

    def add_forward(self, values: NDArray[np.float32], samples: NDArray[np.float32]) -> None:
        """Add the light of bins to samples.

        Parameters
        ----------
        values : float32 array (cells, bins)
            Of the cells of `lit`.
        samples : float32 array (cells, rows, columns)
            Of the sampled cells.
        """
        dark = np.zeros((1, values.shape[1]), np.float32)
        padded = np.concatenate([values, dark])

        def work(zone: Zone, sources: NDArray[np.int32]) -> None:
            around = padded[sources]
            for block in zone.kernel.blocks:
                light = around[:, block.steps].reshape(len(around), -1) @ block.matrix
                target = samples[zone.members, block.rows, block.columns]
                samples[zone.members, block.rows, block.columns] = target + light.reshape(target.shape)

        for _ in _each(work, self._zones, self._sources):
            pass

    def adjoint(self, samples: NDArray[np.float32]) -> NDArray[np.float32]:
        """Weigh the samples of cells, (cells, rows, columns), by the light of each bin; returns (cells, bins)."""
        result = np.zeros((len(self.lit) + 1, self.shape[1]), np.float32)

        def work(zone: Zone, sources: NDArray[np.int32]) -> NDArray[np.float32]:
            around = np.zeros((*sources.shape, result.shape[1]), np.float32)
            for block in zone.kernel.blocks:
                part = samples[zone.members, block.rows, block.columns].reshape(len(around), -1)
                light = part @ block.matrix.T
                around[:, block.steps] += light.reshape(len(around), len(block.steps), -1)
            return around

        for sources, around in zip(self._sources, _each(work, self._zones, self._sources), strict=True):
            for step in range(sources.shape[1]):
                # A step takes every cell to another; only what no bin lights is met twice.
                result[sources[:, step]] += around[:, step]
        return result[:-1]


def _each(
    work: Callable[[Zone, NDArray[np.int32]], Result], zones: list[Zone], sources: list[NDArray[np.int32]]
) -> Iterator[Result]:
    """Compute zones on all cores, and yield their results in order."""
    with single_threaded_blas(), ThreadPoolExecutor(worker_count()) as pool:
        yield from pool.map(work, zones, sources)
