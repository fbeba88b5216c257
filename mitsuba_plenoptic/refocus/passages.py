"""Thin elements and free space: one step of a field from one plane's samples to the next plane's, and the vjp.

Fields are passed from step to step in blocks of rows, from the first row to the last. A step transforms incoming rows,
transposes them into columns, does all work along columns, transposes back and passes on the rows of the next plane.
Only the columns are stored whole; the next step writes its columns where it has read the last step's. Fourier
transforms are done on blocks that stay in the processor's cache; dark rows, and frequencies and destination samples
that are not needed, are left out.

The vjp of a step is the reversed step: free space of the opposite length between the same samples, then the conjugate
of the element, divided by the ratio of the samples' areas.

At the end the power of a field over directions is summed over bins. Bins are uniform in the slope X / g, and so are the
directions of paraxial light. The directions of other light are uniform in the cosine X / |X|. For a fixed cosine along
y, the edges of bins along x are known cosines; so the power is integrated along x for every sample in y as the samples
arrive, and then along y for every column of bins, with the edges at the column's middle. Between the samples the power
is interpolated cubically (Keys, "Cubic convolution interpolation for digital image processing", 1981); the integral is
the sum of the samples between two edges and a few near each.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..fields.optical_system import is_paraxial
from ..optics.waves import advance, in_millimetres, parabola, phasor
from ..runtime import active_backend, drjit_array, fft
from .planning import AxisStep, Directions, LensAxis, Step

Rows = Iterable[tuple[slice, fft.Field]]
"""Blocks of rows of a field, from the first on, with their numbers. What is left out is dark.

A block holds until the next one is asked for.
"""

# Rows that are transformed together: in the processor's cache, or enough to keep a CUDA device busy.
_BLOCK, _CUDA_BLOCK = 64, 4096

# Columns that are turned into rows together: more of them would not stay in the first cache.
_TILE = 512

# Columns whose distance is a multiple of the page size would map to the same few cache lines during transposition.
_PAGE, _STAGGER = 512, 24


class ThinElement:
    """Thin element in the source plane of a step, a function of Dr.Jit's x and y; None changes nothing.

    A product of a function of x and one of y is determined by its values along two lines through a point where its
    modulus is 1. With such a point, rows of zeros are left out.
    """

    def __init__(
        self,
        step: Step,
        function: Callable[[Any, Any], Any] | None = None,
        point: tuple[float, float] | None = None,
    ) -> None:
        self._step, self._function = step, function
        self.along_x: fft.Field | None = None
        self.along_y: fft.Field | None = None
        self._lit = np.ones(step.y.count, bool)
        if function is not None and point is not None:
            x, y = point
            line = _evaluate(np.append(step.x.source, x), np.array([y]), function)[0]
            self._function, self.along_x = None, line[:-1]
            self.along_y = _evaluate(np.array([x]), step.y.source, function)[:, 0] * line[-1].conj()
            self._lit = active_backend().to_host(self.along_y) != 0

    def lit(self, rows: slice) -> list[slice]:
        """Return runs of the rows in which the element transmits light."""
        runs = np.flatnonzero(np.diff(self._lit[rows], prepend=False, append=False)).reshape(-1, 2)
        return [slice(rows.start + first, rows.start + end) for first, end in runs.tolist()]

    def through(self, rows: slice, samples: fft.Field, out: fft.Field) -> None:
        """Write rows of a field, multiplied by all factors but the one along y, to `out`."""
        factor = self._factor(rows)
        if factor is None:
            out[...] = samples
        else:
            active_backend().arrays.multiply(samples, factor, out=out)

    def back(self, rows: slice, samples: fft.Field, scale: float) -> fft.Field:
        """Return rows of a field, multiplied by the conjugates of all factors and by a scale."""
        for factor in (self._factor(rows), None if self.along_y is None else self.along_y[rows, None]):
            samples = samples if factor is None else samples * factor.conj()
        return samples * np.float32(scale)

    def _factor(self, rows: slice) -> fft.Field | None:
        if self._function is None:
            return self.along_x
        return _evaluate(self._step.x.source, self._step.y.source[rows], self._function)


def _evaluate(x: np.ndarray, y: np.ndarray, function: Callable[[Any, Any], Any]) -> fft.Field:
    """Return a function of two Dr.Jit arrays at all pairs of coordinates."""
    types = active_backend().types
    _, row, column = fft.split(types, dr.arange(types.UInt32, len(x) * len(y)), len(y), len(x))
    at = [
        dr.gather(types.Float64, drjit_array(types.Float64, values), index) for values, index in ((x, column), (y, row))
    ]
    return fft.as_field(fft.pack(function(*at)), (len(y), len(x)))


class FieldWorkspace:
    """Memory shared by steps, since fresh memory pages would cost nearly as much as the transforms.

    `report` is called with the number of samples that Fourier transforms have processed.
    """

    def __init__(self, steps: Iterable[Step], report: Callable[[int], None] = lambda transformed: None) -> None:
        self.libraries = active_backend()
        self.block = _CUDA_BLOCK if self.libraries.is_cuda else _BLOCK
        self._transformed, self._report = 0, report
        columns, rows = (max(sizes) for sizes in zip(*(step.columns for step in steps), strict=True))
        self._columns = self.libraries.arrays.empty((columns, rows + -rows % _PAGE + _STAGGER), np.complex64)
        self._buffers: dict[str, fft.Field] = {}

    def columns(self, step: Step) -> fft.Field:
        """Return the memory of a step's columns, shared with the last step's columns."""
        return self._columns[: step.x.held]

    def array(self, name: str, shape: tuple[int, int]) -> fft.Field:
        """Return an uninitialised array, valid until the same name is requested again."""
        size = shape[0] * shape[1]
        if name not in self._buffers or self._buffers[name].size < size:
            self._buffers[name] = self.libraries.arrays.empty(size, np.complex64)
        return self._buffers[name][:size].reshape(shape)

    def runs(self, count: int, block: int | None = None) -> Iterator[slice]:
        """Yield slices of rows that are processed together."""
        block = block or self.block
        for first in range(0, count, block):
            yield slice(first, min(first + block, count))

    def blocks(self, field: fft.Field) -> Rows:
        """Yield all rows of a field in blocks, which are views of the field."""
        for rows in self.runs(len(field)):
            yield rows, field[rows]

    def fft(self, field: fft.Field, *, inverse: bool = False) -> fft.Field:
        """Transform rows in place; forward transforms are divided by the length, inverse ones are not."""
        found = fft.fft(field, axis=1, inverse=inverse, norm="forward")
        self._transformed += field.size
        self._report(self._transformed)
        return found


@dataclass(frozen=True)
class FreeSpace:
    """Free space of a length in mm, for a wavelength in nm in it, with propagation by slopes or by cosines.

    With `beyond_paraxial`, only the non-paraxial part.
    """

    distance: float
    wavelength: float
    paraxial: bool
    beyond_paraxial: bool = False

    @property
    def back(self) -> FreeSpace:
        """Free space from the second plane back to the first."""
        return FreeSpace(-self.distance, self.wavelength, self.paraxial, self.beyond_paraxial)


def propagate(source: Rows, element: ThinElement, step: Step, space: FreeSpace, workspace: FieldWorkspace) -> Rows:
    """Yield a field at the destination samples of a step, without its carrier, from the field at source samples.

    The field passes the element first, then free space. Rows may come from another step with the same workspace.
    """
    x, y, columns = step.x, step.y, workspace.columns(step)
    pitches, shift = (x.window / x.held, y.window / y.held), (x.start - x.first, y.start - y.first)
    for mine, spectrum in to_directions(source, element, step, workspace):
        part = advance(
            spectrum, pitches, space.distance, space.wavelength, shift=shift, part=(mine.start, x.held),
            paraxial=space.paraxial, beyond_paraxial=space.beyond_paraxial,
        )  # fmt: skip
        columns[mine, : y.wanted] = _from_lowest(part, y, workspace)
    yield from _to_rows(columns, step, workspace)


def propagate_vjp(
    gradient: Rows, element: ThinElement, step: Step, space: FreeSpace, workspace: FieldWorkspace
) -> Rows:
    """Yield the gradient at the source samples of `propagate`, from the gradient at the destination samples."""
    back = step.reversed
    scale = step.x.new_padded * step.y.new_padded / (step.x.padded * step.y.padded)
    for rows, samples in propagate(gradient, ThinElement(back), back, space.back, workspace):
        yield rows, element.back(rows, samples, scale)


def to_directions(
    source: Rows, element: ThinElement, step: Step, workspace: FieldWorkspace
) -> Iterator[tuple[slice, fft.Field]]:
    """Yield the lowest frequencies of a field behind an element, as contiguous blocks (some along x, all along y).

    Zero frequency comes first on both axes, negative frequencies last. Transforms are divided by their lengths.
    """
    x, y, columns, arrays = step.x, step.y, workspace.columns(step), workspace.libraries.arrays
    rows_of = workspace.array("rows", (workspace.block, x.padded))
    low, high = _lowest(x.padded, x.held)
    end = 0
    for rows, samples in source:
        for lit in element.lit(rows):
            columns[:, end : lit.start] = 0
            end = lit.stop
            part = rows_of[: end - lit.start]
            element.through(lit, samples[lit.start - rows.start : end - rows.start], part[:, : x.count])
            part[:, x.count :] = 0
            part = workspace.fft(part)
            columns[: low.stop, lit] = part[:, low].T
            columns[low.stop :, lit] = part[:, high].T
    columns[:, end : y.count] = 0
    block = workspace.array("rows", (workspace.block, y.padded))
    spectrum = workspace.array("spectrum", (workspace.block, y.held))
    low, high = _lowest(y.padded, y.held)
    for mine in workspace.runs(x.held):
        part = block[: mine.stop - mine.start]
        if element.along_y is None:
            part[:, : y.count] = columns[mine, : y.count]
        else:
            arrays.multiply(columns[mine, : y.count], element.along_y, out=part[:, : y.count])
        part[:, y.count :] = 0
        part = workspace.fft(part)
        if y.held < y.padded:
            cut = spectrum[: mine.stop - mine.start]
            cut[:, : low.stop], cut[:, low.stop :] = part[:, low], part[:, high]
            part = cut
        yield mine, part


def to_directions_vjp(gradient: Rows, element: ThinElement, step: Step, workspace: FieldWorkspace) -> Rows:
    """Yield the gradient at the source samples of `to_directions`, from the gradient at the frequencies."""
    back = step.reversed
    columns = workspace.columns(back)
    for mine, part in gradient:
        columns[mine, : back.y.wanted] = _from_lowest(part, back.y, workspace)
    for rows, samples in _to_rows(columns, back, workspace):
        yield rows, element.back(rows, samples, 1 / (step.x.padded * step.y.padded))


class ParaxialPath:
    """Free space between two planes as one transform, with the second plane's samples in order.

    The field on the second plane is kept line by line: along its y for each x.
    """

    def __init__(self, step: Directions, onto: tuple[LensAxis, LensAxis], distance: float, wavelength: float) -> None:
        self._step, wave_path = step, in_millimetres(wavelength) * distance

        def curved(x: Any, y: Any) -> Any:
            return phasor(parabola(x * x + y * y, -distance, wavelength))

        self._element = ThinElement(step, curved, (0.0, 0.0))
        asarray = active_backend().arrays.asarray
        self._along_x, self._along_y = (
            asarray(phasor(samples.samples * (samples.samples / 2 - axis.first) / wave_path))
            * np.float32(math.sqrt(wave_path) / samples.pitch)
            for axis, samples in ((step.x, onto[0]), (step.y, onto[1]))
        )

    def forward(self, source: Rows, workspace: FieldWorkspace) -> Rows:
        """Yield lines of the field on the second plane, in any order, from the field on the first."""
        positive = (self._step.y.held + 1) // 2
        for mine, part in to_directions(source, self._element, self._step, workspace):
            lines = workspace.array("lines", (workspace.block, self._step.y.held))[: len(part)]
            middle = len(self._along_y) - positive
            np.multiply(part[:, :positive], self._along_y[middle:], out=lines[:, middle:])
            np.multiply(part[:, positive:], self._along_y[:middle], out=lines[:, :middle])
            for own, there in _in_order(mine, self._step.x.held):
                lines[own] *= self._along_x[there, None]
                yield there, lines[own]

    def vjp(self, gradient: Rows, workspace: FieldWorkspace) -> Rows:
        """Yield blocks of the gradient with respect to the first plane's field, from the gradient of the lines."""
        count, positive = self._step.x.held, (self._step.y.held + 1) // 2

        def by_spectrum() -> Rows:
            for there, lines in gradient:
                found = lines * self._along_x[there, None].conj()
                found *= self._along_y.conj()
                found = workspace.libraries.arrays.roll(found, positive - found.shape[1], axis=1)
                for own, mine in _in_order(there, count, -(count // 2)):
                    yield mine, found[own]

        return to_directions_vjp(by_spectrum(), self._element, self._step, workspace)


def _in_order(lines: slice, count: int, moved: int | None = None) -> Iterator[tuple[slice, slice]]:
    """Yield parts of a run of lines, with their numbers after zero frequency is moved to the middle, or back."""
    first = (lines.start + (count // 2 if moved is None else moved)) % count
    border = min(lines.stop - lines.start, count - first)
    yield slice(0, border), slice(first, first + border)
    if lines.start + border < lines.stop:
        yield slice(border, lines.stop - lines.start), slice(0, lines.stop - lines.start - border)


def _to_rows(columns: fft.Field, step: Step, workspace: FieldWorkspace) -> Rows:
    """Yield rows from columns, transformed back and cut to their first samples."""
    x, y = step.x, step.y
    block = workspace.array("next rows", (workspace.block, x.held))
    for rows in workspace.runs(y.wanted):
        part = block[: rows.stop - rows.start]
        for first in range(0, x.held, _TILE):
            tile = slice(first, min(first + _TILE, x.held))
            part[:, tile] = columns[tile, rows].T
        yield rows, _from_lowest(part, x, workspace)


def _from_lowest(part: fft.Field, axis: AxisStep, workspace: FieldWorkspace) -> fft.Field:
    """Return the destination samples of rows, from the rows' lowest frequencies."""
    if axis.held < axis.new_padded:
        low, high = _lowest(axis.new_padded, axis.held)
        wide = workspace.array("wide", (len(part), axis.new_padded))
        wide[:, low.stop : high.start] = 0
        wide[:, low], wide[:, high] = part[:, : low.stop], part[:, low.stop :]
        part = wide
    return workspace.fft(part, inverse=True)[:, : axis.wanted]


def _lowest(size: int, held: int) -> tuple[slice, slice]:
    """Return the slices of the lowest frequencies, nonnegative and negative, in a spectrum with zero first."""
    positive = (held + 1) // 2
    return slice(0, positive), slice(size - (held - positive), size)


_NEAR = (-1, 0, 1, 2)
"""Samples next to the one before an edge that the integral up to the edge depends on, apart from the sum before it."""

_MARGIN = 4
"""Dark samples on both sides, so that every edge has samples near."""

_EDGES = 2**19
"""Edges of bins that are worked out at a time."""


def _beyond(f: NDArray[np.float64], a: float, b: float, c: float, d: float) -> NDArray[np.float64]:
    """Return the part of an integral from an edge of samples to an edge f samples further.

    The values a to d belong to the samples `_NEAR`.
    """
    inside = f * (b + f * ((c - a) / 4 + f * ((a - 2.5 * b + 2 * c - d / 2) / 3 + f * (3 * (b - c) + d - a) / 8)))
    return inside + (a - c) / 24 - b / 2


class Integrals:
    """Integrals of sampled lines between neighbouring edges.

    The lines of `edges_of` are (lines, bins + 1), counted in samples from the middle one. Of the `count` samples of a
    line, an odd number, zero comes first and the negative ones last. Edges are recomputed for every block of lines,
    since for a large plane they would take many times the memory of its bins.
    """

    def __init__(self, edges_of: Callable[[slice], NDArray[np.float64]], lines: int, bins: int, count: int) -> None:
        self._edges_of, self._shape = edges_of, (lines, bins)
        self._half, self._size = count // 2, count + 2 * _MARGIN
        self._buffer: Any = None

    def _places(self, lines: slice) -> tuple[Any, Any]:
        """Return the samples before the edges of lines, and the distances of the edges from these samples."""
        arrays = active_backend().arrays
        # Beyond the samples all is dark; an edge there is as good as one just outside.
        edges = arrays.clip(arrays.asarray(self._edges_of(lines)), -self._half - 2, self._half + 2)
        position = edges + (self._half + _MARGIN)
        before = arrays.floor(position)
        return before.astype(np.int64), position - before

    def _blocks(self, lines: slice) -> Iterator[slice]:
        """Yield slices of the lines with so few edges that intermediate arrays stay small."""
        start, stop, _ = lines.indices(self._shape[0])
        height = max(1, _EDGES // (self._shape[1] + 1))
        for first in range(start, stop, height):
            yield slice(first, min(first + height, stop))

    def forward(self, values: Any, lines: slice = slice(None)) -> Any:
        """Return integrals over bins, (lines, bins), of sampled lines, (lines, count), or of a field's power."""
        arrays = active_backend().arrays
        found = arrays.empty((len(values), self._shape[1]))
        start = lines.indices(self._shape[0])[0]
        for block in self._blocks(lines):
            mine, (before, f) = slice(block.start - start, block.stop - start), self._places(block)
            numbers, parts = self._padded(values[mine])
            flat, row = numbers.reshape(-1), arrays.arange(len(numbers))[:, None] * self._size
            # Sums from above the lower edge of each bin; where two edges lie together, there is nothing to add.
            upwards = before[:, ::-1] + 1
            sums = arrays.add.reduceat(flat, (parts * (row + upwards)).reshape(-1)).reshape(upwards.shape)
            total = arrays.where(upwards[:, 1:] > upwards[:, :-1], sums[:, :-1], 0)[:, ::-1]
            near = [parts * (row + before + offset) for offset in _NEAR]
            beyond = _beyond(f, *(flat[at] + flat[at + 1] if parts == 2 else flat[at] for at in near))
            found[mine] = total + beyond[:, :-1] - beyond[:, 1:]
        return found

    def _padded(self, values: Any) -> tuple[Any, int]:
        """Return lines with ordered samples and dark margins, and the number of values per sample."""
        arrays, middle, half = active_backend().arrays, _MARGIN + self._half, self._half
        shape, kind = (len(values), self._size), values.dtype
        if self._buffer is None or self._buffer.shape != shape or self._buffer.dtype != kind:
            self._buffer = arrays.zeros(shape, kind)
        places = ((slice(half + 1), slice(middle, middle + half + 1)), (slice(half + 1, None), slice(_MARGIN, middle)))
        if not arrays.iscomplexobj(values):
            for source, there in places:
                self._buffer[:, there] = values[:, source]
            return self._buffer, 1
        numbers = self._buffer.view(values.real.dtype)
        for source, there in places:
            given = values[:, source].view(numbers.dtype)
            arrays.multiply(given, given, out=numbers[:, 2 * there.start : 2 * there.stop])
        return numbers, 2

    def vjp(self, bins: Any) -> Any:
        """Return the transpose of `forward`, from (lines, bins) to (lines, count), for all lines."""
        arrays = active_backend().arrays
        found = arrays.empty((self._shape[0], self._size - 2 * _MARGIN))
        for block in self._blocks(slice(None)):
            (before, f), mine = self._places(block), bins[block]
            total = arrays.pad(mine, ((0, 0), (0, 1))) - arrays.pad(mine, ((0, 0), (1, 0)))
            first = before + arrays.arange(len(mine))[:, None] * self._size

            def scattered(positions: Any, values: Any, size: int = len(mine) * self._size) -> Any:
                return arrays.bincount(positions.ravel(), values.ravel(), size).reshape(-1, self._size)

            padded = arrays.cumsum(scattered(first, total)[:, ::-1], axis=1)[:, ::-1].copy()
            for offset, unit in zip(_NEAR, np.eye(len(_NEAR)), strict=True):
                padded += scattered(first + offset, _beyond(f, *unit) * total)
            found[block] = arrays.roll(padded[:, _MARGIN:-_MARGIN], -self._half, axis=1)
        return found


class BinSums:
    """Sums of power over the bins of one object plane, with `oversample` bins per lens.

    Sums are in pixel values times pixels. Negative sums, which cubic interpolation may give, are set to zero.
    """

    def __init__(self, step: Directions, camera: PlenopticCamera, wavelength: float, oversample: int) -> None:
        width = camera.mla_pitch / (camera.mla_distance * oversample)
        columns, rows = (count * oversample for count in camera.bin_count)
        # Lines of the main lens are along y.
        in_x, in_y = step.y, step.x
        across, down = (in_millimetres(wavelength) / axis.window for axis in (in_x, in_y))
        # The object is upside down in camera coordinates: bins grow with -X.
        slope_x, slope_y = ((np.arange(count + 1) - count / 2) * -width for count in (columns, rows))
        middle = (slope_x[:-1, None] + slope_x[1:, None]) / 2
        cosine = (np.fft.fftfreq(in_y.new_padded, 1 / in_y.new_padded) * down)[:, None]
        paraxial = is_paraxial(camera)

        def along_x(lines: slice) -> NDArray[np.float64]:
            if paraxial:
                return (slope_x + 0 * cosine[lines]) / across
            return slope_x / np.sqrt(1 + slope_x * slope_x) * np.sqrt(1 - cosine[lines] ** 2) / across

        def along_y(lines: slice) -> NDArray[np.float64]:
            if paraxial:
                return (slope_y + 0 * middle[lines]) / down
            return slope_y / np.sqrt(1 + slope_y * slope_y + middle[lines] ** 2) / down

        self._along_x = Integrals(along_x, in_y.new_padded, columns, in_x.new_padded)
        self._along_y = Integrals(along_y, columns, rows, in_y.new_padded)
        # Parseval, of transforms that were divided by their lengths, over the area of a pixel.
        self._scale = step.x.window * step.y.window / camera.pixel_size**2
        self._shape = in_y.new_padded, columns

    def forward(self, power: Iterable[tuple[slice, Any]]) -> Any:
        """Return the sums over bins of blocks of power, or of a field's power, (directions along y, along x)."""
        arrays = active_backend().arrays
        along_x = arrays.empty(self._shape)
        for lines, part in power:
            along_x[lines] = self._along_x.forward(part, lines)
        self._lit_x = along_x > 0
        sums = self._along_y.forward(arrays.maximum(along_x, 0, out=along_x).T)
        self._lit = sums > 0
        return (arrays.maximum(sums, 0) * self._scale).T

    def jvp(self, change: Any) -> Any:
        """Return the change of the sums for a change of the power, after `forward` of that power."""
        arrays = active_backend().arrays
        along_x = arrays.where(self._lit_x, self._along_x.forward(change), 0)
        return (arrays.where(self._lit, self._along_y.forward(along_x.T), 0) * self._scale).T

    def vjp(self, bins: Any) -> Any:
        """Return the transpose of `jvp`, applied to bins."""
        arrays = active_backend().arrays
        along_x = self._along_y.vjp(arrays.where(self._lit, bins.T, 0) * self._scale).T
        return self._along_x.vjp(arrays.where(self._lit_x, along_x, 0))
