"""Resampling of an intensity on a rotated grid, and its adjoint."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..lattice import turn
from ..runtime.backend import Backend, backend_of
from ..runtime.fft import split
from .pixels import HALF_WIDTH, windowed_sinc

_PARTS = 4096
"""Number of positions between two samples for which interpolation weights are tabulated."""

_TAPS = 2 * HALF_WIDTH
_BLOCK = 2**22


class TurnedSamples:
    """Samples of an intensity on a new grid, relative to which its own is rotated counter-clockwise about the axis.

    `samples` and `shape` are the rows and columns of the intensity's own samples and of the new ones; `pitch` and
    `origin` (x, y) are those of its own samples in their own frame. Outside its own samples the intensity is zero.
    """

    def __init__(
        self,
        samples: tuple[int, int],
        pitch: tuple[float, float],
        origin: tuple[float, float],
        degrees: float,
        new_pitch: float,
        new_origin: tuple[float, float],
        shape: tuple[int, int],
    ) -> None:
        self._samples, self._pitch, self._origin, self._degrees = samples, pitch, origin, degrees
        self._new_pitch, self._new_origin, self._shape = new_pitch, new_origin, shape
        self._padded = samples[0] + 2 * HALF_WIDTH, samples[1] + 2 * HALF_WIDTH
        parts = (np.arange(_PARTS) + 0.5) / _PARTS
        self._weights = windowed_sinc(parts[:, None] - np.arange(1 - HALF_WIDTH, 1 + HALF_WIDTH)).astype(np.float32)

    def forward(self, intensity: NDArray[np.float32]) -> NDArray[np.float32]:
        """Interpolate the intensity (rows, columns) at the new samples."""
        libraries = backend_of(intensity)
        types, arrays = libraries.types, libraries.arrays
        values = types.Float(arrays.pad(intensity, HALF_WIDTH).reshape(-1))
        result = arrays.empty(self._shape, np.float32)
        for lines, active, across, visit in self._visited(libraries):

            def add(row: Any, weight: Any, total: Any, active: Any = active, across: Any = across) -> Any:
                line = types.Float(0)
                for k in range(_TAPS):
                    line = dr.fma(dr.gather(types.Float, values, row + k, active), across[k], line)
                return dr.fma(line, weight, total)

            total = visit(add, dr.zeros(types.Float, dr.width(active)))
            dr.eval(total)
            result[lines] = libraries.from_drjit(total).reshape(lines.stop - lines.start, -1)
        return result

    def adjoint(self, samples: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return for each of the intensity's own samples the new ones, weighted by its contribution to each of them.

        The rounding of the result depends on the order in which threads add.
        """
        libraries = backend_of(samples)
        types = libraries.types
        sums = dr.zeros(types.Float, self._padded[0] * self._padded[1])
        for lines, active, across, visit in self._visited(libraries):
            given = types.Float(samples[lines].reshape(-1))

            def spread(
                row: Any, weight: Any, total: Any, active: Any = active, across: Any = across, given: Any = given
            ) -> Any:
                for k in range(_TAPS):
                    dr.scatter_add(sums, given * weight * across[k], row + k, active)
                return total

            dr.eval(visit(spread, types.Float(0)), sums)
        dr.eval(sums)
        inner = slice(HALF_WIDTH, -HALF_WIDTH)
        return libraries.arrays.ascontiguousarray(libraries.from_drjit(sums).reshape(self._padded)[inner, inner])

    def _visited(
        self, libraries: Backend
    ) -> Iterator[tuple[slice, Any, list[Any], Callable[[Callable[[Any, Any, Any], Any], Any], Any]]]:
        """Yield lines of the new grid, a mask of their samples, weights across, and a loop over the rows around."""
        types = libraries.types
        table = types.Float(self._weights.reshape(-1))
        rows, columns = self._samples
        height, width = self._shape
        together = max(1, _BLOCK // width)
        for top in range(0, height, together):
            lines = slice(top, min(height, top + together))
            count = (lines.stop - top) * width
            _, row, column = split(types, dr.arange(types.UInt32, count), lines.stop - top, width)
            x = types.Float64(column) * self._new_pitch + dr.opaque(types.Float64, self._new_origin[0])
            y = types.Float64(row) * self._new_pitch + dr.opaque(
                types.Float64, self._new_origin[1] + top * self._new_pitch
            )
            first, entry = [], []
            active = dr.full(types.Bool, True, count)
            for axis, (place, size) in enumerate(zip(turn(x, y, -self._degrees), (columns, rows), strict=True)):
                place = (place - dr.opaque(types.Float64, self._origin[axis])) * dr.opaque(
                    types.Float64, 1 / self._pitch[axis]
                ) + HALF_WIDTH
                below = dr.floor(place)
                active &= (below >= HALF_WIDTH - 1) & (below < HALF_WIDTH + size)
                entry.append(types.UInt32(dr.clip((place - below) * _PARTS, 0, _PARTS - 1)) * _TAPS)
                first.append(types.UInt32(dr.clip(below, HALF_WIDTH - 1, size + HALF_WIDTH - 1)) - (HALF_WIDTH - 1))
            across = [dr.gather(types.Float, table, entry[0] + k) for k in range(_TAPS)]
            start = first[1] * dr.opaque(types.UInt32, self._padded[1]) + first[0]

            def visit(
                step: Callable[[Any, Any, Any], Any],
                total: Any,
                start: Any = start,
                entry: Any = entry[1],
                active: Any = active,
            ) -> Any:
                def body(line: Any, total: Any) -> tuple[Any, Any]:
                    row = start + line * dr.opaque(types.UInt32, self._padded[1])
                    weight = dr.gather(types.Float, table, entry + line, active)
                    return line + 1, step(row, weight, total)

                line = dr.zeros(types.UInt32, dr.width(active))
                return dr.while_loop((line, total), lambda line, total: line < _TAPS, body)[1]

            yield lines, active, across, visit
