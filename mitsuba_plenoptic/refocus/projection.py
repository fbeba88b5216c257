"""Sums of pixels over the bins of an object plane, along one ray per pixel, and their transpose.

The bin of a pixel's light is separable in x and y, but the condition that the light passes the pupil is not:

    out[j, i] = sum_r sum_c  Wy[j, r] Wx[i, c] [Px[c]^2 + Py[r]^2 <= R^2] image[r, c]

The sum over columns is done for each row in one pass over the image, with each thread gathering the few columns of one
bin; the sum over rows is then small. Nothing is scattered, so the result is bit for bit the same for any number of
threads. Where lenses are not aligned with bins, `Splat` sums the pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from scipy.sparse import csr_matrix

from ..camera import PlenopticCamera
from ..design import focus_type, lens_footprint, pixel_footprint
from ..errors import refuse_if
from ..optics import rays
from ..rays import follow_back
from ..runtime import Array, Pair, array_module, drjit_array, require_memory
from .splatting import Splat


def pupil_radius(camera: PlenopticCamera) -> float:
    """Radius in mm within which a pixel's central ray must pass: the pupil's, half a pixel and half a lens's view.

    A pixel at a micro-image's rim is partly lit though its centre may look past the pupil; leaving such pixels out
    would lose 3 % of the paper's light. Through the edge of a lens that is not focused on the pupil, a pixel sees
    another point than through the centre, in a focused camera by a good part of the pupil.
    """
    view = max(abs(camera.pupil_shift(f2) - 1) for f2 in camera.mla_focal_lengths) * camera.lattice.aperture_reach
    return camera.lit_radius + view


# Dr.Jit counts in 32 bits.
_MOST_VALUES = 2**32 - 1


def ray_sums(
    image: Array, camera: PlenopticCamera, distance: float, radius: float, footprint: str, oversample: int
) -> Array:
    """Return the sums over bins of the pixels whose central rays, traced back to the object plane, meet each bin.

    Pixels and bins that are arranged alike, on an upright square lattice without gaps of unfocused lenses behind a thin
    main lens, are summed one axis at a time.
    """
    axes = aligned_axes(camera, distance, radius, footprint, oversample)
    if axes is None:
        return Splat.of(camera, distance, radius, footprint, oversample, image.shape[2]).forward(image)
    x, y = axes
    columns = x.weights.shape[0]
    rows = y.weights.shape[0]
    values = image.shape[2] * columns * max(rows, image.shape[0])
    refuse_if(
        values > _MOST_VALUES,
        f"images of {columns} x {rows} bins: {values} values are summed at once, at most {_MOST_VALUES} can be",
    )
    types = array_module()
    height, width, channels = image.shape
    if not (x.weights.nnz and y.weights.nnz):
        # No pixel meets a bin.
        return np.zeros((rows, columns, channels), np.float32)
    pixels = drjit_array(types.Float, image)
    across = columns * channels
    thread = dr.arange(types.UInt32, height * across)
    row = thread // across
    remainder = thread % across
    limit = drjit_array(types.Float, radius**2 - y.pupil**2)
    base = row * dr.opaque(types.UInt32, width * channels) + remainder % channels
    by_row = _sums(types, pixels, x, remainder // channels, base, channels, dr.gather(types.Float, limit, row))
    thread = dr.arange(types.UInt32, rows * across)
    sums = _sums(types, by_row, y, thread // across, thread % across, across)
    return sums.numpy().reshape(rows, columns, channels)


def aligned_axes(
    camera: PlenopticCamera, distance: float, radius: float, footprint: str, oversample: int
) -> tuple[AxisBins, AxisBins] | None:
    """Return the bins of the pixels along each axis, or None unless pixels and bins are arranged alike."""
    if not camera.lens_data.is_thin or focus_type(camera) != "unfocused" or not camera.lenses_like_bins:
        return None
    x, y = (_axis(camera, distance, radius, axis, footprint, oversample) for axis in (0, 1))
    return x, y


def _axis(
    camera: PlenopticCamera, distance: float, radius: float, axis: int, footprint: str, oversample: int
) -> AxisBins:
    """Return the positions of the pixels of one axis, on the bins and on the pupil."""
    count = camera.bin_count[axis] * oversample
    p = camera.pixel_coordinates(axis)
    chief = rays.chief_point(camera, p)
    index = camera.lattice.axis_cell(chief, axis)
    c = camera.lattice.centre(index, index)[axis]
    pupil, position = follow_back(p, c, c, distance, camera)
    centre = position * (oversample / camera.row_pitch) + count / 2
    if footprint == "point":
        return axis_bins(centre, centre, pupil, count, radius)
    width = max(
        camera.row_pitch * lens_footprint(camera, distance, camera.mla_focal_lengths[0]),
        pixel_footprint(camera, distance),
    )
    half = width / 2 * oversample / camera.row_pitch
    return axis_bins(centre - half, centre + half, pupil, count, radius)


def ray_sums_vjp(
    bins: Array, camera: PlenopticCamera, distance: float, radius: float, footprint: str, oversample: int
) -> Array:
    """Return the transpose of `ray_sums`, applied to bins."""
    axes = aligned_axes(camera, distance, radius, footprint, oversample)
    if axes is None:
        return Splat.of(camera, distance, radius, footprint, oversample, bins.shape[2]).vjp(bins, camera.shape)
    x, y = axes
    pixels = np.einsum("jic,jr->ric", np.asarray(bins, np.float64), y.weights.toarray(), optimize=True)
    pixels = np.einsum("ric,ip->rpc", pixels, x.weights.toarray(), optimize=True)
    # In the precision in which the sums compare them.
    limit = (radius**2 - y.pupil**2).astype(np.float32)
    square = (x.pupil**2).astype(np.float32)
    return np.where((square <= limit[:, None])[..., None], pixels, 0.0)


@dataclass(frozen=True)
class AxisBins:
    """Weights (bins, pixels) of the pixels of one axis, and the pupil coordinate of each pixel."""

    weights: csr_matrix
    pupil: Array


def axis_bins(low: Array, high: Array, pupil: Array, count: int, radius: float) -> AxisBins:
    """Return weights that spread each pixel uniformly over the interval from `low` to `high` in bin coordinates."""
    pixels = np.flatnonzero(np.abs(pupil) <= radius)
    low, high = np.minimum(low, high)[pixels], np.maximum(low, high)[pixels]
    first = np.floor(low).astype(np.int64)
    width = high - low
    spread = width > 1e-9
    reach = int(np.max(np.where(spread, np.ceil(high), first + 1) - first, initial=1))
    # For every pixel of the axis and bin that it reaches: bin, overlap, fraction, weight and what is made of them.
    require_memory(64.0 * pixels.size * reach, f"{pixels.size} pixels of an axis, each spread over {reach} bins")
    bins = first[:, None] + np.arange(reach)
    overlap = np.minimum(high[:, None], bins + 1) - np.maximum(low[:, None], bins)
    fraction = overlap.clip(min=0) / np.where(spread, width, 1)[:, None]
    weight = np.where(spread[:, None], fraction, bins == first[:, None])
    keep = (weight > 1e-6) & (bins >= 0) & (bins < count)
    entries = weight[keep].astype(np.float32), (bins[keep], np.broadcast_to(pixels[:, None], bins.shape)[keep])
    return AxisBins(csr_matrix(entries, (count, pupil.size)), pupil)


def _sums(types: Any, values: Any, bins: AxisBins, index: Any, base: Any, stride: int, limit: Any = None) -> Any:
    """Return the summed values, `stride` apart, of each bin's pixels with squared pupil coordinates within a limit."""
    Float = types.Float
    UInt32 = types.UInt32
    start, pixel = (drjit_array(UInt32, array) for array in (bins.weights.indptr, bins.weights.indices))
    weight = drjit_array(Float, bins.weights.data)
    square = drjit_array(Float, bins.pupil[bins.weights.indices] ** 2)
    entry = dr.gather(UInt32, start, index)
    end = dr.gather(UInt32, start, index + 1)
    if limit is not None:
        # A row beyond the pupil's edge is dark whatever its columns.
        end = dr.select(limit >= 0, end, entry)

    def body(entry: Any, total: Any) -> Pair:
        inside = True if limit is None else dr.gather(Float, square, entry) <= limit
        value = dr.gather(Float, values, base + dr.gather(UInt32, pixel, entry) * stride, inside)
        return entry + 1, dr.fma(value, dr.gather(Float, weight, entry), total)

    return dr.while_loop((entry, Float(0)), lambda entry, total: entry < end, body)[1]
