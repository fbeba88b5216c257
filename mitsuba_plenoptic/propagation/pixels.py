"""Integrals over pixels of an intensity that is sampled on a grid of its own."""

from __future__ import annotations

import math

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from .._backend import backend_of

_HALF_WIDTH = 6
_KAISER = 7.0
_NODES = 8


def integrate_pixels(
    intensity: NDArray[np.float32],
    pitch: float,
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
    pitch : float
        Distance between samples in millimetres.
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
        _weights(count, pixel_size, (first_edge[axis] - origin[axis]) / pitch, pitch, samples)
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
        distance = place - (below + offset)
        window = np.i0(_KAISER * np.sqrt(np.maximum(0, 1 - (distance / _HALF_WIDTH) ** 2))) / np.i0(_KAISER)
        entries.append((np.sinc(distance) * window * node_weights, pixel, below + offset))
    values, rows, columns = (np.concatenate([entry[k].ravel() for entry in entries]) for k in range(3))
    held = (columns >= 0) & (columns < samples)
    matrix = scipy.sparse.coo_array((values[held], (rows[held], columns[held])), shape=(count, samples))
    return matrix.tocsr().astype(np.float32)
