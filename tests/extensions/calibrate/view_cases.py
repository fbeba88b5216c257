"""An unfocused camera like the first Lytro, boards before it, and corners in its views."""

import numpy as np

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.calibration import Board
from mitsuba_plenoptic.extensions.calibrate.adjustment import Problem
from mitsuba_plenoptic.extensions.calibrate.board_model import (
    AT, NAMES, PRINCIPAL, Observations, numbers_of, predict, predict_centres,
)  # fmt: skip

CAMERA = PlenopticCamera.preset("lytro")
BOARD = Board(8, 6, 20.0)
GEOMETRY = {"pixel_size": CAMERA.pixel_size, "row_ratio": CAMERA.lattice.row_ratio}
ARMS = np.array([[x, y] for x in (-3, -1, 1, 3) for y in (-3, -1, 1, 3) if x * x + y * y < 11], float)

# Turns about the board's middle, and its places.
_TURNS = np.array(
    [[0, 0], [0.5, 0], [-0.5, 0.1], [0.1, 0.6], [0, -0.6], [0.4, 0.4], [-0.4, 0.4], [0.5, -0.4], [-0.3, -0.5], [0.2, 0]]
)
_PLACES = np.array(
    [[0, 0, 400], [20, 10, 300], [-30, 20, 350], [40, -30, 500], [-60, 20, 600], [30, 40, 450], [-20, -30, 330],
     [100, 60, 800], [-120, -90, 1100], [20, -10, 280]], float,
)  # fmt: skip


def poses(board=BOARD):
    """Ten poses of a board before the camera, upright as it sees them."""
    from scipy.spatial.transform import Rotation

    middle = np.array([board.columns - 1, board.rows - 1, 0]) * board.square / 2
    rotation = Rotation.from_euler("xyz", [[*turn, np.pi + 0.02 * n] for n, turn in enumerate(_TURNS)])
    return np.concatenate([rotation.as_rotvec(), _PLACES - rotation.apply(middle)], axis=1)


def grid_of(numbers, count=40):
    """Places of lenses about the axis in pixels, as a line through the centres of micro-images."""
    lens = np.indices((2 * count + 1,) * 2).reshape(2, -1).T - float(count)
    centres = predict_centres(numbers, lens, **GEOMETRY)[0]
    return np.linalg.lstsq(np.column_stack([np.ones(len(lens)), lens]), centres)[0], lens, centres


def exact(numbers=None, at=None, board=BOARD):
    """Corners in views without noise, inside the picture, and the grid of lenses."""
    numbers = numbers_of(CAMERA) if numbers is None else numbers
    at = poses(board) if at is None else at
    grid, _, _ = grid_of(numbers)
    pose, corner, arm = (i.ravel() for i in np.indices((len(at), board.columns * board.rows, len(ARMS))))
    lens = np.zeros((len(pose), 2))
    for _ in range(4):
        seen = Observations(lens, grid[0] + lens @ grid[1:] + ARMS[arm], board.places(corner), pose)
        lens = predict(numbers, at, seen, grid=grid, **GEOMETRY)[0] / [1, GEOMETRY["row_ratio"]]
    pixel = grid[0] + lens @ grid[1:] + ARMS[arm]
    inside = ((pixel > 5) & (pixel < np.array(CAMERA.crop_size) - 6)).all(1)
    return Observations(lens, pixel, board.places(corner), pose).keep(inside), grid


def noisy(seen, grid, noise, generator):
    """Corners that are found some pitches beside their places, in the same views."""
    off = generator.normal(0, noise, seen.lens.shape) / [1, GEOMETRY["row_ratio"]]
    return Observations(seen.lens + off, seen.pixel + off @ grid[1:], seen.board, seen.pose)
