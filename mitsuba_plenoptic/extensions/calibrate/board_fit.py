"""Calibrating a camera from corners of a board in several poses, and evaluating a camera by them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...camera import PlenopticCamera, Use, require_camera, require_support
from ...errors import InputError, naming, refuse_if, suggest_keywords, warn
from ...runtime import Array
from .adjustment import Adjusted, Problem, adjust, adjust_poses, both_axes, deviation, huber, outlying, robust_lines
from .blur import fit_blur
from .board_model import NAMES, OFFSET, PRINCIPAL, Observations, camera_of, numbers_of, predict_centres
from .calibration_result import (
    OPEN,
    REMEDY,
    Calibration,
    Evaluation,
    fit_covariance,
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
from .view_start import board_views, known_beforehand, seen_poses, view_start

# Errors of detected centres are correlated over about this many lenses along each axis: the centres weigh accordingly
# less.
_CORRELATED = 16


@suggest_keywords
def calibrate(
    corners: Table,
    board: Board,
    start: PlenopticCamera,
    centres: Table | None = None,
    *,
    fills_pupil: bool = False,
    bent: bool = False,
) -> Calibration:
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
    fills_pupil : bool
        Whether micro-images that touch show the whole pupil, as the samples of each lens of a light field do, so that
        their pitch tells the f-number instead of `start`.
    bent : bool
        Whether the board's shape is fitted, too, as a polynomial of degree 5.

    Raises
    ------
    InputError
        If the data cannot determine what a camera predicts; the message says what is lacking. Parameters that the data
        leave open have wide deviations (`Calibration.open_direction`).
    """
    require_support(require_camera(start, "start"), Use.CALIBRATION)
    size = np.array(start.crop_size)
    for table in filter(None, (corners, centres)):
        require_on_detector(table, start.crop_size)
    middle = (size - 1) / 2
    in_views = corners.in_views
    refuse_if(
        in_views and centres is None,
        f"{corners.name}: corners in views leave the camera open; give centres of micro-images, of a white picture",
    )
    index, grid = find_lens_index(centres or corners, start.lattice.stagger == 2, middle)
    along, across = np.hypot(*grid[1:].T) / [1, start.lattice.row_ratio]
    # Pitches of a hexagonal lattice along and across rows that differ by a greater factor: turned by 30 degrees it can
    # be counted in shifted rows, too, but these have cells and types of lenses that it does not have.
    refuse_if(
        start.lattice.stagger == 2 and not 1 / 1.1 < across / along < 1.1,
        f"{(centres or corners).name}: a {start.mla_lattice} lattice would have pitches of {along:.4g} pixels "
        f"along its rows and {across:.4g} across them: rows must run along nearest neighbours; turn pictures of a "
        "hexagonal lattice by 90 degrees if its columns do",
    )
    observed, frames = observations(corners, board, index, grid)
    problem = Problem(observed, start.pixel_size, start.lattice.row_ratio)
    if in_views:
        problem = replace(problem, grid=grid)
        numbers, poses, good = view_start(problem, board, start, frames)
        # In pitches, for a first fit.
        noise = 0.05
    else:
        numbers, poses, good = start_values(problem, board, frames, grid, middle)
        noise = max(deviation(np.hypot(*problem.residuals(numbers, poses)[good].T)), 1e-3)
    if centres:
        inliers, scatter = _used_centres(centres, index)
        problem = _with_centres(problem, centres, inliers, index, noise / scatter)
    else:
        problem = _through_pupil(problem, problem.residuals(numbers, poses), good)
    shapes = board.shapes(corners["cluster"])[:, : None if bent else 0]

    def known(noise: float) -> Array:
        """Return what is known beforehand, with weights; a bent board's shapes are some hundredths of its length."""
        of_camera = known_beforehand(start, noise) if in_views else np.zeros((2, len(NAMES)))
        weight = 50 * noise / (board.square * max(board.columns, board.rows))
        return np.concatenate([of_camera, np.outer([0.0, weight], np.ones(shapes.shape[1]))], axis=1)

    problem = replace(problem, corners=replace(problem.corners, bend=shapes), known=known(noise))
    numbers = np.append(numbers, np.zeros(shapes.shape[1]))
    weights = np.where(good, huber(np.hypot(*problem.residuals(numbers, poses).T)), 0.0)
    fit = adjust(problem, numbers, poses, weights=weights)
    for _ in range(10):
        before = weights
        weights = _weights(problem, fit, frames)
        if in_views:
            noise = max(deviation(np.hypot(*problem.residuals(fit.numbers, fit.poses).T)), 1e-3)
            problem = replace(problem, centre_weight=noise / scatter, known=known(noise))
        fit = adjust(problem, fit.numbers, fit.poses, weights=weights)
        if ((before > 0) == (weights > 0)).all():
            break
    # The principal point goes to the grid of half pixels that a detector can be centred on.
    free_names = [name for name in NAMES if not name.startswith("principal")]
    weights = _weights(problem, fit, frames)
    fit.numbers[PRINCIPAL] = np.round(2 * fit.numbers[PRINCIPAL]) / 2
    final = adjust(problem, fit.numbers, fit.poses, free_names, weights)
    covariance, disagreement, by_frames, held_out = fit_covariance(problem, final, weights)
    deviations = np.sqrt(np.diag(covariance))
    count = len(NAMES)
    beyond = prediction_deviation(problem, final, covariance)
    refuse_if(
        not beyond < 1.0,
        f"corners: they leave open where this camera sees boards in other poses, +- {beyond:.2g} pixels: {REMEDY}",
    )
    if fills_pupil:
        f, b, z = final.numbers[:3]
        width = np.hypot(*grid[1]) * start.pixel_size * b / z
        start = start.replace(aperture_radius=start.focal_length * width / (2 * f))
    _require_matching_pupil(problem, final, weights, start, board, float(np.hypot(*grid[1])), deviations[0])
    f2 = start.mla_focal_lengths[0]
    if in_views and not fills_pupil and abs(final.numbers[2] - f2) > 0.1 * f2:
        warn(
            f"corners: with squares of {board.square:g} mm detector_distance is {final.numbers[2]:.4g} mm, far from "
            f"the data sheet's focal length of the microlenses, {f2:.4g} mm: check the sizes of squares and pixels"
        )
    with naming("corners: the parameters that fit them best are no camera; cover more of it"):
        camera = camera_of(final.numbers[:count], start)
        if in_views and start.mla_focal_lengths == (start.detector_distance,):
            # Corners do not tell it: lenses are taken as focused at infinity.
            camera = camera.replace(mla_focal_length=camera.detector_distance)
    centre_residuals = np.zeros((0, 2))
    centre_outliers = np.zeros(0, dtype=int)
    if centres:
        all_centres = _with_centres(problem, centres, np.ones(len(inliers), dtype=bool), index, 1.0)
        centre_residuals = all_centres.centre_residuals(final.numbers)
        centre_outliers = np.flatnonzero(~inliers)
    blur = None
    if BLUR_COLUMN in corners.columns:
        inliers = weights > 0
        types = len(start.mla_focal_lengths)
        moved = moved_solutions(problem, final, weights, covariance)
        radius = corners[BLUR_COLUMN][inliers]
        blur = fit_blur(radius, observed.keep(inliers), final.numbers, final.poses, camera.lattice, types, moved)
        camera = camera.replace(mla_focal_length=blur.focal_lengths)
    return Calibration(
        camera,
        index,
        _evaluation(problem, final.numbers, final.poses, frames),
        dict(zip(NAMES, final.numbers[:count].tolist(), strict=True)),
        dict(zip(NAMES, deviations[:count].tolist(), strict=True)),
        (covariance / np.outer(deviations, deviations))[:count, :count],
        centre_residuals,
        blur,
        disagreement,
        by_frames,
        centre_outliers,
        beyond,
        held_out,
        {
            NAMES[at]: float(deviations[at])
            for at in np.flatnonzero((problem.known[1] * deviations)[:count] > 0.7 * noise)
        },
        board.shapes(np.arange(board.columns * board.rows)) @ final.numbers[count:] if bent else np.zeros(0),
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
    """
    camera.require_array("evaluate")
    require_on_detector(corners, camera.crop_size)
    numbers = numbers_of(camera)
    lattice = camera.lattice
    principal = numbers[PRINCIPAL]
    scale = camera.micro_image_pitch / camera.row_pitch / camera.pixel_size
    along = lattice.from_frame(lattice.pitches[0], 0.0)
    across = lattice.from_frame(0.0, lattice.row_distance)
    grid = np.stack([numbers[OFFSET], along, across]) * scale
    grid[0] += principal
    if index is None and not corners.in_views:
        index, _ = find_lens_index(corners, lattice.stagger == 2, grid[0])
    observed, frames = observations(corners, board, index, grid)
    problem = Problem(observed, camera.pixel_size, lattice.row_ratio)
    if corners.in_views:
        problem = replace(problem, grid=grid)
        views, _, good = board_views(problem, frames, principal)
        first = seen_poses(views, (camera.mla_distance + camera.detector_distance) / camera.pixel_size)
    else:
        _, maps, good = board_images(problem, board, frames, grid, principal)
        first = upright_poses(maps, camera.focal_length)
    poses = adjust_poses(problem, numbers, first, good.astype(float))
    return _evaluation(problem, numbers, poses, frames)


def _evaluation(problem: Problem, numbers: Array, poses: Array, frames: Array) -> Evaluation:
    """Return the residuals of a problem's corners, with their unit."""
    unit = "px" if problem.grid is None else "px of views"
    return Evaluation(problem.residuals(numbers, poses), frames, problem.corners.pose, poses, unit)


def _with_centres(problem: Problem, centres: Table, inliers: Array, index: LensIndex, weight: float) -> Problem:
    """Return a problem with some of the centres added."""
    nothing = np.zeros((0, 2))
    observed = Observations(index.unit(centres["k"], centres["l"])[inliers], centres.pixel[inliers], nothing, nothing)
    return replace(problem, centres=observed, centre_weight=weight)


def _through_pupil(problem: Problem, residuals: Array, good: Array) -> Problem:
    """Return a problem without centres, constrained so that corners are seen through the pupil and near their centres.

    Over the pupil's image, the rows of one corner spread evenly, and err together: each corner counts once. Without
    this, pupil and principal point could put the camera's micro-images some lenses beside the corners.
    """
    observed = problem.corners.keep(good)
    matrix = np.column_stack([np.ones(len(observed)), observed.lens])
    spread = deviation(robust_lines(both_axes(matrix), observed.pixel)[1])
    count = len(np.unique(np.column_stack([observed.pose, observed.board]), axis=0))
    weight = max(deviation(np.hypot(*residuals[good].T)), 1e-3) / spread * np.sqrt(count / len(observed))
    return replace(problem, centres=observed, centre_weight=float(weight))


def _used_centres(centres: Table, index: LensIndex) -> tuple[Array, float]:
    """Return a mask of the centres that a fit uses, and the deviation with which they count, as errors are correlated.

    They are spread evenly over the lattice.
    """
    i, j = (index.unit(centres["k"], centres["l"]) / _CORRELATED).T
    matrix = np.column_stack([np.ones(len(i)), i, j, i * i, i * j, j * j])
    _, distance, inliers = robust_lines(both_axes(matrix), centres.pixel)
    if DOUBTFUL_COLUMN in centres.columns:
        inliers &= centres[DOUBTFUL_COLUMN] == 0
    return inliers, max(deviation(distance[inliers]), 1e-3) * _CORRELATED


def _require_matching_pupil(
    problem: Problem,
    fit: Adjusted,
    weights: Array,
    start: PlenopticCamera,
    board: Board,
    pitch: float,
    uncertain: float,
) -> None:
    """Refuse distances in the camera that give pupil images of another size than the observed micro-images.

    If squares are stated s times too large, the object space scales by s and the image space by 1/s along the axis,
    which explains the corners equally well.
    """
    f, b, z = fit.numbers[:3]
    radius = z / b * f / (2 * start.f_number) / problem.pixel_size
    observed = problem.corners
    middle, _ = predict_centres(fit.numbers, observed.lens, **problem.geometry)
    reach = float(np.quantile(np.hypot(*(observed.pixel - middle)[weights > 0].T), 0.95))
    if reach > 1.6 * radius:
        wrong = f"corners are seen {reach:.3g} pixels from the centres of their micro-images"
    elif 2 * radius > 1.5 * pitch:
        wrong = f"micro-images are {pitch:.3g} pixels apart"
    else:
        return
    alternative = f", or {REMEDY} (focal length {f:.3g} +- {uncertain:.2g} mm)" if uncertain > OPEN * f else ""
    raise InputError(
        f"corners: with squares of {board.square:g} mm and the camera's f-number of {start.f_number:.3g} micro-images "
        f"would have a radius of {radius:.3g} pixels, but {wrong}: check the distance of the board's corners and the "
        f"f-number{alternative}"
    )


def _weights(problem: Problem, fit: Adjusted, frames: Array) -> Array:
    """Return the weight of each corner in the fit: smaller for residuals beyond a limit, 0 for outliers."""
    distance = np.hypot(*problem.residuals(fit.numbers, fit.poses).T)
    weights = np.where(outlying(distance), 0.0, huber(distance))
    pose = problem.corners.pose
    rows = np.bincount(pose)
    inliers = np.bincount(pose, weights > 0)
    for index in np.flatnonzero(inliers < 0.5 * rows):
        raise InputError(
            f"frame {frames[index]}: {rows[index] - inliers[index]:.0f} of its {rows[index]} rows are outliers of the "
            "camera that explains the other frames: correct or remove the frame"
        )
    return weights
