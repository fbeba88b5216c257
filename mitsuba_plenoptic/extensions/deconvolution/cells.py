r"""The periodic cells of a camera: groups of object-plane bins and of detector samples that repeat together.

If a bin moves so that its image on the MLA moves by a lattice vector v, its point spread moves on the detector by
:math:`v (b + z) / b`, and is otherwise unchanged except for the main lens's aberrations. On `Grid` that is a whole
number of samples. So the plane of the bins and the grid are divided into *cells*, one for each lens (one for three
lenses where three types are interleaved), and the response of all bins is known from the bins of one cell.

A cell (I, J) contains the bins around :math:`I v_1 + J v_2` on the MLA, a rectangle as wide as :math:`v_1` and as
high as :math:`v_2`, and the samples around the same position times :math:`(b + z) / b`. :math:`v_1` is along x; rows
of cells may be staggered. All coordinates are in the frame of the lattice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import numpy as np
from scipy.sparse import csr_array, vstack

from ...camera import PlenopticCamera
from ...lenses import FittedLens
from ...points import Grid
from ...runtime import Box, Doubles, Integers, Shape, backend_of, turn


@dataclass(frozen=True)
class CellSet:
    """Cells in rows; each row is a run without gaps."""

    top: int
    first: Integers
    count: Integers

    def __len__(self) -> int:
        return int(self.count.sum())

    @cached_property
    def start(self) -> Integers:
        """Index of the first cell of each row."""
        return np.cumsum(self.count) - self.count

    @cached_property
    def index(self) -> Integers:
        """I and J of all cells, (n, 2)."""
        row = np.repeat(np.arange(len(self.count)), self.count)
        return np.stack([np.arange(len(self)) - self.start[row] + self.first[row], row + self.top], axis=-1)

    def find(self, index: Integers) -> Integers:
        """Return the number in this set of each cell I, J (..., 2); the length of the set for cells outside."""
        line = index[..., 1] - self.top
        row = np.clip(line, 0, len(self.count) - 1)
        along = index[..., 0] - self.first[row]
        inside = (row == line) & (along >= 0) & (along < self.count[row])
        return np.where(inside, self.start[row] + along, len(self))

    def grown(self, low: Integers, high: Integers) -> CellSet:
        """Return the cells reached from this set by steps from `low` to `high`, both included."""
        first = np.full(len(self.count) + high[1] - low[1], 2**62)
        last = -first
        for step in range(high[1] - low[1] + 1):
            rows = slice(step, step + len(self.count))
            first[rows] = np.minimum(first[rows], self.first + low[0])
            last[rows] = np.maximum(last[rows], self.first + self.count + high[0])
        return CellSet(int(self.top + low[1]), first, last - first)


class BinCells:
    """A camera's bins and samples, divided into cells."""

    def __init__(self, grid: Grid, along: int, across: int):
        self.grid = grid
        # Bins along a lens and across it.
        self.fineness = along, across
        # In the lattice frame.
        self.camera = camera = grid.camera
        # A lens's type is (i - j) modulo the count of types.
        types = len(camera.mla_focal_lengths)
        steps = np.array([[types, 0], [0 if types == 1 else 1, 1]])
        # The two vectors (rows) by which cells repeat, on the MLA in millimetres, and in samples of the grid.
        self.vectors = steps.astype(np.float64) @ np.array(camera.lattice.basis)
        self.samples = steps @ grid.lens_samples
        # Samples of a cell, bins of a cell, and millimetres of a bin on the MLA, along x and y. A side of a bin is at
        # most the pitch along the rows over its fineness.
        self.size = int(self.samples[0, 0]), int(self.samples[1, 1])
        width, height = float(self.vectors[0, 0]), float(self.vectors[1, 1])
        self.bins = along * types, math.ceil(across * height / camera.row_pitch * (1 - 1e-9))
        self.bin_sizes = width / self.bins[0], height / self.bins[1]
        # Index of the sample on the axis, the first one of cell (0, 0).
        self.first_sample = np.rint(-grid.origin / grid.pitch).astype(np.int64)

    def bin_places(self, cell: Integers, points_along: float = 0.0) -> Doubles:
        """Return points on the MLA that are evenly spaced in each bin of a cell, along a lens some or one in a bin."""
        parts = [math.ceil(points_along / fine) or 1 for fine in self.fineness]
        x, y = (
            (np.arange(count * points).reshape(count, points) + 0.5) * (size / points)
            for count, size, points in zip(self.bins, self.bin_sizes, parts, strict=True)
        )
        along_y, along_x = np.broadcast_arrays(y[:, None, :, None], x[None, :, None, :])
        positions = np.stack([along_x, along_y], axis=-1).reshape(self.bins[0] * self.bins[1], -1, 2)
        return positions + cell @ self.vectors

    def middle(self, cell: Integers) -> Doubles:
        """Return the middles (..., 2) of cells on the MLA, in the camera frame."""
        x, y = np.moveaxis(cell @ self.vectors + np.diagonal(self.vectors) / 2, -1, 0)
        return np.stack(turn(x, y, self.grid.rotation), -1)

    def holding(self, box: Box) -> CellSet:
        """Return the cells that contain the samples of a box of the grid."""
        width, height = self.size
        low = np.array([box.left, box.top]) - self.first_sample
        high = low + np.array([box.columns, box.rows]) - 1
        rows = np.arange(low[1] // height, high[1] // height + 1)
        first = (low[0] - rows * self.samples[1, 0]) // width
        last = (high[0] - rows * self.samples[1, 0]) // width
        return CellSet(int(rows[0]), first, last - first + 1)

    def corners(self, cells: CellSet) -> tuple[Integers, Box]:
        """Return the first samples (x, y) of cells, counted from the corner of a box around all of their samples."""
        corners = cells.index @ self.samples + self.first_sample
        low = corners.min(0)
        return corners - low, Box.between(low, corners.max(0) + self.size)

    def windows(self, samples: Any) -> Any:
        """Return views (y, x, rows, columns) of samples: those of a cell from each sample on."""
        width, height = self.size
        rows, columns = samples.shape
        shape = rows - height + 1, columns - width + 1, height, width
        view = backend_of(samples).arrays.lib.stride_tricks.as_strided
        return view(samples, shape, samples.strides * 2)


_ALIGNED = 1e-6
"""Fraction of a bin by which places may differ that are one."""

_POINTS = (np.arange(2)[:, None] + 0.5 + np.array([-1, 1]) / math.sqrt(12)).ravel() / 2
"""Points in a unit interval whose mean integrates parabolas in both halves."""


@dataclass(frozen=True)
class UprightBins:
    """Upright square bins over lit cells: those of a reconstruction, and others around these.

    `first` is the index of the first column and row in the reconstruction. `share` (bins, bins of cells) is what a bin
    has of each bin of cells: its transpose brings radiance to cells, and the matrix itself brings responses to bins.
    """

    first: Shape
    shape: Shape
    share: csr_array

    @classmethod
    def over(
        cls, cells: BinCells, lit: CellSet, camera: PlenopticCamera, distance: float, oversample: int
    ) -> UprightBins:
        """Return the bins over lit cells.

        Along the rows of cells and across them the response to points is taken for parabolas whose means over the bins
        of cells are known. Behind a real main lens cells are positions of chief rays on the array, and its distortion
        is corrected.
        """
        pitch = camera.row_pitch / oversample
        across, down = cells.bins
        width, height = cells.bin_sizes
        middle = np.array(camera.bin_count) * oversample / 2

        def stretched(x: Any, y: Any) -> Doubles:
            """Return where chief rays from the object points that bins assign to x, y meet the array, (2, ...)."""
            if cells.grid.lens.is_uniform:
                return np.stack([x, y])
            stretch = cast(FittedLens, cells.grid.lens).image_stretch(camera, distance)
            ratio = np.interp(np.hypot(x, y), stretch.places, stretch.ratio)
            return np.stack([x * ratio, y * ratio])

        corners = (lit.index[:, None] + np.indices((2, 2)).reshape(2, 4).T) @ cells.vectors
        far = np.stack(turn(corners[..., 0], corners[..., 1], camera.mla_rotation)).reshape(2, -1)
        far *= np.hypot(*far) / np.hypot(*stretched(far[0], far[1])).clip(_ALIGNED)
        # All bins of a reconstruction are among these, also where crops light few of them.
        low = np.minimum(np.floor(far.min(1) / pitch + middle + _ALIGNED), 0).astype(np.int64)
        high = np.maximum(np.ceil(far.max(1) / pitch + middle - _ALIGNED), 2 * middle).astype(np.int64)
        parts = math.ceil(pitch / min(width, height) - _ALIGNED)
        inside = (np.arange(parts)[:, None] + _POINTS).ravel() / parts
        x, y = (
            ((np.arange(start, stop)[:, None] + inside).ravel() - half) * pitch
            for start, stop, half in zip(low, high, middle, strict=True)
        )
        columns, rows = (high - low).tolist()
        cell_column = np.repeat(np.arange(columns), inside.size)
        shares = []
        for line in np.split(y, rows):
            places = np.meshgrid(x, line)
            # Farther from the axis by a small part of the radius, for the image's area over that of the bins.
            near, beyond = (stretched(size * places[0], size * places[1]) for size in (1, 1 + 1e-4))
            radius, ratio = (np.hypot(*some) / np.hypot(*places).clip(_ALIGNED) for some in (near, beyond))
            area = radius * (ratio - radius) / 1e-4 * pitch**2 / (inside.size**2 * width * height)
            u, v = turn(near[0], near[1], -camera.mla_rotation)
            weights = []
            bins = []
            for row, along_y in _parabola(v / height - 0.5):
                J = row // down
                for column, along_x in _parabola((u - J * cells.vectors[1, 0]) / width - 0.5):
                    cell = lit.find(np.stack([column // across, J], axis=-1))
                    weights.append(np.where(cell < len(lit), area * along_y * along_x, 0))
                    bins.append((np.minimum(cell, len(lit) - 1) * down + row % down) * across + column % across)
            size = (columns, len(lit) * down * across)
            targets = np.broadcast_to(cell_column, np.shape(bins))
            matrix = csr_array((np.ravel(weights), (targets.ravel(), np.ravel(bins))), shape=size)
            matrix.data[abs(matrix.data) < 1e-6] = 0  # what rounding leaves
            matrix.eliminate_zeros()
            shares.append(matrix.astype(np.float32))
        return cls((int(low[0]), int(low[1])), (rows, columns), vstack(shares, "csr"))


def _parabola(position: Doubles) -> list[tuple[Integers, Doubles]]:
    """Return the three nearest bins of positions, in bins, with the weights of their means in the parabola there."""
    nearest = np.rint(position).astype(np.int64)
    aside = position - nearest
    bend = aside**2 - 1 / 12
    return [(nearest - 1, (bend - aside) / 2), (nearest, 1 - bend), (nearest + 1, (bend + aside) / 2)]
