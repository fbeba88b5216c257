"""The response of one object plane, cell by cell, and its adjoint."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...runtime.backend import backend
from ...runtime.blas import single_threaded_blas
from ...runtime.fft import worker_count
from .cells import Cells, CellSet
from .kernels import Block, Kernel

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
