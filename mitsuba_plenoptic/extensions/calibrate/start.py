r"""Start values of a calibration from the data alone.

Through a lens at c, a point whose image lies at q, the distance a before the microlens array, is seen at :math:`p = c
(1 + z/a) - q z / a`. This is linear in c, so that the lenses that see one corner determine z/a, and with it q. The
distances between the images q of a board's corners give the magnification M, and as :math:`a = b - f (1 + M)`,

.. math:: a / z = (b - f) / z - (f / z) M

is a line over the poses, which gives b/f and z/f. The scale of b, f and z comes from the perspective of tilted boards,
by a fit of few numbers.

Rows that disagree with most rows of their frame are left out.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...errors import InputError, refuse_if
from ...runtime import Array, Triple
from .adjustment import Problem, adjust, adjust_poses, both_axes, robust_lines
from .board_model import AT, NAMES, OFFSET, PRINCIPAL, Observations
from .calibration_result import group_means
from .observations import Board

# Observations of each pose that the fit of the scale uses.
_THINNED = 300

# The part of a frame's rows that must agree with a board.
_AGREEING = 0.7


def start_values(problem: Problem, board: Board, frames: Array, grid: Array, principal: Array) -> Triple:
    """Return start values from which a fit of camera and poses converges.

    Shapes: `grid` (3, 2), `principal` (2,); the result (17,), (poses, 6), (n,).
    """
    observed = problem.corners
    size = problem.pixel_size
    refuse_if(observed.poses < 3, f"corners: {observed.poses} poses of the board: at least 3 are needed")
    slopes, maps, good = board_images(problem, board, frames, grid, principal)
    magnification = np.sqrt(np.linalg.det(maps[:, 1:]))
    # Magnifications that differ by less leave the distances in the camera open.
    refuse_if(
        np.ptp(magnification) < 0.01 * magnification.mean(),
        "corners: the board is at the same distance in all poses, which leaves the distances in the camera open: "
        "add poses nearer and farther",
    )
    per_z, less = np.polyfit(magnification, 1 / slopes, 1, w=np.sqrt(np.bincount(observed.pose[good]))) * [-1, 1]
    refuse_if(
        not (per_z > 0 and less > -per_z),
        "corners: they move from lens to lens as in no plenoptic camera: check lens indices, the corners' order, "
        "and that frames differ where the board was moved",
    )
    # What the corners cover on the detector is the right order; the fit below finds the scale.
    f = 2 * size * float(np.hypot(*np.ptp(observed.pixel, axis=0)))
    b = f * (1 + less / per_z)
    z = f / per_z
    numbers = first_numbers(problem, (f, b, z), grid, principal)
    few = thinned(problem, good)
    try:
        fit = adjust(few, numbers, upright_poses(maps, f), NAMES[:3], most_steps=60)
        ones = np.ones(len(few.corners))
        fit = adjust(few, fit.numbers, adjust_poses(few, fit.numbers, fit.poses, ones), NAMES[:3])
        error = np.sqrt(2 * fit.cost / len(ones))
        failure = "" if error < 20.0 else f"start values miss the corners by {error:.3g} pixels"
    except InputError:
        failure = "no camera sees the whole board in all poses"
    if failure:
        raise InputError(
            f"corners: {failure}: the lens's images of the boards are {magnification.min():.3g} to "
            f"{magnification.max():.3g} times as large as boards with squares of this size: check the distance of the "
            "board's corners, the pixel size and the order of corners"
        )
    return fit.numbers, fit.poses, good


def first_numbers(problem: Problem, lengths: Sequence[float], grid: Array, principal: Array) -> Array:
    """Return the numbers (17,) of a camera without tilt and distortion, from f, b and z and its lenses' places."""
    numbers = np.zeros(len(NAMES))
    numbers[:3] = lengths
    shrunk = problem.pixel_size / (1 + numbers[2] / numbers[1])
    numbers[3:5] = np.hypot(*grid[1:].T) * shrunk / [1, problem.row_ratio]
    numbers[AT["mla_rotation"]] = np.rad2deg(np.arctan2(grid[1, 1], grid[1, 0]))
    numbers[OFFSET] = (grid[0] - principal) * shrunk
    numbers[PRINCIPAL] = principal
    return numbers


def thinned(problem: Problem, good: Array) -> Problem:
    """Return a problem with some of each pose's good rows."""
    observed = problem.corners
    groups = [np.flatnonzero(good & (observed.pose == pose)) for pose in range(observed.poses)]
    chosen = np.concatenate([group[:: max(1, len(group) // _THINNED)] for group in groups])
    return replace(problem, corners=observed.keep(chosen))


def board_images(problem: Problem, board: Board, frames: Array, grid: Array, principal: Array) -> Triple:
    """Return the image of each board by the main lens, found from the shifts of its corners from lens to lens.

    The result has the shape (poses,), (poses, 3, 2), (n,).
    """
    observed = problem.corners
    size = problem.pixel_size
    slopes = np.empty(observed.poses)
    maps = np.empty((observed.poses, 3, 2))
    centre = grid[0] + observed.lens @ grid[1:] - principal
    pixel = observed.pixel - principal
    good = _agreeing(observed, board, centre, pixel, frames, float(np.hypot(*grid[1])))
    for pose, frame in enumerate(frames):
        rows = good & (observed.pose == pose)
        corners, corner_index = np.unique(observed.board[rows], axis=0, return_inverse=True)
        corner_index = corner_index.ravel()
        refuse_if(
            len(corners) < 6 or np.linalg.matrix_rank(corners - corners[0]) < 2,
            f"frame {frame}: {len(corners)} corners of the board are seen: 6 are needed at least, not all on one line",
        )
        centres = centre[rows]
        pixels = pixel[rows]
        around, displaced = (
            values - group_means(values, corner_index)[1][corner_index] for values in (centres, pixels)
        )
        refuse_if(
            not (around**2).sum() > 0, f"frame {frame}: each corner is seen through one lens only; several are needed"
        )
        slope = (around * displaced).sum() / (around**2).sum() - 1
        image = (centres * (1 + slope) - pixels) * (size / slope)
        slopes[pose] = slope
        maps[pose] = np.linalg.lstsq(np.column_stack([np.ones(len(image)), observed.board[rows]]), image)[0]
        refuse_if(
            np.linalg.det(maps[pose, 1:]) <= 0,
            f"frame {frame}: the board is seen mirrored: number its corners as they are seen from its front, to "
            "the right and then down, in a picture that is not mirrored",
        )
    return slopes, maps, good


def _agreeing(observed: Observations, board: Board, centre: Array, pixel: Array, frames: Array, pitch: float) -> Array:
    """Return a mask of rows in their micro-image that agree with most of their frame; refuse disagreeing frames."""
    near = np.hypot(*(pixel - centre).T) < pitch
    good = near.copy()
    strange = []
    for pose, frame in enumerate(frames):
        rows = np.flatnonzero(near & (observed.pose == pose))
        count = int((observed.pose == pose).sum())
        refuse_if(
            len(rows) < _AGREEING * count,
            f"frame {frame}: {count - len(rows)} of its {count} rows lie farther than a lens's width from the "
            "micro-image of the lens that k and l name: correct or remove the frame",
        )
        good[rows] = _board_fit(observed.board[rows], centre[rows], pixel[rows])
        if not good[rows].any():
            strange.append(pose)
    if strange:
        # The number of corners along a row that most rows of the largest such frame agree with.
        largest = max(strange, key=np.bincount(observed.pose[near]).__getitem__)
        rows = np.flatnonzero(near & (observed.pose == largest))
        rows = rows[:: max(1, len(rows) // _THINNED)]
        column, row = np.round(observed.board[rows] / board.square).astype(int).T
        corner_number = row * board.columns + column
        fits = {
            columns: _board_fit(Board(columns, 1000, 1.0).places(corner_number), centre[rows], pixel[rows]).mean()
            for columns in range(2, corner_number.max() // 2 + 2)
        }
        along = max(fits, key=fits.__getitem__, default=0)
        refuse_if(
            not fits.get(along) and 2 * len(strange) <= observed.poses,
            f"frame {frames[strange[0]]}: most of its corners do not lie as on a board, as those of other frames "
            "do: correct or remove the frame",
        )
        raise InputError(
            f"corners: in {len(strange)} of {observed.poses} frames they do not lie as on a board of {board.columns}x"
            f"{board.rows} inner corners: "
            + (f"they do on one with {along} along each row" if fits.get(along) else "check how they are numbered")
        )
    return good


def _board_fit(board: Array, centre: Array, pixel: Array) -> Array:
    """Return a mask of the observed corners that agree with a flat board; none do if it does not explain most.

    Over a tilted board z/a changes linearly, and z q/a as a square of the position on the board. The lenses that see a
    corner surround its position; a wrong corner far from there would bend z/a by its distance alone.
    """
    x, y = (board / max(np.abs(board).max(), 1e-9)).T
    ones = np.ones(len(x))
    images = both_axes(np.column_stack([ones, x, y, x * x, x * y, y * y]))
    slopes = centre[:, :, None] * np.column_stack([ones, x, y])[:, None]
    good = robust_lines(images, centre)[2]
    _, distance, agrees = robust_lines(np.concatenate([slopes, images], axis=2)[good], pixel[good])
    good[good] = agrees
    # Wrongly numbered corners lie as far from the board as from the centres of their micro-images.
    explained = np.median(distance) < 0.35 * np.median(np.hypot(*(pixel - centre).T))
    return good & (explained and good.mean() > _AGREEING)


def upright_poses(maps: Array, focal_length: float) -> Array:
    """Return poses (n, 6) of boards that face the camera, from their images by a thin lens."""
    poses = np.zeros((len(maps), 6))
    for pose, (corner, along, across) in zip(poses, maps, strict=True):
        magnification = np.sqrt(np.linalg.det([along, across]))
        # The image is turned by half a turn. Rotations of nearly a whole turn would hold fits fast.
        pose[2] = np.arctan2(across[0] - along[1], -along[0] - across[1])
        pose[3:] = *(-corner / magnification), focal_length * (1 + 1 / magnification)
    return poses
