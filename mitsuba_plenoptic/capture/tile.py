"""Intensities of patches: added to a part of the grid, or multiplied with one."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..runtime.backend import backend
from .cells import Cells
from .patch import PatchBatch, Workspace


@dataclass(frozen=True)
class Copies:
    """Where and how strongly the intensity of one point spread is added: at its own place, and at copies of it.

    Attributes
    ----------
    shifts : int array (copies, 2)
        Samples along x and y by which each copy is moved.
    weights : float32 array (copies, channels)
        Factors on the intensity.
    """

    shifts: NDArray[np.int64]
    weights: NDArray[np.float32]


class Tile:
    """The part of the grid that the point spreads of one batch reach.

    Parameters
    ----------
    batch : PatchBatch
        Whose patches it covers.
    copies : list of Copies
        For each point of the batch.
    """

    def __init__(self, batch: PatchBatch, copies: list[Copies]) -> None:
        self._batch, self._copies = batch, copies
        self.corner, self.size = tile_extent(batch.corner, batch.samples, copies)
        self._places = [corner + copy.shifts - self.corner for corner, copy in zip(batch.corner, copies, strict=True)]
        self._arrays = backend().arrays
        self._block = min(batch.sizes.block, batch.samples**2)
        self._scratch = self._arrays.empty((2, self._block), np.float32)
        self._squares = self._arrays.empty(2 * self._block, np.float32)

    def sum(self) -> NDArray[np.float32]:
        """Add the weighted intensities of all copies.

        Returns
        -------
        float32 array (channels, rows, columns)
        """
        cells = Cells.of([copy.shifts for copy in self._copies], self._batch.samples)
        sums = self._sum_one_by_one() if cells is None else self._sum_together(cells)
        return sums.transpose(0, 2, 1)

    def _sum_one_by_one(self) -> Any:
        """Add copy by copy, (channels, samples along x, along y)."""
        sums = self._arrays.zeros((self._channels, int(self.size[0]), int(self.size[1])), np.float32)
        targets = [
            [
                (int(place[0]), int(place[1]), int(channel), weights[channel])
                for place, weights in zip(places, copy.weights, strict=True)
                for channel in np.flatnonzero(weights)
            ]
            for places, copy in zip(self._places, self._copies, strict=True)
        ]
        for point, along_x, along_y, intensity, weighted in self._intensities():
            for x, y, channel, weight in targets[point]:
                target = sums[channel, x + along_x.start : x + along_x.stop, y + along_y.start : y + along_y.stop]
                if weight == 1:
                    target += intensity
                else:
                    target += self._arrays.multiply(intensity, weight, out=weighted)
        return sums

    def _sum_together(self, cells: Cells) -> Any:
        """Add by cells, (channels, samples along x, along y)."""
        sums, last = cells.sum(self.size, self._channels, self._batch.together), 0
        for point, along_x, along_y, intensity, _ in self._intensities():
            # Those that are transformed together come in turns.
            if point // self._batch.together != last and sums.free < self._batch.together:
                sums.add()
            last = point // self._batch.together
            plane = sums.plane(point, self._places[point], self._copies[point].weights)
            plane[along_x, along_y] = intensity
        return sums.total()

    @property
    def _channels(self) -> int:
        return int(self._copies[0].weights.shape[1])

    def products(self, samples: NDArray[np.float32]) -> list[NDArray[np.float64]]:
        """Multiply the intensity of every copy with the samples of the tile, and sum the products.

        Parameters
        ----------
        samples : float32 array (channels, rows, columns)
            As large as the tile.

        Returns
        -------
        list of float64 arrays (copies, channels)
            For each point.
        """
        turned = self._arrays.ascontiguousarray(self._arrays.asarray(samples).transpose(0, 2, 1))
        products = [np.zeros((len(places), len(turned))) for places in self._places]
        for point, along_x, along_y, intensity, _ in self._intensities():
            for copy, (x, y) in enumerate(self._places[point].tolist()):
                part = turned[:, x + along_x.start : x + along_x.stop, y + along_y.start : y + along_y.stop]
                # Row by row in single precision, so that few numbers are added in it.
                rows = self._arrays.einsum("cij,ij->ci", part, intensity).sum(1, dtype=np.float64)
                products[point][copy] += self._batch.libraries.to_host(rows)
        return products

    def _intensities(self) -> Iterator[tuple[int, slice, slice, Any, Any]]:
        """Yield the intensities of all points in parts, (along x, along y), and as much memory for work."""
        batch, arrays = self._batch, self._arrays
        work = Workspace(batch)
        for first in range(0, len(self._copies), batch.together):
            stop = min(len(self._copies), first + batch.together)
            for point, along_y, field in batch.to_detector(first, stop, work):
                rows = max(1, self._block // field.shape[1])
                for start, end in itertools.pairwise([*range(0, len(field), rows), len(field)]):
                    part = field[start:end]
                    intensity, weighted = self._scratch[:, : part.size].reshape(2, *part.shape)
                    squares = self._squares[: 2 * part.size].reshape(len(part), -1)
                    arrays.copyto(squares.view(np.complex64), part)
                    arrays.multiply(squares, squares, out=squares)
                    arrays.add(squares[:, ::2], squares[:, 1::2], out=intensity)
                    yield point, slice(start, end), along_y, intensity, weighted


def tile_extent(
    corner: NDArray[np.int64], samples: int, copies: list[Copies]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return first sample and size, along x and y, of what square patches and their copies reach."""
    corners = [place + copy.shifts for place, copy in zip(corner, copies, strict=True)]
    low = np.min([place.min(0) for place in corners], axis=0)
    return low, np.max([place.max(0) for place in corners], axis=0) + samples - low
