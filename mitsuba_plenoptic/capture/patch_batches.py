"""Batches of point spreads, which any thread, process or machine can compute: for a sum, and for its adjoint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..runtime.batches import Box, Part
from .grid import Grid, Placement
from .patch import PatchBatch
from .pupil_weights import PupilWeights
from .tile import Copies, Tile


@dataclass(frozen=True)
class Fields:
    """What the fields of a batch are made of; attributes as of `PatchBatch`."""

    grid: Grid
    placement: Placement
    positions: NDArray[np.float64]
    pupil_weights: PupilWeights | None

    @property
    def samples(self) -> int:
        """Samples of all patches."""
        return int((self.placement.samples**2).sum())

    def make(self, amplitudes: NDArray[np.float64]) -> PatchBatch:
        """Make them, each times a factor."""
        return PatchBatch(self.grid, self.placement, self.positions, amplitudes, self.pupil_weights)


@dataclass(frozen=True)
class Scatter:
    """Point spreads to be added, each with factors on its field and on its copies."""

    fields: Fields
    amplitudes: NDArray[np.float64]
    copies: list[Copies]

    @property
    def samples(self) -> int:
        """Samples of all patches."""
        return self.fields.samples

    def prepare(self) -> Callable[[], Part]:
        """Make the fields, and return the function that adds their intensities."""
        return partial(_sum, self.fields.make(self.amplitudes), self.copies)


def _sum(batch: PatchBatch, copies: list[Copies]) -> Part:
    tile = Tile(batch, copies)
    sums = tile.sum()
    return Part(Box(int(tile.corner[0]), int(tile.corner[1]), sums.shape[2], sums.shape[1]), sums)


@dataclass(frozen=True)
class Gather:
    """Point spreads to be multiplied with the samples of the tile that they reach."""

    fields: Fields
    copies: list[Copies]
    tile: NDArray[np.float32]

    @property
    def samples(self) -> int:
        """Samples of all patches."""
        return self.fields.samples

    def prepare(self) -> Callable[[], list[NDArray[np.float64]]]:
        """Make the fields, and return the function that multiplies their intensities with the tile."""
        return partial(_products, self.fields.make(np.ones(len(self.copies))), self.copies, self.tile)


def _products(batch: PatchBatch, copies: list[Copies], tile: NDArray[np.float32]) -> list[NDArray[np.float64]]:
    return Tile(batch, copies).products(tile)
