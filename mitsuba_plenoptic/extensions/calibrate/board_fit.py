"""Calibrating a camera from corners of a board in several poses, and evaluating a camera by them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...camera import PlenopticCamera, require_camera
from ...camera.plenoptic_camera import require_no_shape, require_round
from ...errors import InputError, naming, refuse_if, suggest_keywords
from .adjustment import Adjusted, Problem, adjust, adjust_poses, both_axes, deviation, huber, outlying, robust_lines
from .blur import fit_blur
from .board_model import AT, NAMES, Observations, camera_of, numbers_of, on_pixel_grid, predict_centres
from .calibration_result import (
    OPEN,
    REMEDY,
    Calibration,
    Evaluation,
    deviations,
    moved_solutions,
    prediction_deviation,
)
from .observations import (
    BLUR_COLUMN,
    DOUBTFUL_COLUMN,
    Board,
    LensIndex,
    Table,
    find_lens_index,
    observations,
    require_on_detector,
)
from .start import board_images, start_values, upright_poses

# How often it is decided anew which rows are outliers.
_MOST_ROUNDS = 10

# A frame with fewer of its rows left is not one that the others' camera sees.
_LEFT_OF_FRAME = 0.5

# Errors of detected centres are correlated over about this many lenses along each axis: the centres weigh accordingly
# less.
_CORRELATED = 16

# Pitches of a hexagonal lattice along and across rows that differ by a greater factor: turned by 30 degrees it can be
# counted in shifted rows, too, but these have cells and types of lenses that it does not have.
_MOST_UNLIKE = 1.1

# Pixels by which boards in other poses may deviate from where they are predicted.
_UNPREDICTED = 1.0

# How much farther from the centres of their micro-images than the pupil's image reaches corners may be seen, and how
# much wider than the lenses' distance that image may be: the f-number need not be exact.
_MOST_BEYOND = 1.6
_MOST_OVERLAP = 1.5


@suggest_keywords
def calibrate(corners: Table, board: Board, start: PlenopticCamera, centres: Table | None = None) -> Calibration:
    """Return a camera, and the poses of a board, fitted to corners seen through its microlenses.

    Outliers, rows far from the positions that the other rows predict, are left out of the fit and named
    (`Evaluation.outliers`); reported errors count every row unless stated otherwise.

    Parameters
    ----------
    corners : Table
        As `read_corners` gives them. A column ``rho`` of blur radii determines the microlenses' focal lengths.
    board : Board
        The board.
    start : PlenopticCamera
        Provides what the data do not determine: detector, lattice, f-number, focal lengths of the microlenses, models.
        All other parameters are found from the data alone.
    centres : Table, optional
        Centres of micro-images, fitted jointly. Without centres, pitch and focal length are strongly correlated, and
        centres are assumed near the corners.

    Raises
    ------
    InputError
        If the data cannot determine what a camera predicts; the message says what is lacking. Parameters that the data
        leave open have wide deviations (`Calibration.open_direction`).
    """
    require_camera(start, "start").require_array("calibrate")
    start.require_thin("cameras are calibrated")
    require_no_shape(start, "cameras are calibrated")
    require_round(start, "cameras are calibrated")
    refuse_if(start.mla_medium != 1, f"mla_medium = {start.mla_medium:g}: cameras are calibrated with 1 only")
    size = np.array(start.crop_size)
    for table in filter(None, (corners, centres)):
        require_on_detector(table, start.crop_size)
    middle = (size - 1) / 2
    index, grid = find_lens_index(centres or corners, start.lattice.stagger == 2, middle)
    along, across = np.hypot(*grid[1:].T) / [1, start.lattice.row_ratio]
    refuse_if(
        start.lattice.stagger == 2 and not 1 / _MOST_UNLIKE < across / along < _MOST_UNLIKE,
        f"{(centres or corners).name}: a {start.mla_lattice} lattice would have pitches of {along:.4g} pixels "
        f"along its rows and {across:.4g} across them: rows must run along nearest neighbours; turn pictures of a "
        "hexagonal lattice by 90 degrees if its columns do",
    )
    seen, frames = observations(corners, board, index)
    problem = Problem(seen, start.pixel_size, start.lattice.row_ratio)
    numbers, poses, good = start_values(problem, board, frames, grid, middle)
    if centres:
        used, weight = _used_centres(centres, index, problem.residuals(numbers, poses)[good])
        problem = _with_centres(problem, centres, used, index, weight)
    else:
        problem = _through_pupil(problem, problem.residuals(numbers, poses), good)
    weights = np.where(good, huber(_distance(problem, numbers, poses)), 0.0)
    found, steps = adjust(problem, numbers, poses, weights=weights), 0
    for _ in range(_MOST_ROUNDS):
        steps += found.steps
        before, weights = weights, _weights(problem, found, frames)
        found = adjust(problem, found.numbers, found.poses, weights=weights)
        if ((before > 0) == (weights > 0)).all():
            break
    # The principal point goes to the grid of half pixels that a detector can be centred on.
    rest = [name for name in NAMES if not name.startswith("principal")]
    weights = _weights(problem, found, frames)
    final = adjust(problem, on_pixel_grid(found.numbers), found.poses, rest, weights)
    known = deviations(problem, final, weights)
    elsewhere = prediction_deviation(problem, final, known.covariance)
    refuse_if(
        not elsewhere < _UNPREDICTED,
        f"corners: they leave open where this camera sees boards in other poses, +- {elsewhere:.2g} pixels: {REMEDY}",
    )
    uncertain = known.values[AT["focal_length"]]
    _require_matching_pupil(problem, final, weights, start, board, float(np.hypot(*grid[1])), uncertain)
    with naming("corners: the parameters that fit them best are no camera; cover more of it"):
        camera = camera_of(final.numbers, start)
    centre_residuals, centre_outliers = np.zeros((0, 2)), np.zeros(0, dtype=int)
    if centres:
        every = _with_centres(problem, centres, np.ones(len(used), dtype=bool), index, weight)
        centre_residuals, centre_outliers = every.centre_residuals(final.numbers), np.flatnonzero(~used)
    blur = None
    if BLUR_COLUMN in corners.columns:
        used, types = weights > 0, len(start.mla_focal_lengths)
        moved = moved_solutions(problem, final, weights, known.covariance)
        radius, numbers = corners[BLUR_COLUMN][used], final.numbers
        blur = fit_blur(radius, seen.keep(used), numbers, final.poses, camera.lattice, types, moved)
        camera = camera.replace(mla_focal_length=blur.focal_lengths)
    return Calibration(
        camera,
        index,
        Evaluation(problem.residuals(final.numbers, final.poses), frames, seen.pose, final.poses),
        dict(zip(NAMES, final.numbers.tolist(), strict=True)),
        dict(zip(NAMES, known.values.tolist(), strict=True)),
        known.covariance / np.outer(known.values, known.values),
        centre_residuals,
        steps + found.steps + final.steps,
        blur,
        known.disagreement,
        known.by_frames,
        centre_outliers,
        elsewhere,
    )


def evaluate(corners: Table, board: Board, camera: PlenopticCamera, index: LensIndex | None = None) -> Evaluation:
    """Return the errors, in pixels, of a fixed camera's predictions of corners; only the poses are fitted.

    Parameters
    ----------
    corners, board
        As for `calibrate`.
    camera : PlenopticCamera
        The camera to evaluate.
    index : LensIndex, optional
        Indexing of lenses in the table of corners. Default: found from the positions of the corners.

    Raises
    ------
    InputError
        If the corners cannot determine the poses.
    """
    camera.require_array("evaluate")
    require_on_detector(corners, camera.crop_size)
    numbers, lattice = numbers_of(camera), camera.lattice
    principal = numbers[[AT["principal_u"], AT["principal_v"]]]
    scale = camera.micro_image_pitch / camera.mla_pitch / camera.pixel_size
    u, v = np.array(lattice.from_frame(1.0, 0.0)), np.array(lattice.from_frame(0.0, 1.0))
    offset = numbers[[AT["offset_x"], AT["offset_y"]]]
    grid = np.stack([offset, u * lattice.pitches[0], v * lattice.row_distance]) * scale
    grid[0] += principal
    if index is None:
        index, _ = find_lens_index(corners, lattice.stagger == 2, grid[0])
    seen, frames = observations(corners, board, index)
    problem = Problem(seen, camera.pixel_size, lattice.row_ratio)
    _, maps, good = board_images(problem, board, frames, grid, principal)
    poses = adjust_poses(problem, numbers, upright_poses(maps, camera.focal_length), good.astype(float))
    return Evaluation(problem.residuals(numbers, poses), frames, seen.pose, poses)


def cross_validate(
    corners: Table, board: Board, calibration: Calibration, centres: Table | None = None
) -> dict[int, float]:
    """Return the error of each pose in pixels, predicted by a calibration without that pose; only its pose is fitted.

    Parameters
    ----------
    corners : Table
        Observed corners, as `read_corners` gives them.
    board : Board
        The board that was seen.
    calibration : Calibration
        The calibration from all poses.
    centres : Table, optional
        Observed centres of micro-images.

    Returns
    -------
    dict
        RMS error in pixels by frame.
    """
    seen, frames = observations(corners, board, calibration.index)
    camera = calibration.camera
    whole = Problem(seen, camera.pixel_size, camera.lattice.row_ratio)
    if centres:
        used, weight = _used_centres(centres, calibration.index, calibration.evaluation.residuals)
        whole = _with_centres(whole, centres, used, calibration.index, weight)
    numbers, poses = np.array(list(calibration.numbers.values())), calibration.evaluation.poses
    errors = {}
    for out, frame in enumerate(frames):
        problem = _poses(whole, seen.pose != out)
        if not centres:
            kept = calibration.evaluation.residuals[seen.pose != out]
            problem = _through_pupil(problem, kept, ~outlying(np.hypot(*kept.T)))
        weights = _weights(problem, Adjusted(numbers, np.delete(poses, out, 0), 0.0, 0), np.delete(frames, out))
        found = adjust(problem, numbers, np.delete(poses, out, 0), weights=weights)
        alone = _poses(Problem(seen, whole.pixel_size, whole.row_ratio), seen.pose == out)
        refitted = adjust(alone, found.numbers, poses[out : out + 1], ())
        errors[int(frame)] = float(np.sqrt(2 * refitted.cost / len(alone.corners)))
    return errors


def _poses(problem: Problem, used: np.ndarray) -> Problem:
    """Return a problem restricted to some poses."""
    seen = problem.corners
    _, pose = np.unique(seen.pose[used], return_inverse=True)
    some = replace(seen.keep(used), pose=pose)
    return Problem(some, problem.pixel_size, problem.row_ratio, problem.centres, problem.centre_weight)


def _with_centres(problem: Problem, centres: Table, used: np.ndarray, index: LensIndex, weight: float) -> Problem:
    """Return a problem with some of the centres added."""
    nothing = np.zeros((0, 2))
    seen = Observations(index.unit(centres["k"], centres["l"])[used], centres.pixel[used], nothing, nothing)
    return Problem(problem.corners, problem.pixel_size, problem.row_ratio, seen, weight)


def _through_pupil(problem: Problem, residuals: np.ndarray, used: np.ndarray) -> Problem:
    """Return a problem without centres, constrained so that corners are seen through the pupil and near their centres.

    Over the pupil's image, the rows of one corner spread evenly, and err together: each corner counts once. Without
    this, pupil and principal point could put the camera's micro-images some lenses beside the corners.
    """
    seen = problem.corners.keep(used)
    matrix = np.column_stack([np.ones(len(seen)), seen.lens])
    spread = deviation(robust_lines(both_axes(matrix), seen.pixel)[1])
    count = len(np.unique(np.column_stack([seen.pose, seen.board]), axis=0))
    weight = max(deviation(np.hypot(*residuals[used].T)), 1e-3) / spread * np.sqrt(count / len(seen))
    return replace(problem, centres=seen, centre_weight=float(weight))


def _used_centres(centres: Table, index: LensIndex, residuals: np.ndarray) -> tuple[np.ndarray, float]:
    """Return a mask of the centres that a fit uses, spread evenly over the lattice, and their weight.

    The weight is the deviation of the corners' residuals over the deviation of centres, whose errors are correlated.
    """
    i, j = (index.unit(centres["k"], centres["l"]) / _CORRELATED).T
    matrix = np.column_stack([np.ones(len(i)), i, j, i * i, i * j, j * j])
    _, distance, used = robust_lines(both_axes(matrix), centres.pixel)
    if DOUBTFUL_COLUMN in centres.columns:
        used &= centres[DOUBTFUL_COLUMN] == 0
    own = [max(deviation(each), 1e-3) for each in (np.hypot(*residuals.T), distance[used])]
    return used, own[0] / own[1] / _CORRELATED


def _distance(problem: Problem, numbers: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Return the distance between predicted and observed position of each corner, in pixels."""
    return np.asarray(np.hypot(*problem.residuals(numbers, poses).T))


def _require_matching_pupil(
    problem: Problem,
    found: Adjusted,
    weights: np.ndarray,
    start: PlenopticCamera,
    board: Board,
    pitch: float,
    uncertain: float,
) -> None:
    """Refuse distances in the camera that give pupil images of another size than the observed micro-images.

    If squares are stated s times too large, the object space scales by s and the image space by 1/s along the axis,
    which explains the corners equally well.
    """
    f, b, z = found.numbers[:3]
    radius = z / b * f / (2 * start.f_number) / problem.pixel_size
    seen = problem.corners
    middle, _ = predict_centres(found.numbers, seen.lens, pixel_size=problem.pixel_size, row_ratio=problem.row_ratio)
    reach = float(np.quantile(np.hypot(*(seen.pixel - middle)[weights > 0].T), 0.95))
    if reach > _MOST_BEYOND * radius:
        wrong = f"corners are seen {reach:.3g} pixels from the centres of their micro-images"
    elif 2 * radius > _MOST_OVERLAP * pitch:
        wrong = f"micro-images are {pitch:.3g} pixels apart"
    else:
        return
    others = f", or {REMEDY} (focal length {f:.3g} +- {uncertain:.2g} mm)" if uncertain > OPEN * f else ""
    raise InputError(
        f"corners: with squares of {board.square:g} mm and the camera's f-number of {start.f_number:.3g} micro-images "
        f"would have a radius of {radius:.3g} pixels, but {wrong}: check the distance of the board's corners and the "
        f"f-number{others}"
    )


def _weights(problem: Problem, found: Adjusted, frames: np.ndarray) -> np.ndarray:
    """Return the weight of each corner in the fit: smaller for residuals beyond a limit, 0 for outliers."""
    distance = _distance(problem, found.numbers, found.poses)
    weights = np.where(outlying(distance), 0.0, huber(distance))
    pose = problem.corners.pose
    rows, left = np.bincount(pose), np.bincount(pose, weights > 0)
    for index in np.flatnonzero(left < _LEFT_OF_FRAME * rows):
        raise InputError(
            f"frame {frames[index]}: {rows[index] - left[index]:.0f} of its {rows[index]} rows are outliers of the "
            "camera that explains the other frames: correct or remove the frame"
        )
    return weights
