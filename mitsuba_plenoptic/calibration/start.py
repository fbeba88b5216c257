r"""Start values of a calibration from the data alone.

Through a lens at c a point whose image lies at q, the distance a before the microlens array, is seen at
:math:`p = c (1 + z/a) - q z / a`: linear in c, so that the lenses which see one corner tell z/a, and with it q. How far
the images q of a board's corners lie apart tells its magnification M, and as :math:`a = b - f (1 + M)`,

.. math:: a / z = (b - f) / z - (f / z) M

is a line over the poses, which tells b/f and z/f. The scale of all three comes from the perspective of tilted boards, by
a fit of few numbers.
"""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from .adjustment import Problem, adjust
from .model import AT, NAMES, Observations

FEWEST_POSES = 3
_FEWEST_CORNERS = 6
_THINNED = 300
"""Observations of each pose that the fit of the scale uses."""

_LEAST_SPREAD = 0.01
_WORST = 20.0
"""Pixels by which the start may miss the data."""


def start_values(
    seen: Observations, frames: np.ndarray, grid: np.ndarray, principal: tuple[float, float], problem: Problem
) -> tuple[np.ndarray, np.ndarray]:
    """Find numbers from which a fit finds its way.

    Parameters
    ----------
    seen : Observations
        Corners.
    frames : array
        The poses' names for messages.
    grid : (3, 2) array
        Pixel of the micro-image of lens (0, 0), and the steps along the rows and across them.
    principal : (float, float)
        Pixel taken for the axis.
    problem : Problem
        For its pixel size and row ratio.

    Returns
    -------
    numbers : (17,) array
    poses : (poses, 6) array

    Raises
    ------
    InputError
        If there are too few poses or corners, all at one depth, or boards that are seen mirrored.
    """
    count = seen.poses
    if count < FEWEST_POSES:
        raise InputError(f"corners: {count} poses of the board: at least {FEWEST_POSES} are needed")
    size, ratio = problem.pixel_size, problem.row_ratio
    centre = grid[0] + seen.lens @ grid[1:] - principal
    pixel = seen.pixel - principal
    slopes, maps = np.empty(count), np.empty((count, 3, 2))
    for pose in range(count):
        mine = np.flatnonzero(seen.pose == pose)
        corners, which = np.unique(seen.board[mine], axis=0, return_inverse=True)
        if len(corners) < _FEWEST_CORNERS or np.linalg.matrix_rank(corners - corners[0]) < 2:
            raise InputError(f"frame {frames[pose]}: {len(corners)} corners of the board: at least {_FEWEST_CORNERS}, "
                             "not all on one line, are needed")  # fmt: skip
        spread, moved = (
            values[mine] - (_sums(values[mine], which, len(corners)) / np.bincount(which)[:, None])[which]
            for values in (centre, pixel)
        )
        if not (spread**2).sum() > 0:
            raise InputError(f"frame {frames[pose]}: each corner is seen through one lens only; several are needed")
        slopes[pose] = (spread * moved).sum() / (spread**2).sum() - 1
        image = (centre[mine] * (1 + slopes[pose]) - pixel[mine]) / slopes[pose] * size
        maps[pose] = np.linalg.lstsq(np.column_stack([np.ones(len(mine)), seen.board[mine]]), image)[0]
        if np.linalg.det(maps[pose, 1:]) < 0:
            raise InputError(
                f"frame {frames[pose]}: the board is seen mirrored: number its corners as they are seen from its "
                "front, to the right and then down, in a picture that is not mirrored"
            )
    magnification = np.sqrt(np.linalg.det(maps[:, 1:]))
    if np.ptp(magnification) < _LEAST_SPREAD * magnification.mean():
        raise InputError(
            "corners: the board is at the same distance in all poses, which leaves the distances in the camera open: "
            "add poses nearer and farther"
        )
    line = np.polyfit(magnification, 1 / slopes, 1, w=np.sqrt(np.bincount(seen.pose)))
    per_z, less = -line[0], line[1]
    if not (per_z > 0 and less > 0):
        raise InputError(
            "corners: they move from lens to lens as in no plenoptic camera: check lens indices and the order of corners"
        )
    f = 1.0
    b, z = f * (1 + less / per_z), f / per_z
    # The diagonal of what the lenses cover is the right order; the fit below finds the scale.
    f *= size * float(np.hypot(*np.ptp(seen.pixel, axis=0))) * 2
    b, z = b * f, z * f
    pitch = np.hypot(*grid[1:].T) * size / (1 + z / b) / [1, ratio]
    numbers = np.zeros(len(NAMES))
    numbers[:3] = f, b, z
    numbers[[AT["pitch_along"], AT["pitch_across"]]] = pitch
    numbers[AT["mla_rotation"]] = np.rad2deg(np.arctan2(grid[1, 1], grid[1, 0]))
    numbers[[AT["offset_x"], AT["offset_y"]]] = (grid[0] - principal) * size / (1 + z / b)
    numbers[[AT["principal_u"], AT["principal_v"]]] = principal
    poses = np.zeros((count, 6))
    for pose, (place, *steps) in enumerate(maps):
        mag = magnification[pose]
        turn = -np.arctan2(steps[0][1] - steps[1][0], steps[0][0] + steps[1][1])
        poses[pose, 2] = np.pi - turn
        poses[pose, 3:] = *(-place / mag), f * (1 + 1 / mag)
    chosen = np.concatenate([np.flatnonzero(seen.pose == pose)[:: _every(seen.pose, pose)] for pose in range(count)])
    few = Observations(seen.lens[chosen], seen.pixel[chosen], seen.board[chosen], seen.pose[chosen])
    found = adjust(Problem(few, size, ratio), numbers, poses, NAMES[:3], most_steps=50)
    error = np.sqrt(2 * found.cost / len(few))
    if not error < _WORST:
        raise InputError(
            f"corners: start values miss them by {error:.3g} pixels: check the board's size, the pixel size and the "
            "order of corners"
        )
    return found.numbers, found.poses


def _sums(values: np.ndarray, which: np.ndarray, count: int) -> np.ndarray:
    return np.stack([np.bincount(which, column, count) for column in values.T], axis=-1)


def _every(pose: np.ndarray, index: int) -> int:
    return max(1, int((pose == index).sum()) // _THINNED)
