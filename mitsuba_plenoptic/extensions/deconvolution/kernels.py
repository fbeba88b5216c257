"""The kernels from the bins of one cell to the samples of surrounding cells, as a few dense blocks.

A bin lights a spot through each lens, at a position that differs from lens to lens. So only a few pairs of a cell and a
block of samples contain light, and the other pairs are left out. Their power is distributed to the remaining blocks by
a common factor, so that no power is lost.
"""

import itertools
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...linear import LinearMap
from ...points import Recorder
from ...runtime import (
    Box,
    Floats,
    Integers,
    Part,
    Shape,
    active_backend,
    add,
    backend_of,
    on_all_cores,
    require_memory_for,
)
from .cells import BinCells, CellSet


@dataclass
class SampleBlock:
    """The light that one block of samples in a cell receives."""

    rows: slice
    columns: slice
    # On the backend's device.
    steps: Any
    matrix: Floats


@dataclass(frozen=True, eq=False)
class Kernel:
    """The samples' response to the bins of any cell near one position."""

    steps: Integers
    blocks: list[SampleBlock]


class StoredResponse(LinearMap):
    """A response to the bins of planes, one after the other, whose kernels may lie in a temporary folder.

    The folder is removed when the context ends, or else when the response is no longer referenced.
    """

    # Rows and columns of the bins of each plane, and those of a reconstruction among them, upright.
    shapes: list[Shape]
    _windows: Sequence[tuple[slice, slice]]
    # Light of bins of radiance 1 if the pupil changes, and steps are to keep it.
    light: Floats | None = None

    def _store(self, several: bool) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="deconvolution-") if several else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._folder:
            self._folder.cleanup()

    def planes_of(self, values: NDArray) -> list[NDArray]:
        """Return the bins (rows, columns) of each plane, as views of all bins."""
        ends = np.cumsum([rows * columns for rows, columns in self.shapes])
        return [
            plane.reshape(shape) for plane, shape in zip(np.split(values.ravel(), ends[:-1]), self.shapes, strict=True)
        ]

    def to_image(self, values: Floats, plane: int) -> Floats:
        """Return a plane's bins, of all bins, as an upright image of a reconstruction's bins."""
        return np.ascontiguousarray(self.planes_of(values)[plane][self._windows[plane]])

    def from_image(self, image: NDArray, plane: int) -> Floats:
        """Return the transpose of `to_image`, applied to an image."""
        values = np.zeros(self.source_shape, np.float32)
        self.planes_of(values)[plane][self._windows[plane]] = image
        return values

    def _stored(self, arrays: list[NDArray], name: str) -> list[NDArray]:
        """Return arrays of one type as views of a file in the folder; without a folder unchanged, where they lie.

        The system keeps the file's data in memory as long as there is room.
        """
        if self._folder is None:
            return arrays
        path = Path(self._folder.name) / name
        try:
            with path.open("wb") as file:
                for array in arrays:
                    file.write(backend_of(array).to_host(array).data)
        except OSError as error:
            raise InputError(
                f"{path.parent}: the response needs room there: {error.strerror}; TMPDIR names another folder"
            ) from None
        ends = np.cumsum([array.size for array in arrays])
        values = np.memmap(path, arrays[0].dtype, "r")
        return [values[end - array.size : end].reshape(array.shape) for array, end in zip(arrays, ends, strict=True)]


def require_response_memory(memory: Callable[[int], float], oversample: int, distances: Sequence[float]) -> None:
    """Refuse a response that does not fit into memory before anything is allocated; `memory` gives its bytes."""
    planes = f"{len(distances)} planes" if len(distances) > 1 else f"the plane at {distances[0]:g}"
    label = f"oversample = {oversample}: deconvolution of {planes}"
    require_memory_for(memory, oversample, label, "oversample = {}".format, computed=True)


def make_kernel(cells: BinCells, cell: Integers, spreads: Iterable[list[Part]], together: int = 1) -> Kernel:
    """Return the kernel of a cell's bins from point spreads; `together` x `together` samples are merged into one."""
    arrays = active_backend().arrays
    entries = []
    for spread_index, parts in enumerate(spreads):
        for patch in parts:
            box, sums = merged(patch.box, arrays.asarray(patch.sums)[0], together)
            reached = cells.holding(box)
            corners, around = cells.corners(reached)
            whole = arrays.zeros((1, around.rows, around.columns), np.float32)
            add(Part(box, sums[None]), around, whole)
            x, y = arrays.asarray(corners.T)
            entries.append((spread_index, reached.index - cell, cells.windows(whole[0])[y, x]))
    indices = np.concatenate([index for _, index, _ in entries])
    low = indices.min(0)
    size = indices.max(0) - low + 1
    dense = arrays.zeros((int(size.prod()), spread_index + 1, *entries[0][2].shape[1:]), np.float32)
    for spread_index, index, values in entries:
        dense[arrays.asarray((index - low) @ [1, size[0]]), spread_index] += values
    steps = np.stack(np.meshgrid(*map(np.arange, size)), axis=-1).reshape(-1, 2) + low
    return sparse_kernel(steps, dense)


def merged(box: Box, samples: Floats, together: int) -> tuple[Box, Floats]:
    """Return means over `together` x `together` samples, and the box of these means on their grid."""
    if together == 1:
        return box, samples
    sides = (box.top, box.rows), (box.left, box.columns)
    ends = [(low % together, -(low + length) % together) for low, length in sides]
    padded = backend_of(samples).arrays.pad(samples, ends)
    # Plane by plane, which takes a fraction of the time of a sum along two short axes.
    means: Any = sum(padded[row::together, column::together] for row, column in np.ndindex(together, together))
    rows, columns = means.shape
    return Box(box.left // together, box.top // together, columns, rows), means / np.float32(together**2)


def sparse_kernel(steps: Integers, dense: Floats) -> Kernel:
    """Return the kernel of a response (steps, bins, rows, columns), without nearly dark blocks."""
    libraries = backend_of(dense)
    libraries.arrays.maximum(dense, 0, out=dense)  # negative values between samples are errors of interpolation
    # Blocks of about 8 samples along an axis.
    edges = [np.linspace(0, length, max(1, round(length / 8)) + 1).round().astype(int) for length in dense.shape[2:]]
    parts = list(itertools.product(*(itertools.starmap(slice, itertools.pairwise(edge)) for edge in edges)))
    sums = [dense[:, :, rows, columns].sum(axis=(1, 2, 3), dtype=np.float64) for rows, columns in parts]
    power = libraries.to_host(libraries.arrays.stack(sums))
    order = np.sort(power, axis=None)
    upto = np.cumsum(order)
    dark = int(np.searchsorted(upto, 2e-3 * upto[-1]))  # so much of the power is left out
    scale = np.float32(upto[-1] / (upto[-1] - upto[dark] + order[dark]))
    blocks = []
    bright = power >= order[dark]
    retained = bright.any(axis=0)
    column_of = np.cumsum(retained) - 1
    for (rows, columns), some in zip(parts, bright, strict=True):
        which = np.flatnonzero(some)
        if len(which):
            lit = dense[libraries.arrays.asarray(which), :, rows, columns]
            matrix = lit.swapaxes(0, 1).reshape(len(which) * dense.shape[1], -1) * scale
            blocks.append(SampleBlock(rows, columns, libraries.arrays.asarray(column_of[which]), matrix))
    return Kernel(steps[retained], blocks)


def zones(cells: CellSet, width: int) -> list[Integers]:
    """Return cells divided into zones `width` rows high and equally many cells wide."""
    row = cells.index[:, 1] - cells.top
    column = cells.index[:, 0] - cells.first[row]
    longest, rows = int(cells.count.max()), len(cells.count)
    along, down = -(-longest // width), -(-rows // width)
    # as even as they can be
    zone = row * down // rows * along + np.minimum(column * along // longest, along - 1)
    return [np.flatnonzero(zone == zone_index) for zone_index in np.unique(zone)]


@dataclass(frozen=True)
class _Placed:
    """A zone on the backend's device: its blocks, rows and columns of its cells' corners, and cells that light them.

    `window` has the pixels that its recorder makes of `shape` samples, or these samples themselves.
    """

    blocks: list[SampleBlock]
    corners: Any
    sources: Any
    shape: Shape
    window: tuple[slice, ...]
    recorder: Recorder | None


class PlaneResponse:
    """The light that pixels, or the samples of all cells, receive from the bins of an object plane."""

    def __init__(
        self,
        cells: BinCells,
        sampled: CellSet,
        zones: Sequence[Integers],
        kernels: Sequence[Kernel],
        recorder: Recorder,
    ):
        self._windows = cells.windows
        steps = np.concatenate([kernel.steps for kernel in kernels])
        self.lit = sampled.grown(-steps.max(0), -steps.min(0))
        # Number of cells, and of bins in each.
        self.shape = len(self.lit), cells.bins[0] * cells.bins[1]
        asarray = active_backend().arrays.asarray
        corners, _ = cells.corners(sampled)
        self._zones = []
        for members, kernel in zip(zones, kernels, strict=True):
            low = corners[members].min(0)
            high = corners[members].max(0) + cells.size
            part = None if recorder.by_samples else recorder.within(low, high)
            columns, rows = map(slice, low, high)
            self._zones.append(
                _Placed(
                    kernel.blocks,
                    asarray((corners[members] - low).T[::-1]),
                    asarray(self.lit.find(sampled.index[members] - kernel.steps[:, None]).astype(np.int32)),
                    tuple((high - low)[::-1]),
                    part.window if part else (rows, columns),
                    part,
                )
            )

    def add_forward(self, values: Floats, image: Any) -> None:
        """Add the light of bins to pixels or samples."""
        arrays = active_backend().arrays
        padded = arrays.asarray(np.pad(values.T, ((0, 0), (0, 1))))

        def work(zone: _Placed) -> Any:
            around = padded.take(zone.sources, 1)
            samples = arrays.zeros(zone.shape, np.float32)
            windows = self._windows(samples)
            for block in zone.blocks:
                light = around.take(block.steps, 1).reshape(len(block.matrix), -1).T @ arrays.asarray(block.matrix)
                part = light.reshape(len(light), block.rows.stop - block.rows.start, -1)
                windows[*zone.corners, block.rows, block.columns] = part
            return zone.recorder.integrate(samples) if zone.recorder else samples

        for zone, part in zip(self._zones, on_all_cores(work, self._zones), strict=True):
            image[zone.window] += part

    def adjoint(self, image: Any) -> Floats:
        """Return, for each bin, pixels or samples weighted by the bin's light."""
        arrays = active_backend().arrays
        cells, bins = self.shape

        def work(zone: _Placed) -> Any:
            samples = zone.recorder.spread(image[..., None])[0] if zone.recorder else image[zone.window]
            windows = self._windows(samples)
            around = arrays.zeros((bins, *zone.sources.shape), np.float32)
            for block in zone.blocks:
                lit = windows[*zone.corners, block.rows, block.columns].reshape(around.shape[2], -1)
                around[:, block.steps] += (arrays.asarray(block.matrix) @ lit.T).reshape(bins, len(block.steps), -1)
            return around

        result = arrays.zeros((bins, cells + 1), np.float32)
        for zone, around in zip(self._zones, on_all_cores(work, self._zones), strict=True):
            for total, weighed in zip(result, around, strict=True):
                total += arrays.bincount(zone.sources.ravel(), weighed.ravel(), cells + 1)
        return active_backend().to_host(result)[:, :-1].T
