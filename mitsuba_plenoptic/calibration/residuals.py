"""Residuals of a calibration by lens, field, depth and pose: where a camera misses what was observed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from ..errors import require_choice, require_count
from .adjustment import Problem, Solution
from .fit import Calibration
from .model import NAMES, predict_centres
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


# A disagreement that independent residuals exceed this rarely is taken for the model's misfit.
_CHANCE = 1e-3

# Degrees of freedom from which on a frame's own scatter is well known.
_MANY = 100


@dataclass(frozen=True)
class Deviations:
    """How well the numbers are known."""

    # Of the numbers' errors; (17, 17).
    covariance: np.ndarray
    # By how much the frames disagree about the numbers, over what their residuals' scatter explains.
    disagreement: float
    # Whether that is more than chance allows, so that the covariance is that of leaving out frames.
    by_frames: bool

    @property
    def values(self) -> np.ndarray:
        """Standard deviations, (17,)."""
        return np.sqrt(np.diag(self.covariance))


def deviations(problem: Problem, found: Solution, weights: np.ndarray) -> Deviations:
    """Return how well a fit's numbers are known, all of them free.

    Shapes: `weights` (n,).
    """
    count = len(NAMES)
    _, parts = problem.blocks(found.numbers, found.poses, weights, np.arange(count))
    rows = np.concatenate(parts)
    scale = np.sqrt((rows[:, :count] ** 2).sum(0))
    parts = [part / np.append(scale, 1.0) for part in parts]
    used = 2 * np.bincount(problem.corners.pose, weights > 0)
    squares = (weights[:, None] * problem.residuals(found.numbers, found.poses) ** 2).sum()
    variance = float(squares) / max(1, used.sum() - count - found.poses.size)
    inverse = np.linalg.pinv(np.linalg.qr(np.concatenate(parts)[:, :count], mode="r"))
    covariance = variance * inverse @ inverse.T
    frames = len(used)
    moved, freedom = 0.0, -count
    for part, values in zip(parts, used, strict=False):
        # The triangle's last column: what the numbers can take of the frame's residuals, and what is left of them.
        own = int(values) - found.poses.shape[1] - count
        if own > 0:
            scatter = float(part[count, -1] ** 2) / own
            moved += float((part[:count, -1] ** 2).sum()) / (scatter if own > _MANY else max(scatter, variance))
            freedom += count
    disagreement = max(1.0, moved / freedom) if freedom > 0 else 1.0
    by_frames = freedom > 0 and disagreement > chi2.ppf(1 - _CHANCE, freedom) / freedom
    if by_frames:
        others = [np.concatenate(parts[:g] + parts[g + 1 :]) for g in range(frames)]
        without = np.array([np.linalg.lstsq(each[:, :count], each[:, -1])[0] for each in others])
        without -= without.mean(0)
        # From few frames the variance itself is uncertain, and errors over it follow Student's distribution.
        student = (frames - 1) / max(frames - 3, 0.5)
        covariance = covariance + student * (frames - 1) / frames * without.T @ without
    else:
        covariance = covariance * disagreement
    return Deviations(covariance / np.outer(scale, scale), float(np.sqrt(disagreement)), bool(by_frames))


def moved_solutions(problem: Problem, found: Solution, weights: np.ndarray, covariance: np.ndarray) -> list[Solution]:
    """Return solutions a standard deviation away along each independent combination of numbers, the poses refitted.

    The squared changes of anything else that follows from numbers and poses add up to its variance.
    """
    heads, _ = problem.blocks(found.numbers, found.poses, weights, np.arange(len(NAMES)))
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    moved = []
    for step in (vectors * np.sqrt(values.clip(0))).T * scale:
        poses = [-np.linalg.solve(head[:, :6], head[:, 6:-1] @ step) for head in heads]
        moved.append(Solution(found.numbers + step, found.poses + poses, found.cost, 0))
    return moved
