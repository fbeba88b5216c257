"""Sums of a field's power over the bins of an object plane.

Bins are uniform in the slope X / g, and so are the directions of paraxial light. The directions of other light are
uniform in the cosine X / |X|. For a fixed cosine along y, the edges of bins along x are known cosines; so the power is
integrated along x for every sample in y as the samples arrive, and then along y for every column of bins, with the
edges at the column's middle. Between the samples the power is interpolated cubically (Keys, "Cubic convolution
interpolation for digital image processing", 1981); the integral is the sum of the samples between two edges and a few
near each.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from ..fields import Directions, is_paraxial
from ..optics import in_millimetres
from ..runtime import Doubles, Pair, active_backend

_NEAR = (-1, 0, 1, 2)
"""Samples next to the one before an edge that the integral up to the edge depends on, apart from the sum before it."""

_MARGIN = 4
"""Dark samples on both sides, so that every edge has samples near."""


def _beyond(f: Doubles, a: float, b: float, c: float, d: float) -> Doubles:
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

    def __init__(self, edges_of: Callable[[slice], Doubles], lines: int, bins: int, count: int):
        self._edges_of = edges_of
        self._shape = (lines, bins)
        self._half = count // 2
        self._size = count + 2 * _MARGIN
        self._buffer: Any = None

    def _places(self, lines: slice) -> Pair:
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
        # Edges of bins that are worked out at a time.
        height = max(1, 2**19 // (self._shape[1] + 1))
        for first in range(start, stop, height):
            yield slice(first, min(first + height, stop))

    def forward(self, values: Any, lines: slice = slice(None)) -> Any:
        """Return integrals over bins, (lines, bins), of sampled lines, (lines, count), or of a field's power."""
        arrays = active_backend().arrays
        lines_of = arrays.empty((len(values), self._shape[1]))
        start = lines.indices(self._shape[0])[0]
        for block in self._blocks(lines):
            mine = slice(block.start - start, block.stop - start)
            before, f = self._places(block)
            numbers, parts = self._padded(values[mine])
            flat = numbers.reshape(-1)
            row = arrays.arange(len(numbers))[:, None] * self._size
            # Sums from above the lower edge of each bin; where two edges lie together, there is nothing to add.
            upwards = before[:, ::-1] + 1
            sums = arrays.add.reduceat(flat, (parts * (row + upwards)).reshape(-1)).reshape(upwards.shape)
            total = arrays.where(upwards[:, 1:] > upwards[:, :-1], sums[:, :-1], 0)[:, ::-1]
            near = [parts * (row + before + offset) for offset in _NEAR]
            beyond = _beyond(f, *(flat[at] + flat[at + 1] if parts == 2 else flat[at] for at in near))
            lines_of[mine] = total + beyond[:, :-1] - beyond[:, 1:]
        return lines_of

    def _padded(self, values: Any) -> tuple[Any, int]:
        """Return lines with ordered samples and dark margins, and the number of values per sample."""
        arrays = active_backend().arrays
        middle = _MARGIN + self._half
        half = self._half
        shape = (len(values), self._size)
        kind = values.dtype
        if self._buffer is None or self._buffer.shape != shape or self._buffer.dtype != kind:
            self._buffer = arrays.zeros(shape, kind)
        places = ((slice(half + 1), slice(middle, middle + half + 1)), (slice(half + 1, None), slice(_MARGIN, middle)))
        if not arrays.iscomplexobj(values):
            for source, there in places:
                self._buffer[:, there] = values[:, source]
            return self._buffer, 1
        numbers = self._buffer.view(values.real.dtype)
        for source, there in places:
            selected = values[:, source].view(numbers.dtype)
            arrays.multiply(selected, selected, out=numbers[:, 2 * there.start : 2 * there.stop])
        return numbers, 2

    def vjp(self, bins: Any) -> Any:
        """Return the transpose of `forward`, from (lines, bins) to (lines, count), for all lines."""
        arrays = active_backend().arrays
        rows = arrays.empty((self._shape[0], self._size - 2 * _MARGIN))
        for block in self._blocks(slice(None)):
            before, f = self._places(block)
            mine = bins[block]
            total = arrays.pad(mine, ((0, 0), (0, 1))) - arrays.pad(mine, ((0, 0), (1, 0)))
            first = before + arrays.arange(len(mine))[:, None] * self._size

            def scattered(positions: Any, values: Any, size: int = len(mine) * self._size) -> Any:
                return arrays.bincount(positions.ravel(), values.ravel(), size).reshape(-1, self._size)

            padded = arrays.cumsum(scattered(first, total)[:, ::-1], axis=1)[:, ::-1].copy()
            for offset, unit in zip(_NEAR, np.eye(len(_NEAR)), strict=True):
                padded += scattered(first + offset, _beyond(f, *unit) * total)
            rows[block] = arrays.roll(padded[:, _MARGIN:-_MARGIN], -self._half, axis=1)
        return rows


class BinSums:
    """Sums of power over the bins of one object plane, with `oversample` bins per lens.

    Sums are in pixel values times pixels. Negative sums, which cubic interpolation may give, are set to zero.
    """

    def __init__(self, step: Directions, camera: PlenopticCamera, wavelength: float, oversample: int):
        width = camera.row_pitch / (camera.mla_distance * oversample)
        columns, rows = (count * oversample for count in camera.bin_count)
        # Lines of the main lens are along y.
        in_x = step.y
        in_y = step.x
        across, down = (in_millimetres(wavelength) / axis.window for axis in (in_x, in_y))
        # The object is upside down in camera coordinates: bins grow with -X.
        slope_x, slope_y = ((np.arange(count + 1) - count / 2) * -width for count in (columns, rows))
        middle = (slope_x[:-1, None] + slope_x[1:, None]) / 2
        cosine = (np.fft.fftfreq(in_y.new_padded, 1 / in_y.new_padded) * down)[:, None]
        paraxial = is_paraxial(camera)

        def along_x(lines: slice) -> Doubles:
            if paraxial:
                return (slope_x + 0 * cosine[lines]) / across
            return slope_x / np.sqrt(1 + slope_x * slope_x) * np.sqrt(1 - cosine[lines] ** 2) / across

        def along_y(lines: slice) -> Doubles:
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
        for lines, rows in power:
            along_x[lines] = self._along_x.forward(rows, lines)
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
