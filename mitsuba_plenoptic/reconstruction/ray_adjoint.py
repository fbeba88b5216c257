"""The transpose of the sums over bins by one ray a pixel: from bins back to the pixels that have been summed there."""

from __future__ import annotations

import numpy as np
import scipy.fft

from ..camera import PlenopticCamera
from .binning import AxisBins
from .ray_sums import aligned_axes
from .splatting import Splat


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
