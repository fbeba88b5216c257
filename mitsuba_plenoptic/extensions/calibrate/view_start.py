r"""Start values of a calibration from corners in views of an unfocused camera, and what is known beforehand.

Where y is the micro-image in whose view a corner is seen, in pixels from the principal point, and a the view's place
beside the micro-image's centre, :math:`y = y_0 + d a`. The central view, :math:`y_0 = -(b + z) X / (p g)`, is that of a
pinhole, whose distance follows from the perspective of tilted boards (Z. Zhang, "A flexible new technique for camera
calibration", 2000). Distances of corners then give the line

.. math:: d = -\frac{b + z}{z} (1 - \frac b f + \frac b g),

and its two coefficients f, b and z.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from ...camera import PlenopticCamera
from ...errors import refuse_if
from ...runtime import Array, Triple
from .adjustment import Problem, adjust, adjust_poses, both_axes, robust_lines
from .board_model import NAMES, PRINCIPAL
from .calibration_result import group_means
from .observations import Board, placed
from .start import first_numbers, thinned


def central_view(corner: Array, arm: Array, place: Array) -> Triple:
    """Return the corners that are seen, places in the central view with disparities, and rows that agree with these.

    A plane's disparity is linear over its picture. Shapes: `corner` (n,), the number of the row's corner; `arm`,
    `place` (n, 2) in pixels; the result (corners,), (corners, 3), (n,).
    """
    group = np.unique(corner, return_inverse=True)[1]
    moved, across = (values - group_means(values, group)[1][group] for values in (place, arm))
    line = np.column_stack([np.ones(len(place)), place / np.abs(place).max()])
    slope, _, agrees = robust_lines(across[:, :, None] * line[:, None], moved)
    disparity = line @ slope
    seen, group = np.unique(corner[agrees], return_inverse=True)
    central = np.column_stack([place - disparity[:, None] * arm, disparity])
    return seen, group_means(central[agrees], group)[1], agrees


def board_views(problem: Problem, frames: Array, principal: Array) -> tuple[list[Array], list[Array], Array]:
    """Return how boards are seen in the central view and how their corners move, with a mask of rows that agree.

    One item for each pose: the homography (3, 3) from the board to pixels from the principal point; and the places on
    the board in mm with their disparities in pixels a pixel, (corners, 3).
    """
    observed, grid = problem.corners, np.asarray(problem.grid)
    y = grid[0] + observed.lens @ grid[1:]
    arm = observed.pixel - y
    y = y - principal
    good = np.ones(len(y), bool)
    maps = []
    moving = []
    for pose, frame in enumerate(frames):
        rows = np.flatnonzero(observed.pose == pose)
        board, corner = np.unique(observed.board[rows], axis=0, return_inverse=True)
        refuse_if(len(board) < 9, f"frame {frame}: {len(board)} corners of the board are seen: 9 are needed at least")
        seen, central, good[rows] = central_view(corner.ravel(), arm[rows], y[rows])
        moving.append(np.column_stack([board[seen], central[:, 2]]))
        maps.append(_homography(board[seen], central[:, :2]))
        refuse_if(
            np.linalg.det(maps[-1]) <= 0,
            f"frame {frame}: the board is seen mirrored: number its corners as they are seen from its front, to "
            "the right and then down, in a picture that is not mirrored",
        )
    return maps, moving, good


def view_start(problem: Problem, board: Board, start: PlenopticCamera, frames: Array) -> Triple:
    """Return start values of camera and poses, and a mask of rows that agree with the others of their board.

    The result has the shape (17,), (poses, 6), (n,).
    """
    grid, size = np.asarray(problem.grid), problem.pixel_size
    principal = (np.array(start.crop_size) - 1) / 2
    refuse_if(len(frames) < 3, f"corners: {len(frames)} poses of the board: at least 3 are needed")
    maps, moving, good = board_views(problem, frames, principal)
    # Of columns h1 and h2 of a picture of a plane by a pinhole, (w h_x, w h_y, h_z) are at right angles and alike.
    first, second = np.transpose(maps, (2, 0, 1))[:2]
    products = np.concatenate([first * second, (first + second) * (first - second)])
    products /= np.tile(np.hypot(*first[:, :2].T) * np.hypot(*second[:, :2].T), 2)[:, None]
    along = products[:, :2].sum(1)
    square = -float(along @ products[:, 2] / (along @ along))
    nominal = start.mla_distance + start.detector_distance
    # Boards that face the camera leave it to the data sheet.
    sum_of_distances = size / np.sqrt(square) if 0.2 * square < (size / nominal) ** 2 < 5 * square else nominal
    poses = seen_poses(maps, sum_of_distances / size)
    pose = np.repeat(np.arange(len(poses)), [len(each) for each in moving])
    *place, disparity = np.concatenate(moving).T
    inverse = 1 / placed(np.transpose(place), poses, pose)[:, 2]
    refuse_if(
        np.ptp(inverse) < 0.01 * inverse.mean(),
        "corners: the board is at the same distance in all poses, which leaves the distances in the camera open: "
        "add poses nearer and farther",
    )
    slope, intercept = np.polyfit(inverse, disparity, 1)
    refuse_if(
        slope >= 0,
        "corners: they move from view to view against what nearer boards do: the pictures are mirrored, or the views "
        "counted from the other end",
    )
    b = -slope * sum_of_distances / (sum_of_distances - slope)
    z = sum_of_distances - b
    ratio = b / z * start.detector_distance / start.mla_distance
    refuse_if(
        not 0.1 < ratio < 10,
        f"corners: with squares of {board.square:g} mm the array would lie {b:.3g} mm behind the main lens and {z:.3g} "
        "mm before the detector: squares are in millimetres",
    )
    numbers = first_numbers(problem, (b / (1 + intercept * z / sum_of_distances), b, z), grid, principal)
    few = thinned(problem, good)
    fit = adjust(few, numbers, poses, ("focal_length", "detector_distance"), most_steps=60)
    return fit.numbers, adjust_poses(few, fit.numbers, fit.poses, np.ones(len(few.corners))), good


def known_beforehand(start: PlenopticCamera, noise: float) -> Array:
    """Return numbers that data may leave open, with the weights of differences from them, (2, 17).

    They are those of a camera without tilt and distortion whose axis meets the middle of the picture; `noise` is the
    deviation of a residual.
    """
    values = np.zeros(len(NAMES))
    values[PRINCIPAL] = (np.array(start.crop_size) - 1) / 2
    reach = float(np.hypot(*start.crop_size)) * start.pixel_size / 2
    weights = np.zeros(len(NAMES))
    # Deviations: degrees, parts of the picture's width, and parts of the distance from the axis at the corners.
    weights[8:] = 1 / np.array(
        [0.1, 0.1, *[0.02 * start.crop_size[0]] * 2, *(0.03 / reach ** np.array([2, 4, 6])), *[1e-3 / reach] * 2]
    )
    return np.stack([values, noise * weights])


def _homography(board: Array, place: Array) -> Array:
    """Return the matrix (3, 3) that maps positions on a plane to those in its picture."""
    rows = both_axes(np.column_stack([board, np.ones(len(board))]))
    rows = np.concatenate([rows, -place[:, :, None] * board[:, None]], axis=2)
    return np.append(robust_lines(rows, place)[0], 1.0).reshape(3, 3)


def seen_poses(maps: list[Array], focal: float) -> Array:
    """Return the poses (n, 6) of boards from their pictures' homographies by a pinhole, its focal length in pixels."""
    poses = []
    for matrix in maps:
        first, second, origin = (matrix / [[-focal], [-focal], [1.0]]).T
        size = np.sqrt(np.linalg.norm(first) * np.linalg.norm(second))
        axes = np.column_stack([first, second, np.cross(first, second) / size])
        # scipy finds the nearest rotation
        poses.append(np.append(Rotation.from_matrix(axes / size).as_rotvec(), origin / size))
    return np.array(poses)
