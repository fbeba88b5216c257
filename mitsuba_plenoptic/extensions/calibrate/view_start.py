r"""Start values of a calibration from corners in views of an unfocused camera, and what is known beforehand.

Where y is the micro-image in whose view a corner is seen, in pixels from the principal point, and a the view's place
beside the micro-image's centre, :math:`y = y_0 + d a`. The central view, :math:`y_0 = -(b + z) X / (p g)`, is that of a
pinhole, whose distance follows from the perspective of tilted boards (Z. Zhang, "A flexible new technique for camera
calibration", 2000). Distances of corners then give the line

.. math:: d = -\frac{b + z}{z} (1 - \frac b f + \frac b g),

and its two coefficients f, b and z.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ...camera import PlenopticCamera
from ...errors import refuse_if
from ...runtime import Array
from .adjustment import Problem, adjust, adjust_poses, robust_lines
from .board_model import AT, NAMES, OFFSET, PRINCIPAL
from .calibration_result import group_means
from .observations import placed

# Observations of each pose that the fit of the first numbers uses.
_THINNED = 300

# Deviations, in degrees and parts of the picture's width, of what the data may leave open.
TILT = 0.1
PRINCIPAL_POINT = 0.02
TANGENTIAL = 1e-3
RADIAL = 0.03


@dataclass(frozen=True)
class BoardViews:
    """Boards in the central view, one item for each pose, and how corners move from view to view."""

    # Homographies from the board to pixels from the principal point.
    maps: Array
    # Corners on the board in mm, (corners, 2), and their disparities in pixels a pixel.
    boards: list[Array]
    disparities: list[Array]
    # Rows of the observations that agree with the others.
    good: Array

    def poses(self, focal: float) -> Array:
        """Return the poses (n, 6) that a pinhole with a focal length in pixels would see so."""
        return np.array([_pose(each, focal) for each in self.maps])


def board_views(problem: Problem, frames: Array, principal: Array) -> BoardViews:
    """Return how boards are seen in the central view, and how their corners move."""
    observed, grid = problem.corners, problem.grid
    assert grid is not None
    micro_image = grid[0] + observed.lens @ grid[1:]
    arm = observed.pixel - micro_image
    y = micro_image - principal
    scale = np.abs(y).max()
    good = np.ones(len(y), bool)
    maps, boards, disparities = [], [], []
    for pose, frame in enumerate(frames):
        rows = np.flatnonzero(observed.pose == pose)
        board, corner = np.unique(observed.board[rows], axis=0, return_inverse=True)
        corner = corner.ravel()
        refuse_if(len(board) < 9, f"frame {frame}: {len(board)} corners of the board are seen: 9 are needed at least")
        moved, across = (values - group_means(values, corner)[1][corner] for values in (y[rows], arm[rows]))
        refuse_if(not np.ptp(across) > 1, f"frame {frame}: each corner is seen in one view only; several are needed")
        # Of a plane, disparity is linear over its picture.
        line = np.column_stack([np.ones(len(rows)), y[rows] / scale])
        disparity, _, agrees = robust_lines(across[:, :, None] * line[:, None], moved)
        good[rows] = agrees
        seen, corner = np.unique(corner[agrees], return_inverse=True)
        place = group_means((y[rows] - (line @ disparity)[:, None] * arm[rows])[agrees], corner)[1]
        boards.append(board[seen])
        disparities.append(np.column_stack([np.ones(len(seen)), place / scale]) @ disparity)
        maps.append(_homography(board[seen], place))
        refuse_if(
            np.linalg.det(maps[-1]) <= 0,
            f"frame {frame}: the board is seen mirrored: number its corners as they are seen from its front, to "
            "the right and then down, in a picture that is not mirrored",
        )
    return BoardViews(np.array(maps), boards, disparities, good)


def view_start(problem: Problem, start: PlenopticCamera, frames: Array) -> tuple[Array, Array, Array]:
    """Return start values of camera and poses, and a mask of rows that agree with the others of their board.

    The result has the shape (17,), (poses, 6), (n,).
    """
    observed, grid, size = problem.corners, problem.grid, problem.pixel_size
    assert grid is not None
    principal = (np.array(start.crop_size) - 1) / 2
    refuse_if(observed.poses < 3, f"corners: {observed.poses} poses of the board: at least 3 are needed")
    seen = board_views(problem, frames, principal)
    scale = float(np.hypot(*start.crop_size)) / 2
    # Of columns h1 and h2 of a picture of a plane by a pinhole, (w h_x, w h_y, h_z) are at right angles and alike.
    rows = []
    for first, second, _ in seen.maps.transpose(0, 2, 1):
        for one, other in ((first + second, first - second), (first, second)):
            product = one * other / (np.hypot(*first[:2]) * np.hypot(*second[:2]))
            rows.append([product[:2].sum() / scale**2, -product[2]])
    along, apart = np.transpose(rows)
    square = float(along @ apart / (along @ along))
    nominal = (start.mla_distance + start.detector_distance) / size / scale
    # Boards that face the camera leave it to the data sheet.
    sum_of_distances = scale * size * (1 / np.sqrt(square) if 0.2 < 1 / (square * nominal**2) < 5 else nominal)
    poses = seen.poses(sum_of_distances / size)
    depths = [
        placed(board, pose[None], np.zeros(len(board), int))[:, 2]
        for pose, board in zip(poses, seen.boards, strict=True)
    ]
    inverse = 1 / np.concatenate(depths)
    refuse_if(
        np.ptp(inverse) < 0.01 * inverse.mean(),
        "corners: the board is at the same distance in all poses, which leaves the distances in the camera open: "
        "add poses nearer and farther",
    )
    slope, intercept = np.polyfit(inverse, np.concatenate(seen.disparities), 1)
    refuse_if(
        slope >= 0,
        "corners: they move from view to view against what nearer boards do: the pictures are mirrored, or the views "
        "counted from the other end",
    )
    b = -slope * sum_of_distances / (sum_of_distances - slope)
    z = sum_of_distances - b
    numbers = np.zeros(len(NAMES))
    numbers[:3] = b / (1 + intercept * z / sum_of_distances), b, z
    shrunk = size / (1 + z / b)
    numbers[3:5] = np.hypot(*grid[1:].T) * shrunk / [1, problem.row_ratio]
    numbers[AT["mla_rotation"]] = np.rad2deg(np.arctan2(grid[1, 1], grid[1, 0]))
    numbers[OFFSET] = (grid[0] - principal) * shrunk
    numbers[PRINCIPAL] = principal
    groups = [np.flatnonzero(seen.good & (observed.pose == pose)) for pose in range(observed.poses)]
    chosen = np.concatenate([group[:: max(1, len(group) // _THINNED)] for group in groups])
    few = Problem(observed.keep(chosen), size, problem.row_ratio, grid=grid)
    ones = np.ones(len(chosen))
    fit = adjust(few, numbers, poses, ("focal_length", "detector_distance"), ones, most_steps=60)
    return fit.numbers, adjust_poses(few, fit.numbers, fit.poses, ones), seen.good


def known_beforehand(start: PlenopticCamera, noise: float) -> Array:
    """Return numbers that data may leave open, with the weights of differences from them, (2, 17).

    They are those of a camera without tilt and distortion whose axis meets the middle of the picture; `noise` is the
    deviation of a residual.
    """
    values = np.zeros(len(NAMES))
    values[PRINCIPAL] = (np.array(start.crop_size) - 1) / 2
    reach = float(np.hypot(*start.crop_size)) * start.pixel_size / 2
    deviations = np.full(len(NAMES), np.inf)
    for name, deviation in {
        "tilt_x": TILT,
        "tilt_y": TILT,
        "principal_u": PRINCIPAL_POINT * start.crop_size[0],
        "principal_v": PRINCIPAL_POINT * start.crop_size[0],
        "k1": RADIAL / reach**2,
        "k2": RADIAL / reach**4,
        "k3": RADIAL / reach**6,
        "p1": TANGENTIAL / reach,
        "p2": TANGENTIAL / reach,
    }.items():
        deviations[AT[name]] = deviation
    return np.stack([values, noise / deviations])


def _homography(board: Array, place: Array) -> Array:
    """Return the matrix (3, 3) that maps positions on a plane to those in its picture."""
    scale = np.abs(board).max(), np.abs(place).max()
    x, y = (board / scale[0]).T
    source = np.column_stack([x, y, np.ones(len(x))])
    zero = np.zeros_like(source)
    u, v = (place / scale[1]).T[:, :, None]
    rows = np.concatenate([np.hstack([source, zero, -u * source]), np.hstack([zero, source, -v * source])])
    matrix = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    matrix = np.diag([scale[1], scale[1], 1]) @ matrix @ np.diag([1 / scale[0], 1 / scale[0], 1])
    return np.asarray(matrix / matrix[2, 2])


def _pose(matrix: Array, focal: float) -> Array:
    """Return the pose (6,) of a board from its picture's homography by a pinhole with a focal length in pixels."""
    first, second, origin = (np.diag([-1 / focal, -1 / focal, 1.0]) @ matrix).T
    size = np.sqrt(np.linalg.norm(first) * np.linalg.norm(second))
    axes = np.column_stack([first, second, np.cross(first, second) / size]) / size
    left, _, right = np.linalg.svd(axes)
    return np.concatenate([Rotation.from_matrix(left @ right).as_rotvec(), origin / size])
