"""Sums over bins by one ray a pixel, of a capture and of white: what the ray method divides, and who reaches what."""

from __future__ import annotations

import functools

import numpy as np
import scipy.fft

from ..camera import PlenopticCamera
from ..design import focus_type, lens_footprint, pixel_footprint
from ..errors import InputError
from ..lightfield.white import white_image
from ..optics import rays
from .binning import AxisBins, axis_bins, bin_image
from .real_lens import traced_white
from .splatting import Splat, splat

# Dr.Jit counts in 32 bits.
_MOST_VALUES = 2**32 - 1


def ray_sums(
    image: np.ndarray, camera: PlenopticCamera, distance: float, radius: float, footprint: str, oversample: int
) -> np.ndarray:
    """Follow one ray a pixel back to the object plane and sum the pixels that go to each bin.

    Where pixels and bins are arranged alike, on an upright square lattice without gaps of unfocused lenses behind a
    thin main lens, this is done one axis at a time.

    Parameters
    ----------
    image : (rows, columns, channels) float32 array
        The capture.
    camera : PlenopticCamera
        The camera.
    distance : float
        Object distance; may be infinite.
    radius : float
        Pupil radius: pixels whose ray misses it are left out.
    footprint : {"lens", "point"}
        Whether a pixel is spread over what its whole lens sees, or goes to one bin.
    oversample : int
        Bins per lens pitch.

    Returns
    -------
    (rows, columns, channels) array
        Sum of the pixels by bin.
    """
    axes = aligned_axes(camera, distance, radius, footprint, oversample)
    if axes is None:
        return splat(image, camera, distance, radius, footprint=footprint, oversample=oversample)
    x, y = axes
    values = image.shape[2] * x.count * max(y.count, image.shape[0])
    if values > _MOST_VALUES:
        raise InputError(
            f"images of {x.count} x {y.count} bins: {values} values are summed at once, at most {_MOST_VALUES} can be"
        )
    return bin_image(image, x, y, radius)


def aligned_axes(
    camera: PlenopticCamera, distance: float, radius: float, footprint: str, oversample: int
) -> tuple[AxisBins, AxisBins] | None:
    """Return where the pixels of each axis go, if pixels and bins are arranged alike; None where they are not."""
    if not camera.lens_data.is_thin or focus_type(camera) != "unfocused" or not camera.lenses_like_bins:
        return None
    x, y = (_axis(camera, distance, radius, axis, footprint, oversample) for axis in (0, 1))
    return x, y


@functools.lru_cache(maxsize=32)
def white_sums(camera: PlenopticCamera, distance: float, radius: float, footprint: str, oversample: int) -> np.ndarray:
    """Return `ray_sums` of what the camera records of a scene of uniform radiance 1; (rows, columns) float64 array."""
    white = white_pixels(camera)[..., None]
    return ray_sums(white, camera, distance, radius, footprint, oversample)[..., 0].astype(np.float64)


@functools.lru_cache(maxsize=1)
def white_pixels(camera: PlenopticCamera) -> np.ndarray:
    """Return the camera's white image; the last one is kept, for the next distance."""
    return white_image(camera) if camera.lens_data.is_thin else traced_white(camera)


def _axis(
    camera: PlenopticCamera, distance: float, radius: float, axis: int, footprint: str, oversample: int
) -> AxisBins:
    """Where the pixels of one axis go, in bins, and where they meet the pupil."""
    count = camera.bin_count[axis] * oversample
    p = camera.pixel_coordinates(axis)
    chief = rays.chief_point(p, camera.mla_distance, camera.detector_distance)
    c = camera.lattice.axis_centre(camera.lattice.axis_cell(chief, axis), axis)

    pupil, place = rays.follow_back(p, c, c, distance, camera)
    centre = place * (oversample / camera.mla_pitch) + count / 2
    if footprint == "point":
        return axis_bins(centre, centre, pupil, count, radius)
    width = max(
        camera.mla_pitch * lens_footprint(camera, distance, camera.mla_focal_length), pixel_footprint(camera, distance)
    )
    half = width / 2 * oversample / camera.mla_pitch
    return axis_bins(centre - half, centre + half, pupil, count, radius)


def ray_sums_back(
    bins: np.ndarray, camera: PlenopticCamera, distance: float, radius: float, footprint: str, oversample: int
) -> np.ndarray:
    """Apply the transpose of `ray_sums`.

    Parameters
    ----------
    bins : (rows, columns, channels) array
        One value for each bin.
    camera, distance, radius, footprint, oversample
        As of `ray_sums`.

    Returns
    -------
    (rows, columns, channels) float64 array
        Of the pixels.
    """
    axes = aligned_axes(camera, distance, radius, footprint, oversample)
    if axes is not None:
        return _from_axes(bins, *axes, radius)
    return _from_splat(bins, Splat.of(camera, distance, radius, footprint, oversample, bins.shape[2]), camera.shape)


def _from_axes(bins: np.ndarray, x: AxisBins, y: AxisBins, radius: float) -> np.ndarray:
    """Apply the transpose of `binning.bin_image`."""
    given = np.asarray(bins, np.float64)
    pixels = np.einsum("jic,jr->ric", given, _matrix(y), optimize=True)
    pixels = np.einsum("ric,ip->rpc", pixels, _matrix(x), optimize=True)
    # In the precision in which the sums compare them.
    limit, square = (radius**2 - y.pupil**2).astype(np.float32), (x.pupil**2).astype(np.float32)
    return np.where((square <= limit[:, None])[..., None], pixels, 0.0)


def _matrix(axis: AxisBins) -> np.ndarray:
    """Return the weights (bins, pixels) of one axis."""
    matrix = np.zeros((axis.count, axis.pupil.size))
    bin_of = np.searchsorted(axis.start, np.arange(axis.pixel.size), side="right") - 1
    matrix[bin_of, axis.pixel] = axis.weight
    return matrix


def _from_splat(bins: np.ndarray, splat: Splat, shape: tuple[int, int]) -> np.ndarray:
    """Apply the transpose of `splatting.splat`."""
    margin = splat.margin
    padded = np.pad(np.asarray(bins, np.float64), ((2 * margin,) * 2, (2 * margin,) * 2, (0, 0)))
    result = np.zeros((shape[0] * shape[1], bins.shape[2]))
    for mine, taps in splat.types():
        reach = taps.shape[0] // 2
        first = margin - reach
        down, across = splat.size
        for channel in range(bins.shape[2]):
            window = padded[first : first + down + 2 * reach, first : first + across + 2 * reach, channel]
            result[splat.pixel[mine], channel] = _gather(window, taps).reshape(-1)[splat.place[mine]]
    return result.reshape(*shape, -1)


def _gather(window: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    """Apply the transpose of `splatting.spread`: (rows + taps - 1, columns + taps - 1) to (rows, columns, fine**2)."""
    taps = footprint.shape[0]
    kernels = footprint.reshape(taps, taps, -1)
    rows, columns = window.shape[0] - taps + 1, window.shape[1] - taps + 1
    spectrum = scipy.fft.rfft2(window)
    # A correlation of the window with each kernel; what wraps lies beyond the rows and columns that are kept.
    return np.stack(
        [
            scipy.fft.irfft2(spectrum * scipy.fft.rfft2(kernels[..., fine], window.shape).conj(), window.shape)[
                :rows, :columns
            ]
            for fine in range(kernels.shape[2])
        ],
        axis=-1,
    )
