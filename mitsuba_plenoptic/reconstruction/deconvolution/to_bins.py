"""From the bins of cells to the upright bins of a reconstruction."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...lattice import turn
from ...optics.fitted_lens import FittedLens
from ...optics.image_stretch import image_stretch
from .cells import Cells, CellSet

_ALIGNED = 1e-6
"""Fraction of a bin by which places may differ that are one."""


def to_bins(
    values: NDArray[np.float32], cells: Cells, lit: CellSet, camera: PlenopticCamera, distance: float, oversample: int
) -> NDArray[np.float32]:
    """Interpolate between the centres of bins; where the two grids are one, nothing changes.

    Behind a real main lens cells are places of chief rays on the array, and its distortion is undone.

    Parameters
    ----------
    values : float32 array (cells, bins)
        Of the cells of `lit`; beyond them it is zero.
    cells : Cells
        How the bins are gathered.
    lit : CellSet
        The cells.
    camera : PlenopticCamera
        The camera in its own frame.
    distance : float
        Of the object plane; may be infinite.
    oversample : int
        Bins of the reconstruction per lens pitch.

    Returns
    -------
    float32 array (rows, columns)
    """
    pitch = camera.mla_pitch / oversample
    x, y = ((np.arange(count * oversample) - (count * oversample - 1) / 2) * pitch for count in camera.bin_count)
    x, y = np.broadcast_arrays(x, y[:, None])
    if isinstance(cells.grid.lens, FittedLens):
        stretch = image_stretch(camera, cells.grid.lens, distance)
        ratio = np.interp(np.hypot(x, y), stretch.places, stretch.ratio)
        x, y = x * ratio, y * ratio
    u, v = turn(x, y, -camera.mla_rotation)
    across, down = cells.bins
    width, height = cells.bin_sizes
    padded = np.append(values.ravel(), np.float32(0))
    result = np.zeros(u.shape)
    row = _snapped(v / height - 0.5)
    low = np.floor(row).astype(np.int64)
    for line, share in ((low, 1 - (row - low)), (low + 1, row - low)):
        J = line // down
        column = _snapped((u - J * cells.vectors[1, 0]) / width - 0.5)
        left = np.floor(column).astype(np.int64)
        for k, part in ((left, 1 - (column - left)), (left + 1, column - left)):
            cell = lit.find(np.stack([k // across, J], axis=-1))
            place = (cell * down + line % down) * across + k % across
            result += share * part * padded[np.minimum(place, len(padded) - 1)]
    return result.astype(np.float32)


def _snapped(place: NDArray[np.float64]) -> NDArray[np.float64]:
    whole = np.rint(place)
    return np.asarray(np.where(np.abs(place - whole) < _ALIGNED, whole, place))
