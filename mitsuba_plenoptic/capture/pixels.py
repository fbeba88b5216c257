"""Integrals over pixels of an intensity that is sampled on a grid of its own."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from ..lattice import turn
from ..runtime.backend import backend_of

_HALF_WIDTH = 6
_KAISER = 7.0
_NODES = 8

_PARTS = 4096
"""Places between two samples for which the weights of those around are held."""

_TURN_BLOCK = 2**22


def integrate_pixels(
    intensity: NDArray[np.float32],
    pitch: tuple[float, float],
    origin: tuple[float, float],
    pixel_size: float,
    first_edge: tuple[float, float],
    shape: tuple[int, int],
) -> NDArray[np.float32]:
    """Integrate a band-limited intensity over square pixels.

    Between its samples the intensity is a sum of sinc functions under a Kaiser window (Kaiser and Schafer 1980),
    each integrated over each pixel by Gauss's rule; outside the samples it is zero.

    Parameters
    ----------
    intensity : float32 array (rows, columns)
        Samples per square millimetre; of CuPy if they lie on a CUDA device, where the integrals are then.
    pitch : (float, float)
        Distance between samples along x and y in millimetres.
    origin : (float, float)
        x and y of the first sample.
    pixel_size : float
        Width of a pixel in millimetres.
    first_edge : (float, float)
        x and y of the outer corner of the first pixel.
    shape : (int, int)
        Rows and columns of pixels.

    Returns
    -------
    float32 array of that shape
    """
    libraries = backend_of(intensity)
    along_y, along_x = (
        _weights(count, pixel_size, (first_edge[axis] - origin[axis]) / pitch[axis], pitch[axis], samples)
        for axis, count, samples in ((1, shape[0], intensity.shape[0]), (0, shape[1], intensity.shape[1]))
    )
    if libraries.is_cuda:
        along_y, along_x = (libraries.sparse.csr_matrix(weights) for weights in (along_y, along_x))
    return libraries.arrays.ascontiguousarray((along_x @ (along_y @ intensity).T).T)


def _weights(count: int, pixel_size: float, start: float, pitch: float, samples: int) -> scipy.sparse.csr_array:
    """Weights (pixels, samples) along one axis; `start` is the first pixel's edge in samples."""
    width = pixel_size / pitch
    pieces = max(1, math.ceil(width))
    nodes, node_weights = np.polynomial.legendre.leggauss(_NODES)
    inside = ((np.arange(pieces)[:, None] + (nodes + 1) / 2) * (width / pieces)).ravel()
    node_weights = np.tile(node_weights / 2 * (pixel_size / pieces), pieces)
    place = start + np.arange(count)[:, None] * width + inside
    below = np.floor(place).astype(np.int64)
    pixel = np.broadcast_to(np.arange(count)[:, None], place.shape)
    entries = []
    for offset in range(1 - _HALF_WIDTH, 1 + _HALF_WIDTH):
        entries.append((_kernel(place - (below + offset)) * node_weights, pixel, below + offset))
    values, rows, columns = (np.concatenate([entry[k].ravel() for entry in entries]) for k in range(3))
    held = (columns >= 0) & (columns < samples)
    matrix = scipy.sparse.coo_array((values[held], (rows[held], columns[held])), shape=(count, samples))
    return matrix.tocsr().astype(np.float32)


def _kernel(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of a sample at a distance in samples: a sinc under a Kaiser window."""
    window = np.i0(_KAISER * np.sqrt(np.maximum(0, 1 - (distance / _HALF_WIDTH) ** 2))) / np.i0(_KAISER)
    return np.asarray(np.sinc(distance) * window)


def turn_samples(
    intensity: NDArray[np.float32],
    pitch: tuple[float, float],
    origin: tuple[float, float],
    degrees: float,
    new_pitch: float,
    new_origin: tuple[float, float],
    shape: tuple[int, int],
) -> NDArray[np.float32]:
    """Interpolate a band-limited intensity at the samples of a grid against which its own is turned.

    Parameters
    ----------
    intensity : float32 array (rows, columns)
        Samples; outside of them the intensity is zero.
    pitch, origin : (float, float)
        Their distances along x and y, and where the first one is, in the frame of the intensity.
    degrees : float
        Angle, counter-clockwise about the axis, by which that frame is turned against that of the new grid.
    new_pitch : float
        Distance between the new samples.
    new_origin : (float, float)
        Where the first of them is.
    shape : (int, int)
        Rows and columns of the new grid.

    Returns
    -------
    float32 array of that shape
    """
    libraries = backend_of(intensity)
    types, arrays = libraries.types, libraries.arrays
    rows, columns = intensity.shape
    margin = _HALF_WIDTH
    padded = arrays.pad(intensity, margin)
    samples = types.Float(padded.reshape(-1))
    offsets = np.arange(1 - _HALF_WIDTH, 1 + _HALF_WIDTH)
    parts = (np.arange(_PARTS) + 0.5) / _PARTS
    weights = types.Float(_kernel(parts[:, None] - offsets).astype(np.float32).reshape(-1))
    result = arrays.empty(shape, np.float32)
    block = max(1, _TURN_BLOCK // shape[1])
    for top in range(0, shape[0], block):
        lines = min(block, shape[0] - top)
        index = dr.arange(types.UInt32, lines * shape[1])
        row = index // dr.opaque(types.UInt32, shape[1])
        column = index - row * dr.opaque(types.UInt32, shape[1])
        x = types.Float64(column) * new_pitch + dr.opaque(types.Float64, new_origin[0])
        y = types.Float64(row) * new_pitch + dr.opaque(types.Float64, new_origin[1] + top * new_pitch)
        first, entry = [], []
        held = dr.full(types.Bool, True, len(index))
        for axis, (place, count) in enumerate(zip(turn(x, y, -degrees), (columns, rows), strict=True)):
            place = (place - dr.opaque(types.Float64, origin[axis])) * dr.opaque(
                types.Float64, 1 / pitch[axis]
            ) + margin
            below = dr.floor(place)
            held &= (below >= margin - 1) & (below < margin + count)
            entry.append(types.UInt32(dr.clip((place - below) * _PARTS, 0, _PARTS - 1)) * len(offsets))
            first.append(types.UInt32(dr.clip(below, margin - 1, count + margin - 1)) - (_HALF_WIDTH - 1))
        total = _sum_around(types, samples, weights, first, entry, padded.shape[1], held)
        dr.eval(total)
        result[top : top + lines] = libraries.from_drjit(total).reshape(lines, shape[1])
    return result


def _sum_around(
    types: Any, samples: Any, weights: Any, first: list[Any], entry: list[Any], columns: int, active: Any
) -> Any:
    """Sum the samples around each place, weighted along both axes."""
    size = 2 * _HALF_WIDTH
    across = [dr.gather(types.Float, weights, entry[0] + k) for k in range(size)]

    def body(line: Any, total: Any) -> tuple[Any, Any]:
        start = (first[1] + line) * dr.opaque(types.UInt32, columns) + first[0]
        row = types.Float(0)
        for k in range(size):
            row = dr.fma(dr.gather(types.Float, samples, start + k, active), across[k], row)
        return line + 1, dr.fma(row, dr.gather(types.Float, weights, entry[1] + line, active), total)

    line = dr.zeros(types.UInt32, dr.width(active))
    _, total = dr.while_loop((line, dr.zeros(types.Float, dr.width(active))), lambda line, total: line < size, body)
    return total
