"""Residuals of a calibration by lens, field, depth and pose: where a camera misses what was observed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import require_choice, require_count
from .fit import Calibration
from .model import predict_centres
from .numbers import numbers_of
from .observations import Board, Table, placed

GROUPED_BY = {
    "lens": ("k", "l", "u", "v"),
    "field": ("u", "v"),
    "depth": ("nearest", "farthest"),
    "pose": ("frame",),
}
"""What residuals are grouped by, and the columns that tell each group."""


@dataclass(frozen=True)
class ResidualMap:
    """Residuals of groups of observations: arrays of one row for each group.

    Attributes
    ----------
    by : str
        What they have in common, of `GROUPED_BY`.
    key : (groups, columns) array
        Which group it is, with the columns that `GROUPED_BY` names. ``lens``: indices as the data have them, and where
        the camera has the centre of the micro-image, in pixels; ``field``: middle of a square of the detector, in
        pixels; ``depth``: least and greatest distance of the corners, in mm; ``pose``: number of the frame.
    count : (groups,) int array
        Observations in it.
    mean : (groups, 2) array
        Mean of observed minus predicted places, in pixels.
    error : (groups,) array
        RMS of the distances between them, in pixels.
    """

    by: str
    key: np.ndarray
    count: np.ndarray
    mean: np.ndarray
    error: np.ndarray


def residual_map(calibration: Calibration, board: Board, corners: Table, by: str, parts: int = 6) -> ResidualMap:
    """Group the residuals of a calibration's corners.

    Parameters
    ----------
    calibration : Calibration
        What was found.
    board : Board
        The board that was seen.
    corners : Table
        The corners that it was found from.
    by : {"lens", "field", "depth", "pose"}
        What the observations of a group have in common.
    parts : int
        Squares along the detector's rows, of ``field``; ranges with as many observations each, of ``depth``.

    Raises
    ------
    InputError
        If `by` is none of these, or `parts` is not from 1 to 1000.
    """
    require_choice("by", by, GROUPED_BY)
    require_count("parts", parts, minimum=1, maximum=1000)
    seen, camera = calibration.evaluation, calibration.camera
    if by == "lens":
        lenses, group = np.unique(np.stack([corners["k"], corners["l"]], axis=-1), axis=0, return_inverse=True)
        unit = calibration.index.unit(*lenses.T)
        geometry = {"pixel_size": camera.pixel_size, "row_ratio": camera.lattice.row_ratio}
        key = np.concatenate([lenses, predict_centres(numbers_of(camera), unit, **geometry)[0]], axis=1)
    elif by == "field":
        key, group = field_cells(corners.pixel, camera.crop_size[0] / parts)
    elif by == "depth":
        depth = placed(board.places(corners["cluster"]), seen.poses, seen.pose)[:, 2]
        group = np.empty(len(depth), dtype=int)
        ranges = [part for part in np.array_split(np.argsort(depth, kind="stable"), parts) if len(part)]
        for number, part in enumerate(ranges):
            group[part] = number
        key = np.array([depth[part[[0, -1]]] for part in ranges])
    else:
        key, group = seen.frames[:, None], seen.pose
    count, mean = group_means(-seen.residuals, group.ravel())
    square = np.bincount(group.ravel(), (seen.residuals**2).sum(1)) / count
    return ResidualMap(by, key.astype(float), count, mean, np.sqrt(square))


def field_cells(pixel: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the middles of the squares of this side, in pixels, that places (n, 2) are in, and which each is in."""
    cell, group = np.unique(np.floor((pixel + 0.5) / side), axis=0, return_inverse=True)
    return (cell + 0.5) * side - 0.5, group.ravel()


def group_means(values: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how many rows each group has, and their mean."""
    count = np.bincount(group)
    return count, np.stack([np.bincount(group, column) for column in values.T], axis=-1) / count[:, None]
