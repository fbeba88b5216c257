"""Power over bins of an object plane, from a field over direction cosines, in Dr.Jit.

Bins are even in the slope X / g, fields in the cosine X / |X|. The power is therefore interpolated between the samples
of the field, which are fine enough to do that linearly, at points that are even in slopes and a whole number to a bin.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np

from ..camera import PlenopticCamera
from ..runtime.backend import backend
from ..runtime.fft import Field, as_words, unpack
from ..runtime.indexing import quotient
from .grids import AxisDirections, Directions

# Points that are interpolated at once.
_BLOCK = 2**22


def power_in_bins(spectrum: Field, step: Directions, camera: PlenopticCamera, oversample: int) -> np.ndarray:
    """Sum the power over bins.

    Parameters
    ----------
    spectrum : complex64 array
        From `steps.to_directions`.
    step : Directions
        Its sampling.
    camera : PlenopticCamera
        The camera.
    oversample : int
        Bins per lens along each axis.

    Returns
    -------
    (rows, columns) float32 array
        In units of the power of the field at the main lens, integrated over the pupil.
    """
    libraries = backend()
    types = libraries.types
    width = camera.mla_pitch / (camera.mla_distance * oversample)
    points = math.ceil(width / max(step.x.step, step.y.step))
    columns, rows = (count * oversample for count in camera.bin_count)
    words, stride = types.UInt64(as_words(spectrum)), spectrum.shape[1]
    # Parseval, of transforms that were divided by their lengths, and the area of a point in samples.
    scale = math.prod(axis.padded * axis.pitch / axis.step for axis in (step.x, step.y)) * (width / points) ** 2
    total = libraries.arrays.empty((rows, columns), np.float32)
    together = max(1, _BLOCK // (columns * points * points))
    for first in range(0, rows, together):
        count = min(together, rows - first)
        index = dr.arange(types.UInt32, count * points * columns * points)
        row = quotient(types, index, columns * points)
        column = index - row * dr.opaque(types.UInt32, columns * points)
        # The object is upside down in camera coordinates: bins grow with -X.
        tx = _slope(types, column, 0, columns, width, points)
        ty = _slope(types, row, first, rows, width, points)
        norm = 1 / (1 + tx * tx + ty * ty)
        power = _interpolated(types, words, stride, step, tx * dr.sqrt(norm), ty * dr.sqrt(norm))
        # A solid angle in cosines over that in slopes.
        sums = dr.block_sum(power * norm * norm * dr.opaque(types.Float, scale), points)
        dr.eval(sums)
        total[first : first + count] = libraries.from_drjit(sums).reshape(count, points, columns).sum(1)
    return total


def _slope(types: Any, index: Any, first: int, count: int, width: float, points: int) -> Any:
    """Slope X / g of the points of bins, counted from the bin `first` on."""
    place = types.Float(index) + dr.opaque(types.Float, (first - count / 2) * points + 0.5)
    return place * dr.opaque(types.Float, -width / points)


def _interpolated(types: Any, words: Any, stride: int, step: Directions, sx: Any, sy: Any) -> Any:
    """Squared modulus of the field at direction cosines, linear between samples; 0 where none are kept."""
    (i, along_x), (j, along_y) = (_samples(types, s, axis) for s, axis in ((sx, step.x), (sy, step.y)))
    total = types.Float(0)
    for place_x, inside_x, weight_x in _neighbours(types, i, along_x, step.x):
        for place_y, inside_y, weight_y in _neighbours(types, j, along_y, step.y):
            place = place_x * dr.opaque(types.UInt32, stride) + place_y
            value = unpack(dr.gather(types.UInt64, words, place, inside_x & inside_y))
            total += (value.real * value.real + value.imag * value.imag) * weight_x * weight_y
    return total


def _samples(types: Any, cosine: Any, axis: AxisDirections) -> tuple[Any, Any]:
    """Return the sample before a direction cosine, and how far that lies beyond it."""
    place = cosine * dr.opaque(types.Float, 1 / axis.step)
    before = dr.floor(place)
    return types.Int32(before), place - before


def _neighbours(types: Any, index: Any, beyond: Any, axis: AxisDirections) -> list[tuple[Any, Any, Any]]:
    """Return place in the spectrum, whether it is there, and weight, of a sample and of the one after it."""
    most = dr.opaque(types.Int32, axis.kept // 2)
    kept = dr.opaque(types.Int32, axis.kept)
    found = []
    for number, weight in ((index, 1 - beyond), (index + 1, beyond)):
        place = types.UInt32(dr.select(number >= 0, number, number + kept))
        found.append((place, dr.abs(number) <= most, weight))
    return found
