"""Relative power or amplitude over the pupil for many points, between cells by cubic B-splines (Unser 1999)."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import Opening
from ..errors import refuse_if
from ..runtime import IMAGE, Array, Doubles, Flags, Floats, Integers, Pair, as_array, drjit_array, fft

BORDER = 2
"""Cells beyond each side of the square for which there are coefficients of complex amplitudes."""


@dataclass(frozen=True)
class PupilWeights:
    """Relative power over the pupil for many points, most of which share the same weights.

    The pupil's bounding square is cut into m x m cells, rows along y and columns along x of the camera frame.
    """

    table: Floats | NDArray[np.complex64]
    """Distinct nonnegative weights, (k, m, m); or coefficients of complex amplitudes, with `BORDER` cells more on each
    side."""
    index: Integers  # index of the weights of each point, (n,)
    slant: Doubles
    """Relative growth of the power from the pupil's centre to its rim, along x and y of the camera frame, (n, 2)."""
    sampled: bool = False
    """Whether the weights are samples at cell centres, between which the power is smooth; otherwise each weight
    holds for its whole cell."""

    @classmethod
    def of(cls, weights: Any, count: int) -> PupilWeights | None:
        """Return the pupil weights of `count` points, None if the whole pupil is open to all points alike.

        The weights have the shape (points, m, m): relative power, or booleans for the visible part. None means uniform
        power.
        """
        if weights is None:
            return None
        if isinstance(weights, PupilWeights):
            shape = (len(weights.index), *weights.table.shape[1:])
        else:
            shape = np.shape(weights)
        refuse_if(
            len(shape) != 3 or shape != (count, shape[1], shape[1]) or shape[1] == 0,
            f"pupil_weights of shape {shape}: it must be ({count}, m, m)",
        )
        if isinstance(weights, PupilWeights):
            return weights
        values = as_array("pupil_weights", weights, ("point", *IMAGE[:2]), dtype=None, shape=shape, least=0)
        if values.dtype == np.bool_:
            return cls.from_bits(np.packbits(values.reshape(count, -1), axis=1), shape[1])
        table, index = np.unique(values.astype(np.float32).reshape(count, -1), axis=0, return_inverse=True)
        return cls(table.reshape(-1, *shape[1:]), index.reshape(-1), np.zeros((count, 2)))

    @classmethod
    def through(cls, aperture: Opening, count: int) -> PupilWeights:
        """Return the pupil weights of `count` points through an aperture, the same for all of them."""
        table = aperture.cells().astype(np.float32)[None]
        return cls(table, np.zeros(count, np.int64), np.zeros((count, 2)))

    @classmethod
    def from_bits(cls, bits: NDArray[np.uint8], cells: int) -> PupilWeights:
        """Return pupil weights from masks of cells x cells booleans, each packed into a row of bits."""
        rows, index = np.unique(bits, axis=0, return_inverse=True)
        table = np.unpackbits(rows, axis=1, count=cells * cells).astype(np.float32)
        return cls(table.reshape(-1, cells, cells), index.reshape(-1), np.zeros((len(bits), 2)))

    def take(self, points: Array | slice) -> PupilWeights:
        """Return the weights of a selection of points."""
        tables, index = np.unique(self.index[points], return_inverse=True)
        return replace(self, table=self.table[tables], index=index.reshape(-1), slant=self.slant[points])

    def lit(self) -> Flags:
        """Return, for each point, whether any light passes the pupil."""
        return (np.abs(self.table).reshape(len(self.table), -1).max(axis=1) > 0)[self.index]

    def at(self, point: Any, Px: Any, Py: Any, radius: Any, sample: Any) -> Pair:
        """Return the weights, and the amplitudes whose squares they are, averaged over each sample of the pupil.

        Otherwise the steep spectrum of a hard cell border would be aliased into the band of the samples. Samples wider
        than a cell are treated as one cell wide.
        """
        UInt32 = type(point)
        Float = dr.float32_array_t(UInt32)
        complex_ = np.iscomplexobj(self.table)
        size = self.table.shape[1]
        border = BORDER if complex_ else 0
        cells = size - 2 * border
        first = dr.gather(UInt32, drjit_array(UInt32, self.index), point) * (size * size)
        half = dr.minimum(sample * (cells / (4 * radius)), 0.5)
        sides = []
        for P in (Px, Py):
            position = (P + radius) * (cells / (2 * radius))
            if self.sampled:
                # The four cells around a position, and the values of the cubic B-splines centred on these cells.
                before = dr.floor(position - 0.5)
                right = position - 0.5 - before
                left = 1 - right
                parts = left**3 / 6, 2 / 3 - right**2 + right**3 / 2, 2 / 3 - left**2 + left**3 / 2, right**3 / 6
                near = [(before + step, weight) for step, weight in zip(range(-1, 3), parts, strict=True)]
            else:
                # The two cells that a sample overlaps, and the fraction of it beyond the border between them.
                low, high = (dr.floor(dr.clip(position + side * half, 0, cells - 1)) for side in (-1, 1))
                beyond = dr.clip((position + half - high) / (2 * half), 0, 1)
                near = [(low, 1 - beyond), (high, beyond)]
            sides.append([(UInt32(dr.clip(cell + border, 0, size - 1)), Float(values_at)) for cell, values_at in near])
        tables = [
            drjit_array(Float, values_at)
            for values_at in ([self.table.real, self.table.imag] if complex_ else [self.table])
        ]
        sums = [dr.zeros(Float) for _ in tables]
        amplitude = dr.zeros(Float)
        for (column, across), (row, down) in itertools.product(*sides):
            weights = [dr.gather(Float, table, first + row * size + column) for table in tables]
            sums = [total + across * down * weight for total, weight in zip(sums, weights, strict=True)]
            amplitude += across * down * dr.sqrt(weights[0])
        power = sums[0]
        if complex_:
            power = sums[0] ** 2 + sums[1] ** 2
            amplitude = fft.array_types(point).Complex2f(*sums)
        elif self.sampled:
            amplitude = dr.sqrt(power)
        slant = [dr.gather(Float, drjit_array(Float, values_at), point) for values_at in self.slant.T]
        cosine = Float(dr.maximum(1 + (slant[0] * Float(Px) + slant[1] * Float(Py)) / radius, 0))
        return power * cosine, amplitude * dr.sqrt(cosine)


def slants(normals: NDArray[np.floating[Any]], positions: Doubles, radius: float) -> Doubles:
    """Return the relative growth of power over the pupil for surfaces with normals in the camera frame.

    Normals are 0 where there is no surface.
    """
    height = (normals * positions).sum(1)
    slant = -radius * normals[:, :2] / np.where(height == 0, np.inf, height)[:, None]
    # 0.98: Largest slant: if a surface is seen more obliquely, the pupil sees both sides, one of which is hidden.
    return slant / np.maximum(1, np.hypot(*slant.T) / 0.98)[:, None]
