r"""Total variation of planes of bins, by which an iteration prefers uniform areas with sharp borders.

.. math:: \mathrm{TV}(x) = \sum \sqrt{(\Delta_1 x)^2 + (\Delta_2 x)^2 + \epsilon^2}

(Rudin, Osher and Fatemi 1992, Physica D 60, 259), with the differences to the next bin along the rows of the lattice
and across them. Its gradient is :math:`-\mathrm{div}(\nabla x / |\nabla x|)`, by which Richardson's and Lucy's step is
divided (Dey et al. 2006, Microscopy Research and Technique 69, 260). Bins may be wider than high: differences count
over the shorter side, so that the gradient is at most :math:`2 + \sqrt 2`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ...errors import refusing, require_number
from ...light.detector import Detector
from .cells import BinCells, CellSet

_DARKEST = 0.01
"""Variance, over the mean one, that is added to every pixel's where residuals are weighted."""


@dataclass(frozen=True)
class Noise:
    r"""Variance of a pixel of value v: :math:`v / n + \sigma^2`."""

    electrons: float
    dark: float

    @classmethod
    def of(cls, exposure: Any, photons: float | None) -> Noise | None:
        """Return the noise for `photons`, if given, otherwise for the exposure that `expose` recorded."""
        if photons is not None:
            return cls(require_number("photons", photons, positive=True), 0.0)
        if exposure is None:
            return None
        # EMVA 1288, Release 4.0 Linear, equation for the digital number.
        with refusing("exposure of the capture: it is not one that 'expose' writes:", KeyError, TypeError):
            photons = exposure["photons"]
            # Version 1.0 knew no stray light.
            detector = Detector(
                **{field.name: {"stray_light": 0.0, **exposure}[field.name] for field in fields(Detector)}
            )
        assert detector.gain is not None
        electrons = detector.quantum_efficiency * require_number("photons", photons, positive=True)
        dark = detector.dark_electrons + detector.read_noise**2 + 1 / (12 * detector.gain**2)
        return cls(electrons, dark / electrons**2)

    @property
    def shift(self) -> float:
        """Variance of a dark pixel divided by the value of one electron."""
        return self.dark * self.electrons

    def misfit(self, image: NDArray[np.float32], model: NDArray[np.float32]) -> float:
        """Return the squared residual, weighted by the pixels' variances, divided by its expectation for noise alone.

        This is Pearson's statistic, of expectation 1. Pixels that should be nearly dark get a lower weight than
        Pearson's, since otherwise one photon of light unknown to the model would outweigh all pixels.
        """
        variance = np.maximum(model, 0) / np.float32(self.electrons) + np.float32(self.dark)
        weight = 1 / (variance + np.float32(_DARKEST * float(variance.mean()) + 1e-30))
        residual = float(((image - model) ** 2 * weight).sum(dtype=np.float64))
        return residual / max(float((variance * weight).sum(dtype=np.float64)), 1e-30)


_SMOOTH = 1e-3
"""Largest step between bins, over their mean, that counts as even."""


Differences = tuple[sparse.csr_matrix, sparse.csr_matrix]
"""The steps to the next bin along a row and across the rows, as matrices over all bins of a plane."""


class TotalVariation:
    """Total variation of planes, with its gradient."""

    def __init__(self, differences: Sequence[Differences]) -> None:
        self._differences = differences

    @classmethod
    def of_cells(cls, cells: BinCells, lit: Sequence[CellSet]) -> TotalVariation:
        """Return the total variation for bins grouped in the cells of each plane."""
        return cls([_differences(cells, some) for some in lit])

    @classmethod
    def of_grids(cls, shapes: Sequence[tuple[int, int]]) -> TotalVariation:
        """Return the total variation of planes of upright square bins, (rows, columns)."""
        known = {}
        for shape in set(shapes):
            number = np.arange(math.prod(shape)).reshape(shape)
            right, below = np.full(shape, -1), np.full(shape, -1)
            right[:, :-1], below[:-1] = number[:, 1:], number[1:]
            whole = np.ones(number.size)
            known[shape] = _steps([(right.ravel(), whole)], 1.0), _steps([(below.ravel(), whole)], 1.0)
        return cls([known[shape] for shape in shapes])

    def gradient(
        self, values: Sequence[NDArray[np.float32]], inside: Sequence[NDArray[np.bool_]]
    ) -> list[NDArray[np.float32]]:
        """Return the dimensionless gradient, one value for each bin."""
        slopes = []
        for differences, part, mask in zip(self._differences, values, inside, strict=True):
            flat, beyond = part.ravel(), (~mask.ravel()).astype(np.float32)
            # Steps to bins that are not inside do not count.
            steps = [np.where(abs(matrix) @ beyond > 0, np.float32(0), matrix @ flat) for matrix in differences]
            even = _SMOOTH * float(part[mask].mean()) if mask.any() else 0.0
            length = np.sqrt(sum(np.square(step) for step in steps) + np.float32(even**2 + 1e-30))
            slope = sum(matrix.T @ (step / length) for matrix, step in zip(differences, steps, strict=True))
            slopes.append(np.asarray(slope, np.float32).reshape(part.shape))
        return slopes


def _differences(cells: BinCells, lit: CellSet) -> Differences:
    """Return the matrices of differences between neighbouring bins of cells, along rows and across them."""
    across, down = cells.bins
    width, height = cells.bin_sizes
    index = lit.index
    line = (index[:, 1, None, None] * down + np.arange(down)[:, None]) + np.zeros(across, np.int64)
    column = (index[:, 0, None, None] * across + np.arange(across)) + np.zeros((down, 1), np.int64)
    line, column = line.ravel(), column.ravel()
    # Rows of cells may be staggered by a part of a bin.
    aside = ((line + 1) // down - line // down) * (float(cells.vectors[1, 0]) / width)
    left = np.floor(column - aside + 1e-9).astype(np.int64)
    share = np.clip(column - aside - left, 0, 1)
    share[share < 1e-6] = 0

    def number(column: NDArray[np.int64], line: NDArray[np.int64]) -> NDArray[np.int64]:
        cell = lit.find(np.stack([column // across, line // down], axis=-1))
        found = (cell * down + line % down) * across + column % across
        return np.asarray(np.where(cell < len(lit), found, -1))

    shortest = min(width, height)
    along = _steps([(number(column + 1, line), np.ones(len(line)))], shortest / width)
    below = [(number(left, line + 1), 1 - share), (number(left + 1, line + 1), share)]
    return along, _steps(below, shortest / height)


def _steps(neighbours: list[tuple[NDArray[np.int64], NDArray[np.float64]]], scale: float) -> sparse.csr_matrix:
    """Return the matrix of differences from every bin to a mean of neighbours; 0 for bins without all neighbours."""
    count = len(neighbours[0][0])
    bins = np.arange(count)
    whole = np.all([(number >= 0) | (share == 0) for number, share in neighbours], axis=0)
    rows, columns, values = [bins[whole]], [bins[whole]], [np.full(int(whole.sum()), -scale)]
    for number, share in neighbours:
        used = whole & (share > 0)
        rows.append(bins[used])
        columns.append(number[used])
        values.append(scale * share[used])
    entries = np.concatenate(values).astype(np.float32), (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_matrix(entries, shape=(count, count))
