"""An unfocused camera like the first Lytro, boards before it, and corners in its views."""

from unittest import mock

import numpy as np
from scipy.spatial.transform import Rotation

from mitsuba_plenoptic import PlenopticCamera, calibrate
from mitsuba_plenoptic.calibration import Board, Table
from mitsuba_plenoptic.extensions.calibrate import board_fit
from mitsuba_plenoptic.extensions.calibrate.board_model import (
    OFFSET,
    PRINCIPAL,
    Observations,
    _lenses,
    numbers_of,
    predict,
    predict_centres,
)
from mitsuba_plenoptic.extensions.calibrate.calibration_result import SCALE_ERROR
from mitsuba_plenoptic.extensions.calibrate.observations import VIEW_COLUMNS
from mitsuba_plenoptic.extensions.calibrate.view_start import known_beforehand

CAMERA = PlenopticCamera.preset("lytro")
BOARD = Board(6, 5, 28.0)
GEOMETRY = {"pixel_size": CAMERA.pixel_size, "row_ratio": CAMERA.lattice.row_ratio}
ARMS = np.array([[3, 0], [-3, 0], [0, 3], [0, -3]], float)

# Turns about the board's middle, and its places.
_TURNS = np.array(
    [[0, 0], [0.5, 0], [-0.5, 0.1], [0.1, 0.6], [0, -0.6], [0.4, 0.4], [-0.4, 0.4], [0.5, -0.4], [-0.3, -0.5], [0.2, 0]]
)
_PLACES = np.array(
    [[0, 0, 400], [20, 10, 300], [-30, 20, 350], [40, -30, 500], [-60, 20, 600], [30, 40, 450], [-20, -30, 330],
     [100, 60, 800], [-120, -90, 1100], [20, -10, 280]], float,
)  # fmt: skip


def poses(board=BOARD, aside=1.0):
    """Ten poses of a board before the camera, upright as it sees them, some aside from the axis."""
    middle = np.array([board.columns - 1, board.rows - 1, 0]) * board.square / 2
    rotation = Rotation.from_euler("xyz", [[*turn, np.pi + 0.02 * n] for n, turn in enumerate(_TURNS)])
    return np.concatenate([rotation.as_rotvec(), _PLACES * [aside, aside, 1] - rotation.apply(middle)], axis=1)


def grid_of(numbers):
    """Places of lenses about the axis in pixels, as a line through the centres of micro-images."""
    lens = np.indices((81, 81)).reshape(2, -1).T - 40.0
    centres = predict_centres(numbers, lens, **GEOMETRY)[0]
    return np.linalg.lstsq(np.column_stack([np.ones(len(lens)), lens]), centres)[0]


def exact(numbers=None, at=None, board=BOARD, bend=()):
    """Corners in views without noise, inside the picture, and the grid of lenses."""
    numbers = np.append(numbers_of(CAMERA) if numbers is None else numbers, bend)
    at = poses(board) if at is None else at
    grid = grid_of(numbers)
    pose, corner, arm = (i.ravel() for i in np.indices((len(at), board.columns * board.rows, len(ARMS))))
    lens, shapes = np.zeros((len(pose), 2)), board.shapes(corner)[:, : len(bend)]
    for _ in range(4):
        seen = Observations(lens, grid[0] + lens @ grid[1:] + ARMS[arm], board.places(corner), pose, shapes)
        lens = predict(numbers, at, seen, grid=grid, **GEOMETRY)[0] / [1, GEOMETRY["row_ratio"]]
    pixel = grid[0] + lens @ grid[1:] + ARMS[arm]
    inside = ((pixel > 5) & (pixel < np.array(CAMERA.crop_size) - 6)).all(1)
    return Observations(lens, pixel, board.places(corner), pose).keep(inside), grid


def noisy(seen, grid, noise, generator):
    """Corners that are found some pitches beside their places, in the same views."""
    off = generator.normal(0, noise, seen.lens.shape) / [1, GEOMETRY["row_ratio"]]
    return Observations(seen.lens + off, seen.pixel + off @ grid[1:], seen.board, seen.pose)


def tables(numbers, board, noise, generator, scatter=0.03, scale=(1.0, 1.0), at=None, bend=()):
    """Corners and centres of micro-images as files have them; the centres of 16 lenses along each axis err together."""
    seen, grid = exact(numbers, at, board, bend)
    seen = noisy(seen, grid, noise, generator)
    corner = np.round(seen.board / board.square).astype(int) @ [1, board.columns]
    lens = np.indices((64, 64)).reshape(2, -1).T * 4 - 128
    shifted = lens + 0.5 * (lens[:, 1:] % 2) * [1, 0]
    pixel = predict_centres(numbers, shifted, **GEOMETRY)[0]
    inside = ((pixel > 10) & (pixel < np.array(CAMERA.crop_size) - 11)).all(1)
    _, block = np.unique(lens // 16, axis=0, return_inverse=True)
    off = generator.normal(0, scatter, (block.max() + 1, 2))[block.ravel()]
    pixel = (pixel - pixel.mean(0)) * scale + pixel.mean(0) + off
    columns = dict(zip("kluv", (*lens[inside].T, *pixel[inside].T), strict=True))
    # Places among lenses are those on the grid of centres, as these were found.
    line = np.linalg.lstsq(np.column_stack([np.ones(inside.sum()), shifted[inside]]), pixel[inside])[0]
    values = *(line[0] + seen.lens @ line[1:]).T, *seen.pixel.T, corner, seen.pose
    return Table("corners.csv", dict(zip(VIEW_COLUMNS, values, strict=True))), Table("centres.csv", columns)


def indexed(numbers, index):
    """The same numbers, for lenses that are counted from the one that a calibration calls the first."""
    numbers = numbers.copy()
    unit = -index.unit(np.zeros(1, int), np.zeros(1, int))
    numbers[OFFSET] = _lenses(numbers, unit, GEOMETRY["row_ratio"])[0][0]
    return numbers


def normalised_errors(seed, board=BOARD, noise=0.03):
    """Errors of numbers over their stated deviations, of a camera that differs as much as is assumed."""
    generator = np.random.default_rng(seed)
    weight = known_beforehand(CAMERA, 1.0)[1]
    numbers = numbers_of(CAMERA)
    numbers += np.divide(generator.normal(size=len(numbers)), weight, out=np.zeros_like(weight), where=weight > 0)
    numbers[PRINCIPAL] = np.round(2 * numbers[PRINCIPAL]) / 2
    scale = 1 + generator.normal(0, SCALE_ERROR, 2)
    corners, centres = tables(numbers, board, noise, generator, scale=scale)
    # Of the 16 lenses along each axis that err together, four are in the table.
    with mock.patch.object(board_fit, "_CORRELATED", 4):
        found = calibrate(corners, board, CAMERA.replace(focal_length=6.5, mla_distance=7.5), centres)
    off = np.array(list(found.numbers.values())) - indexed(numbers, found.index)
    return off / np.array(list(found.deviations.values()))
