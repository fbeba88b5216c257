"""Pictures of volumes: maximum projections, orthogonal slices, and depth as colour."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from numpy.typing import NDArray

from ..io.pictures import linear_of
from ..refocus.results import Volume
from .images import write_png

_GAP = 4
"""Black pixels between the parts of a picture."""

_DARK_ENDS = 0.1
"""Part of the colours at each end that is too dark to be seen."""

_LEAST_PLANE = 3
"""Pixels of a plane, at least, where planes are seen from the side."""


def depth_coded(volume: Volume) -> NDArray[np.float32]:
    """Return a picture of a volume: its brightness is the maximum along z, its colour shows the maximum's depth.

    Colours run from blue for the nearest plane to red for the farthest.

    Parameters
    ----------
    volume : Volume
        The volume.

    Returns
    -------
    float32 array (rows, columns, 3)
        Linear sRGB, in units of the volume.
    """
    grey = np.nan_to_num(volume.values if volume.values.ndim == 3 else volume.values.mean(-1), nan=0.0)
    near, far = volume.distances[0], volume.distances[-1]
    depth = (np.array(volume.distances) - near) / ((far - near) or 1)
    encoded = matplotlib.colormaps["turbo"](_DARK_ENDS + (1 - 2 * _DARK_ENDS) * depth)[:, :3]
    found = linear_of(encoded)[grey.argmax(axis=0)] * np.maximum(grey.max(axis=0), 0)[..., None]
    return np.asarray(found, np.float32)


def volume_overview(volume: Volume) -> NDArray[np.float32]:
    """Return an overview image of a volume: maximum projections, slices, and depth as colour.

    The first two parts show the view along z, with the view along x to its right and the view along y below. Distances
    between planes are true, but at least three pixels; slices go through the brightest voxel.

    Parameters
    ----------
    volume : Volume
        The volume.

    Returns
    -------
    float32 array (rows, columns, 3)
        Linear, in units of the volume; black between the parts.
    """
    projections = volume.maximum("z"), volume.maximum("y"), volume.maximum("x")
    parts = [_orthogonal(volume, *projections), _orthogonal(volume, *volume.slices()), depth_coded(volume)]
    rows, gap = max(len(part) for part in parts), np.zeros((1, _GAP, 3), np.float32)
    padded = [np.pad(part, ((0, rows - len(part)), (0, 0), (0, 0))) for part in parts]
    gap = np.repeat(gap, rows, axis=0)
    return np.concatenate([padded[0], gap, padded[1], gap, padded[2]], axis=1)


def write_volume_overview(path: str | Path, volume: Volume, peak: float | None = None) -> None:
    """Write `volume_overview` as an 8-bit PNG.

    Parameters
    ----------
    path : path
        File to write.
    volume : Volume
        The volume.
    peak : float, optional
        Value shown as white. Default: the brightest voxel.
    """
    write_png(path, volume_overview(volume), peak=peak)


def _orthogonal(
    volume: Volume, front: NDArray[np.float32], above: NDArray[np.float32], side: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return a picture of the view along z, with the view along x to its right and the view along y below."""
    front, above, side = (np.nan_to_num(part) for part in (front, above, side))
    if volume.values.ndim < 4:
        front, above, side = (np.repeat(part[..., None], 3, axis=-1) for part in (front, above, side))
    repeats = _plane_pixels(volume)
    above, side = above.repeat(repeats, axis=0), side.repeat(repeats, axis=0).swapaxes(0, 1)
    rows, columns = front.shape[:2]
    picture = np.zeros((rows + _GAP + len(above), columns + _GAP + side.shape[1], 3), np.float32)
    picture[:rows, :columns] = front
    picture[rows + _GAP :, :columns] = above
    picture[:rows, columns + _GAP :] = side
    return picture


def _plane_pixels(volume: Volume) -> NDArray[np.int64]:
    """Return the number of pixels of each plane along z, up to halfway to the neighbouring planes."""
    depths = np.array(volume.distances)
    if len(depths) == 1:
        return np.array([_LEAST_PLANE])
    middles = (depths[1:] + depths[:-1]) / 2
    borders = np.concatenate([[2 * depths[0] - middles[0]], middles, [2 * depths[-1] - middles[-1]]])
    widths = np.diff(borders)
    # At their true widths where these fill half the picture at most.
    scale = min(1 / volume.voxel_size, 0.5 * volume.values.shape[2] / widths.sum())
    return np.maximum(_LEAST_PLANE, np.rint(widths * scale)).astype(np.int64)
