"""Sums of many copies of patterns, each shifted by whole lenses, as products with a sparse matrix.

If all copies are shifted by multiples of some width, patterns and their sum are divided into cells of that width. Each
copy then adds whole cells, with equal weights for all samples of a cell. The sum is the product of a sparse matrix,
with one row per cell of the sum, with the cells of the patterns.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
import scipy

from ..optics import in_millimetres
from ..runtime import Box, Doubles, Floats, Integers, Part, active_backend, array_module, drjit_array, fft
from .field_grid import lens_amplitude
from .patch import PatchBatch, PatchWorkspace
from .patch_factors import Fields, fields_memory
from .windows import Windows, add_to_windows, index_of, products, runs

_TOGETHER = 2**20
"""Samples of the patterns that are multiplied together, which fit into a core's caches."""


@dataclass(frozen=True)
class CopyCells:
    """Patterns of one size, and their sum, divided into cells."""

    width: Integers  # samples of a cell along x and y, (2,)
    count: Integers  # largest number of cells that a pattern overlaps, (2,)

    @classmethod
    def of(cls, windows: Windows, samples: int) -> CopyCells | None:
        """Return cells for copies of patterns of `samples` x `samples` in windows; None if cells are slower."""
        offsets = windows.start - windows.start[np.searchsorted(windows.patch, windows.patch)]
        width = np.gcd.reduce(offsets, axis=0)
        # Along an axis without motion, one cell contains the pattern.
        width = np.where(width > 0, width, samples).astype(np.int64)
        count = (samples + 2 * width - 2) // width
        # 3: Mean number of copies of a pattern above which cells are faster.
        # 64: Samples of a cell below which the matrix would be as large as the patterns.
        pays = len(offsets) >= 3 * (windows.patch[-1] + 1) and width.prod() >= 64
        # 4: Largest ratio of the samples of a pattern's cells to its own; smaller patterns are added one by one.
        return cls(width, count) if pays and (count * width).prod() <= 4 * samples**2 else None

    def cut(self, planes: Any) -> Any:
        """Return planes (n, x, y) of whole cells as (cells of all planes, samples)."""
        shape = np.array(planes.shape[1:]) // self.width
        cut = planes.reshape(len(planes), shape[0], self.width[0], shape[1], self.width[1])
        return cut.transpose(0, 1, 3, 2, 4).reshape(-1, int(self.width.prod()))

    def join(self, cells: Any, planes: int, shape: Integers) -> Any:
        """Return planes of `shape` cells each, the inverse of `cut`."""
        cells = cells.reshape(planes, *shape.tolist(), *self.width.tolist()).transpose(0, 1, 3, 2, 4)
        return cells.reshape(planes, *(shape * self.width).tolist())


class CellSum:
    """A sum of copies of patterns, which are buffered and added several at a time."""

    def __init__(self, cells: CopyCells, size: Integers, channels: int, patterns: int) -> None:
        self._cells = cells
        self._size = size
        self._channels = channels
        self._shape = size // cells.width + 1 + cells.count
        self._arrays = active_backend().arrays
        self._sums = self._arrays.zeros((channels * int(self._shape.prod()), int(cells.width.prod())), np.float32)
        planes = max(patterns, _TOGETHER // int((cells.count * cells.width).prod()))
        self.planes = self._arrays.zeros((planes, *(cells.count * cells.width).tolist()), np.float32)
        self._held: dict[int, int] = {}
        self._entries: list[tuple[Integers, Integers, Floats]] = []

    def hold(self, pattern: int, positions: Integers, weights: Floats) -> tuple[int, int, int]:
        """Return the buffer for a pattern's intensity, by its index in `planes`, and its first samples along x and y.

        `positions` are the first samples of each copy along x and y. When another part of the pattern is written, its
        index identifies it.
        """
        if pattern not in self._held:
            self._held[pattern] = entry = len(self._held)
            # The copies of the plane in the matrix.
            inner = np.indices(self._cells.count.tolist()).reshape(2, -1)
            x, y = (positions // self._cells.width).T[..., None] + inner[:, None]
            copy, channel = np.nonzero(weights)
            # The channels of a cell are adjacent, so that the cell they are added from stays in the processor's cache.
            rows = (x[copy] * self._shape[1] + y[copy]) * self._channels + channel[:, None]
            columns = np.broadcast_to(entry * inner.shape[1] + np.arange(inner.shape[1]), rows.shape)
            values = np.broadcast_to(weights[copy, channel][:, None], rows.shape)
            self._entries.append((rows.ravel(), columns.ravel(), values.ravel()))
        x, y = (positions[0] % self._cells.width).tolist()
        return self._held[pattern], x, y

    @property
    def free(self) -> int:
        """Number of patterns that can be buffered before the next `add`."""
        return len(self.planes) - len(self._held)

    def add(self) -> None:
        """Add the patterns in the buffer to the sum."""
        if not self._held:
            return
        rows, columns, values = (np.concatenate(entries) for entries in zip(*self._entries, strict=True))
        count = len(self._held)
        shape = len(self._sums), count * int(self._cells.count.prod())
        matrix: Any = active_backend().sparse.csr_matrix(scipy.sparse.csr_array((values, (rows, columns)), shape=shape))
        self._sums += matrix @ self._cells.cut(self.planes[:count])
        self.planes[:count] = 0
        self._held = {}
        self._entries = []

    def total(self) -> Any:
        """Return the sum, (channels, samples along x, along y)."""
        self.add()
        x, y = self._size.tolist()
        sums = self._sums.reshape(*self._shape.tolist(), self._channels, *self._cells.width.tolist())
        return self._cells.join(sums.transpose(2, 0, 1, 3, 4), self._channels, self._shape)[:, :x, :y]


@dataclass(frozen=True)
class Copies:
    """Shifts and weights of the copies in which one point spread's intensity is added."""

    shifts: Integers  # samples along x and y by which each copy is moved, (copies, 2)
    weights: Floats  # factors on the intensity, (copies, channels)


class CopySum:
    """Weighted sum of copies of patterns of one size, by cells where this is faster, otherwise copy by copy.

    `windows` are those of the copies in the sum, of size `size`, and `weights` (copies, channels) theirs. Parts of
    `together` patterns may be added alternately.
    """

    def __init__(self, windows: Windows, weights: Floats, samples: int, size: Integers, together: int) -> None:
        self._windows = windows
        self._weights = weights
        self._together = together
        self._last = 0
        channels = weights.shape[1]
        cells = CopyCells.of(windows, samples)
        self._cells = None if cells is None else CellSum(cells, size, channels, together)
        self._sums: Any = None if self._cells else active_backend().arrays.zeros((channels, *size.tolist()), np.float32)

    def add(self, first: int, inside: tuple[int, int], intensity: Any) -> None:
        """Add the copies of parts of patterns, from index `first` on, that begin `inside` the patterns."""
        stop = first + len(intensity)
        if self._cells is None:
            some = self._windows.of_patches(first, stop)
            add_to_windows(self._sums, intensity, self._windows.take(some, first, inside), self._weights[some])
            return
        cells = self._cells
        if first // self._together != self._last and cells.free < self._together:
            cells.add()
        self._last = first // self._together
        copies = [self._windows.of_patches(pattern, pattern + 1) for pattern in range(first, stop)]
        entries = np.array(
            [
                cells.hold(pattern, self._windows.start[some], self._weights[some])
                for pattern, some in enumerate(copies, first)
            ]
        )
        cells.planes[index_of(cells.planes, entries[:, 0], entries[:, 1:] + np.array(inside), intensity.shape[1:])] = (
            intensity
        )

    def total(self) -> Any:
        """Return the sum, (channels, ...)."""
        return self._sums if self._cells is None else self._cells.total()


class PatchTile:
    """The rectangle of the grid that the point spreads of one batch cover."""

    def __init__(self, batch: PatchBatch, copies: list[Copies]) -> None:
        self._batch = batch
        self._copies = copies
        self.box = reached(batch.corner, batch.samples, copies)
        low = np.array([self.box.left, self.box.top])
        self._windows = Windows.of(
            [corner + copy.shifts - low for corner, copy in zip(batch.corner, copies, strict=True)]
        )
        self._arrays = active_backend().arrays
        # The intensities of several points would not fit into a core's cache together.
        together = batch.together if batch.libraries.is_cuda else 1
        self._block = min(batch.sizes.block, together * batch.samples**2)
        self._scratch = self._arrays.empty(self._block, np.float32)
        self._squares = self._arrays.empty(2 * self._block, np.float32)

    def sum(self) -> Part:
        """Return the sum of the weighted intensities of all copies."""
        size = np.array([self.box.columns, self.box.rows])
        weights = np.concatenate([copy.weights for copy in self._copies])
        sums = CopySum(self._windows, weights, self._batch.samples, size, self._batch.together)
        for first, inside, intensity in self._intensities():
            sums.add(first, inside, intensity)
        return Part(self.box, sums.total().transpose(0, 2, 1))

    def products(self, samples: Floats) -> list[Doubles]:
        """Return the products, (copies, channels), of each copy's intensity with the samples of the tile, summed."""
        turned = self._arrays.ascontiguousarray(self._arrays.asarray(samples).transpose(0, 2, 1))
        sums = self._arrays.zeros((len(self._windows.patch), len(turned)))
        for first, inside, intensity in self._intensities():
            some = self._windows.of_patches(first, first + len(intensity))
            sums[some] += products(turned, intensity, self._windows.take(some, first, inside))
        ends = np.cumsum([len(copy.shifts) for copy in self._copies])
        return np.split(self._batch.libraries.to_host(sums), ends[:-1])

    def powers(self) -> Doubles:
        """Return the sum of the samples of each point's intensity, (points,)."""
        sums = self._arrays.zeros(len(self._copies), np.float64)
        for first, _, intensity in self._intensities():
            sums[first : first + len(intensity)] += intensity.sum(2).sum(1, dtype=np.float64)
        return self._batch.libraries.to_host(sums)

    def _intensities(self) -> Iterator[tuple[int, tuple[int, int], Any]]:
        """Yield the first point, the first samples along x and y, and the intensity, of parts (points, along x, y)."""
        batch = self._batch
        arrays = self._arrays
        work = PatchWorkspace(batch)
        for first in range(0, len(self._copies), batch.together):
            stop = min(len(self._copies), first + batch.together)
            for along_y, fields in batch.to_detector(first, stop, work):
                count, length, width = fields.shape
                rows = max(1, min(length, self._block // width))
                for points, along_x in itertools.product(
                    runs(count, max(1, self._block // (rows * width))), runs(length, rows)
                ):
                    field = fields[points, along_x]
                    intensity = self._scratch[: field.size].reshape(field.shape)
                    squares = self._squares[: 2 * field.size].reshape(*field.shape[:2], -1)
                    arrays.copyto(squares.view(np.complex64), field)
                    arrays.multiply(squares, squares, out=squares)
                    arrays.add(squares[..., ::2], squares[..., 1::2], out=intensity)
                    yield first + points.start, (along_x.start, along_y.start), intensity


def reached(corner: Integers, samples: int, copies: Sequence[Copies], finer: int = 1) -> Box:
    """Return the box that patches and their copies cover, on a grid `finer` than the patches by a factor."""
    corners = np.concatenate([position + copy.shifts for position, copy in zip(corner, copies, strict=True)])
    return Box.between(finer * corners.min(0), finer * (corners.max(0) + samples))


@dataclass(frozen=True)
class FieldBatch:
    """Fields of points that are computed together, with the interface of `runtime.batches.Batch`."""

    fields: Fields

    @property
    def samples(self) -> int:
        """Total number of samples of all patches."""
        return self.fields.samples

    @property
    def memory(self) -> float:
        """Approximate bytes while the fields are computed."""
        return fields_memory(float(self.fields.placement.samples.max()))


@dataclass(frozen=True)
class Scatter(FieldBatch):
    """Point spreads to be added, with factors on each field and on the copies."""

    amplitudes: Doubles
    copies: list[Copies]

    def prepare(self) -> Callable[[], Part]:
        """Return the function that adds the intensities, after the factors of the fields are computed."""
        batch = PatchBatch(self.fields, self.amplitudes)
        return lambda: PatchTile(batch, self.copies).sum()


@dataclass(frozen=True)
class Gather(FieldBatch):
    """Point spreads to be multiplied by the samples of the tile that they cover."""

    copies: list[Copies]
    tile: Floats

    def prepare(self) -> Callable[[], list[Doubles]]:
        """Return the function that multiplies intensities by the tile, after the factors of the fields are computed."""
        batch = PatchBatch(self.fields, np.ones(len(self.copies)))
        return lambda: PatchTile(batch, self.copies).products(self.tile)


def arrived_power(fields: Fields) -> Doubles:
    """Return the sum (n,) of the samples of the intensity of each point, of unit power."""
    everything = Copies(np.zeros((1, 2), np.int64), np.ones((1, 1), np.float32))
    count = len(fields.positions)
    with fft.resting_drjit():
        return PatchTile(PatchBatch(fields, np.ones(count)), [everything] * count).powers()


def aperture_power(fields: Fields) -> Doubles:
    """Return the fraction (n,) of each point's power on the microlens array that the apertures of lenses pass.

    The intensity before the array is band-limited, so that its integral over apertures of any shape is exact.
    """
    batch = PatchBatch(fields, np.ones(len(fields.positions)))
    grid = fields.grid
    arrays = batch.libraries.arrays
    types = array_module()
    size = batch.mla_samples
    directions = batch.pupil.shape[1]
    pitch = batch.samples * grid.pitch / size
    cosine = in_millimetres(grid.wavelength) / (2 * float(pitch.min()))
    result = np.empty(len(batch.pupil))
    for points in runs(len(result), batch.together):
        pupil = batch.pupil[points]
        field = arrays.zeros((len(pupil), size, size), np.complex64)
        field[:, :directions, :directions] = pupil
        with fft.resting_drjit():
            intensity: Any = arrays.abs(fft.fft2(field, inverse=True)) ** 2
        patch, row, column = fft.split(types, dr.arange(types.UInt32, len(pupil) * size**2), size, size)
        x, y = (
            dr.gather(types.Float64, drjit_array(types.Float64, start), patch)
            + types.Float64(index) * dr.opaque(types.Float64, float(step))
            for start, index, step in zip(
                (grid.origin + batch.corner[points] * grid.pitch).T, (column, row), pitch, strict=True
            )
        )
        power = types.Float64(lens_amplitude(grid.camera, x, y, pitch) ** 2)
        if not grid.microlenses.fills:
            power = grid.microlenses.open_fraction(cosine, x, y) * power
        power = power + dr.zeros(types.Float64, dr.width(patch))
        passed = intensity * batch.libraries.from_drjit(power).reshape(intensity.shape)
        fraction = passed.sum((1, 2), dtype=np.float64) / intensity.sum((1, 2), dtype=np.float64)
        result[points] = batch.libraries.to_host(fraction)
    return result
