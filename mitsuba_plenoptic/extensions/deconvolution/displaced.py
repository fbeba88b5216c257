"""Samples of light behind a regular array, moved to where displaced lenses send them.

A displaced lens moves its micro-image, whose light is otherwise that of the lens at its regular position, among
neighbours at regular distances. Bins are displaced like the lens before them, so that only the differences between
displacements of neighbours, within a point's blur, are neglected.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ...camera import PlenopticCamera
from ...lattice import turn
from ...points.field_grid import Grid
from ...runtime.batches import Box
from ...runtime.limits import require_memory

_BYTES = 100.0
"""Bytes for each sample while the matrix is made."""


def regular_camera(camera: PlenopticCamera) -> PlenopticCamera:
    """Return a camera with the same array without displacements, whose lenses are equal."""
    if camera.lattice.displacement is None:
        return camera
    return camera.replace(mla_warp=(), mla_cra=(), mla_jitter=(0.0, 0.0))


@dataclass(frozen=True)
class MovedSamples:
    """Linear map from the samples of a regular array's light, in the box `source`, to samples behind the camera's."""

    source: Box
    target: Box
    matrix: csr_array | None  # None: nothing is moved

    @classmethod
    def of(cls, camera: PlenopticCamera, grid: Grid, target: Box) -> MovedSamples:
        """Return the map to the samples of a box of the grid, with all samples that are moved into the box."""
        if (moved := camera.lattice.displacement) is None:
            return cls(target, target, None)
        farthest = (camera.most_displaced[0] + moved.farthest_irregular) * camera.image_growth
        more = np.ceil(farthest / grid.pitch).astype(int) + 1
        source = Box(
            target.left - int(more[0]), target.top - int(more[1]),
            target.columns + 2 * int(more[0]), target.rows + 2 * int(more[1]),
        )  # fmt: skip
        shape = source.rows * source.columns, target.rows * target.columns
        require_memory(_BYTES * shape[0], f"displaced lenses of {shape[0]} samples")
        column, row = np.meshgrid(np.arange(source.columns) + source.left, np.arange(source.rows) + source.top)
        across, down = _shifts(camera, grid, column.ravel(), row.ravel())
        x, y = column.ravel() + across - target.left, row.ravel() + down - target.top
        left, top = np.floor(x), np.floor(y)
        weights, into, out = [], [], []
        for right, below in np.ndindex(2, 2):
            share = abs(1 - right - (x - left)) * abs(1 - below - (y - top))
            i, j = (left + right).astype(np.int64), (top + below).astype(np.int64)
            inside = np.flatnonzero((i >= 0) & (i < target.columns) & (j >= 0) & (j < target.rows) & (share > 0))
            weights.append(share[inside].astype(np.float32))
            into.append((j * target.columns + i)[inside])
            out.append(inside)
        entries = np.concatenate(weights), (np.concatenate(into), np.concatenate(out))
        return cls(source, target, csr_array(entries, shape=shape[::-1]))

    def forward(self, samples: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the samples (rows, columns) of the target box."""
        if self.matrix is None:
            return samples
        return np.asarray(self.matrix @ samples.ravel(), np.float32).reshape(self.target.rows, self.target.columns)

    def adjoint(self, samples: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the transpose of `forward`, applied to samples of the target box."""
        if self.matrix is None:
            return samples
        return np.asarray(self.matrix.T @ samples.ravel(), np.float32).reshape(self.source.rows, self.source.columns)


def _shifts(
    camera: PlenopticCamera, grid: Grid, column: NDArray[np.int64], row: NDArray[np.int64]
) -> list[NDArray[np.float64]]:
    """Return the displacements along x and y, in samples, of the micro-images to which samples belong."""
    u, v = (index * step + start for index, step, start in zip((column, row), grid.pitch, grid.origin, strict=True))
    x, y = turn(u / camera.image_growth, v / camera.image_growth, grid.rotation)
    index = camera.lattice.regular.cell(x, y)
    moved = [
        camera.image_growth * (now - before)
        for now, before in zip(camera.lattice.centre(*index), camera.lattice.regular.centre(*index), strict=True)
    ]
    return [shift / step for shift, step in zip(turn(moved[0], moved[1], -grid.rotation), grid.pitch, strict=True)]
