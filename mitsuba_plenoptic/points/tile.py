"""Sums of point spreads' intensities, and their products with images, on the rectangles of the grid they cover."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ..optics import in_millimetres
from ..runtime import Box, Doubles, Floats, Integers, Part, Shape, active_backend, array_module, drjit_array, fft
from .field_grid import lens_amplitude
from .patch import PatchBatch, PatchWorkspace
from .patch_factors import Fields, fields_memory
from .windows import Windows, add_to_windows, products, runs


@dataclass(frozen=True)
class Copies:
    """Shifts and weights of the copies in which one point spread's intensity is added."""

    shifts: Integers  # samples along x and y by which each copy is moved, (copies, 2)
    weights: Floats  # factors on the intensity, (copies, channels)


class PatchTile:
    """The rectangle of the grid that the point spreads of one batch cover."""

    def __init__(self, batch: PatchBatch, copies: list[Copies]):
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
        weights = np.concatenate([copy.weights for copy in self._copies])
        sums = self._arrays.zeros((weights.shape[1], self.box.columns, self.box.rows), np.float32)
        for first, inside, intensity in self._intensities():
            some = self._windows.of_patches(first, first + len(intensity))
            add_to_windows(sums, intensity, self._windows.take(some, first, inside), weights[some])
        return Part(self.box, sums.transpose(0, 2, 1))

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

    def _intensities(self) -> Iterator[tuple[int, Shape, Any]]:
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
            intensity = arrays.abs(fft.fft2(field, inverse=True)) ** 2
        patch, row, column = fft.images_rows_and_columns(types, len(pupil), size, size)
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
