"""The result of a calibration: residuals by lens, field, depth and pose, and standard deviations of the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from ...camera import PlenopticCamera
from ...runtime import Array, Pair
from .adjustment import Adjusted, Problem, outlying, rms
from .blur import Blur
from .board_model import NAMES, UNITS, centres_of, predict_centres
from .observations import Board, LensIndex, Table, placed

OPEN = 0.1
"""Part of the focal length from which on its deviation leaves it open."""

SCALE_ERROR = 1e-5
"""Error of the distances of centres in a white picture, in parts of them, that their scatter does not tell."""

REMEDY = "give centres of micro-images, or add poses nearer and farther, in which the board is tilted by 20 degrees"
"""What determines an open focal length."""


@dataclass(frozen=True)
class Evaluation:
    """Errors of the positions at which a camera predicts corners; every row counts.

    Attributes
    ----------
    residuals : (n, 2) array
        Predicted minus observed pixels, in the order of the file.
    frames : (poses,) int array
        Indices of the poses' frames.
    pose : (n,) int array
        Index, among the poses, of each row's pose.
    poses : (poses, 6) array
        Rotation vector (radians) and position of the board's first corner in mm, from the board's to the camera frame.
    unit : str
        Unit of the residuals: pixels of the picture, or pixels of views, which are lenses.
    """

    residuals: Array
    frames: Array
    pose: Array
    poses: Array
    unit: str = "px"

    @property
    def error(self) -> float:
        """RMS of the distances between predicted and observed positions in pixels."""
        return rms(self.residuals)

    @property
    def pose_errors(self) -> Array:
        """RMS error of each pose, in pixels."""
        return np.sqrt(np.bincount(self.pose, (self.residuals**2).sum(1)) / np.bincount(self.pose))

    @property
    def outliers(self) -> Array:
        """Rows, counted from 0, whose residuals exceed six times the typical one."""
        return np.flatnonzero(outlying(np.hypot(*self.residuals.T)))

    @property
    def error_without_outliers(self) -> float:
        """RMS of the distances without the outliers."""
        return self.without_outliers().error

    def without_outliers(self) -> Evaluation:
        """Return this evaluation without the outliers."""
        inliers = np.delete(np.arange(len(self.residuals)), self.outliers)
        return replace(self, residuals=self.residuals[inliers], pose=self.pose[inliers])


@dataclass(frozen=True)
class Calibration:
    """Camera, poses and deviations that a calibration has found.

    Attributes
    ----------
    camera : PlenopticCamera
        The camera, with the principal point rounded to half a pixel: it is the centre of the full detector, of which
        the crop window is recorded.
    index : LensIndex
        Indexing of lenses in the observations.
    evaluation : Evaluation
        Residuals and poses.
    numbers, deviations : dict
        The camera's parameters by the names of `board_model.NAMES`, and their standard deviations.
    correlation : (17, 17) array
        Correlations of the parameters' errors.
    centre_residuals : (n, 2) array
        Residuals of the given centres.
    blur : Blur, optional
        The microlenses' focal lengths from blur radii, where the corners have them.
    disagreement : float
        Ratio of the frames' disagreement about the parameters to that explained by the residuals' scatter.
    by_frames : bool
        Whether frames disagree more than chance allows; then deviations come from leaving out frames.
    centre_outliers : (m,) int array
        Rows, from 0, of centres that were not fitted: doubtful ones and those that lie off the others' lattice.
    prediction_deviation : float
        RMS displacement in pixels, due to errors of the parameters, of corners of boards turned by 30 degrees from the
        observed ones, with fitted poses.
    held_out : (poses,) array
        Error of each pose's corners, in the unit of the residuals, for a camera fitted to the other poses.
    assumed : dict
        Of corners in views: numbers that the data leave open, with deviations, mostly those assumed for them from 0 or
        from the middle of the picture.
    board_heights : (corners,) array
        Of a bent board: how far each corner lies behind the plane through all, in mm.
    """

    camera: PlenopticCamera
    index: LensIndex
    evaluation: Evaluation
    numbers: dict[str, float]
    deviations: dict[str, float]
    correlation: Array
    centre_residuals: Array
    blur: Blur | None
    disagreement: float
    by_frames: bool
    centre_outliers: Array
    prediction_deviation: float
    held_out: Array
    assumed: dict[str, float]
    board_heights: Array

    @property
    def centre_error(self) -> float | None:
        """RMS of the distances between predicted and observed centres in pixels; None without centres."""
        return rms(self.centre_residuals) if len(self.centre_residuals) else None

    @property
    def open_direction(self) -> dict[str, float]:
        """Changes of the correlated parameters if the focal length changes by its standard deviation.

        Only parameters with a correlation above 0.5 are named. Empty if the deviation is below a tenth of the focal
        length.
        """
        if self.deviations["focal_length"] < OPEN * abs(self.numbers["focal_length"]):
            return {}
        return {
            name: float(correlation) * self.deviations[name]
            for name, correlation in zip(NAMES, self.correlation[0], strict=True)
            if abs(correlation) > 0.5
        }

    def weak_directions(self, count: int = 3) -> list[tuple[float, dict[str, float]]]:
        """Return the parameters that the data determine worst: combinations that can change together.

        Parameters
        ----------
        count : int
            Number of combinations.

        Returns
        -------
        list of (float, dict)
            For each combination, greatest first: its deviation over the deviation for independent parameters, and the
            changes of the parameters that matter, in their own deviations.
        """
        values, vectors = np.linalg.eigh(self.correlation)
        return [
            (
                float(np.sqrt(values[-rank])),
                {NAMES[i]: float(v) for i, v in enumerate(vectors[:, -rank]) if abs(v) > 0.2},
            )
            for rank in range(1, count + 1)
        ]


@dataclass(frozen=True)
class ResidualMap:
    """Residuals of groups of observations: arrays of one row for each group.

    Attributes
    ----------
    by : str
        Property that a group's observations have in common, as for `residual_map`.
    key : (groups, columns) array
        Identity of the group. ``lens``: indices k, l as in the data, and the camera's centre u, v of the
        micro-image in pixels; ``view``: least and greatest distance of its pixels
        from the lenses' centres; ``field``: middle of a square of the detector, in pixels;
        ``depth``: least and greatest distance of the corners, in mm.
    count : (groups,) int array
        Number of observations in each group.
    mean : (groups, 2) array
        Mean of observed minus predicted positions, in pixels.
    error : (groups,) array
        RMS distance between observed and predicted positions, in pixels.
    """

    by: str
    key: Array
    count: Array
    mean: Array
    error: Array


def residual_map(calibration: Calibration, board: Board, corners: Table, by: str, parts: int = 6) -> ResidualMap:
    """Return the residuals of a calibration's corners in groups by lens, view, field or depth.

    `parts` are squares of the field along the detector's rows, or ranges of depth with as many observations each.
    """
    evaluation = calibration.evaluation
    camera = calibration.camera
    group = evaluation.pose
    if by == "lens":
        lenses, group = np.unique(np.stack([corners["k"], corners["l"]], axis=-1), axis=0, return_inverse=True)
        key = np.concatenate([lenses, centres_of(camera, calibration.index.unit(*lenses.T))], axis=1)
    elif by == "view":
        beside = corners.pixel - np.stack([corners["x"], corners["y"]], axis=-1)
        key, group = np.unique(np.rint(np.hypot(*beside.T)), return_inverse=True)
        key = np.stack([key, key], axis=-1)
    elif by == "field":
        key, group = field_cells(corners.pixel, camera.crop_size[0] / parts)
    else:
        depth = placed(board.places(corners["cluster"]), evaluation.poses, evaluation.pose)[:, 2]
        group = np.empty_like(group)
        ranges = [rows for rows in np.array_split(np.argsort(depth, kind="stable"), parts) if len(rows)]
        for index, rows in enumerate(ranges):
            group[rows] = index
        key = np.array([depth[rows[[0, -1]]] for rows in ranges])
    group = group.ravel()
    count, mean = group_means(-evaluation.residuals, group)
    square = np.bincount(group, (evaluation.residuals**2).sum(1)) / count
    return ResidualMap(by, key.astype(float), count, mean, np.sqrt(square))


def field_cells(pixel: Array, side: float) -> Pair:
    """Return the middles of the occupied squares of a grid, in pixels, and the index of the square of each position."""
    cell, group = np.unique(np.floor((pixel + 0.5) / side), axis=0, return_inverse=True)
    return (cell + 0.5) * side - 0.5, group.ravel()


def group_means(values: Array, group: Array) -> Pair:
    """Return the number of rows and the mean value of each group."""
    count = np.bincount(group)
    return count, np.stack([np.bincount(group, column) for column in values.T], axis=-1) / count[:, None]


def summary(calibration: Calibration, most: int) -> list[str]:
    """Return lines on how well a calibration explains the data and what they leave open, with at most so many rows."""
    lines = []
    if calibration.blur is not None:
        lengths = zip(calibration.blur.focal_lengths, calibration.blur.deviations, strict=True)
        texts = ", ".join(f"{value:.7g} +- {deviation:.2g}" for value, deviation in lengths)
        error = f"{calibration.blur.error:.4f} px RMS, {calibration.blur.scale:.4g} px for the whole lens"
        lines.append(f"mla_focal_length {texts} mm from blur radii, {error}")
    for weakness, parts in calibration.weak_directions():
        terms = ", ".join(f"{name} {weight:+.2f}" for name, weight in parts.items())
        lines.append(f"poorly determined, {weakness:.1f} times the deviations: {terms}")
    if moved := calibration.open_direction:
        terms = ", ".join(f"{name} {change:+.2g}" for name, change in moved.items() if name != "focal_length")
        lines.append(
            f"the corners leave the focal length open; with {moved['focal_length']:+.2g} mm go {terms or 'the poses'}: "
            f"{REMEDY}"
        )
    if calibration.assumed:
        terms = ", ".join(
            f"{name} +- {deviation:.2g} {UNITS[name]}".rstrip() for name, deviation in calibration.assumed.items()
        )
        lines.append(f"held, as the data leave them open: {terms}")
    camera = calibration.camera
    if calibration.evaluation.unit != "px":
        lines += [
            f"lengths go with the stated width of pixels, {camera.pixel_size:.4g} mm: where it is 1 % more, "
            "mla_distance and pitch are 1 % more, detector_distance 2 %",
            f"mla_focal_length {camera.mla_focal_lengths[0]:.4g} mm is assumed: corners do not tell it",
        ]
    lines.append(f"poses left out one by one: {rms(calibration.held_out[:, None]):.4f} {calibration.evaluation.unit}")
    lines.append(
        f"boards in other poses are predicted to {calibration.prediction_deviation:.2g} {calibration.evaluation.unit}"
    )
    if calibration.by_frames:
        lines.append(
            f"frames disagree {calibration.disagreement:.1f} times as much as their own scatter explains, so that the "
            "model misses something: deviations are those of leaving out frames"
            + "; if the board is not flat, --bent fits its shape"
            * (not len(calibration.board_heights))
        )
    if len(calibration.board_heights):
        low, high = calibration.board_heights.min(), calibration.board_heights.max()
        lines.append(f"the shape of the board: corners lie {low:+.3f} to {high:+.3f} mm behind a plane")
    lines += outlier_lines(calibration.evaluation, most)
    if len(calibration.centre_outliers):
        rows = listed((calibration.centre_outliers + 2).tolist(), most)
        lines.append(f"{len(calibration.centre_outliers)} centres not used, in lines {rows}")
    if calibration.centre_error is not None:
        lines.append(
            f"centres of micro-images {calibration.centre_error:.4f} px RMS over {len(calibration.centre_residuals)}"
        )
    return [*lines, error_line(calibration.evaluation)]


def outlier_lines(evaluation: Evaluation, most: int) -> list[str]:
    """Return lines on the rows that are outliers, and the error without them; none if there are none."""
    rows = evaluation.outliers
    if not len(rows):
        return []
    poses, counts = np.unique(evaluation.pose[rows], return_counts=True)
    frames = ", ".join(f"{n} of {frame}" for n, frame in zip(counts, evaluation.frames[poses], strict=True))
    return [
        f"{len(rows)} outliers, in lines {listed((rows + 2).tolist(), most)}; by frame: {frames}",
        f"without outliers {evaluation.error_without_outliers:.4f} {evaluation.unit} over "
        f"{len(evaluation.residuals) - len(rows)} observations",
    ]


def error_line(evaluation: Evaluation) -> str:
    """Return the line on the error of all rows."""
    count = len(evaluation.residuals)
    error = f"{evaluation.error:.4f} {evaluation.unit}"
    return f"reprojection error {error} over {count} observations of {len(evaluation.frames)} poses"


def listed(items: Sequence[object], most: int) -> str:
    """Return the first items of a list as text."""
    more = "" if len(items) <= most else f" and {len(items) - most} more; the file has them all"
    return ", ".join(map(str, items[:most])) + more


def fit_covariance(problem: Problem, fit: Adjusted, weights: Array) -> tuple[Array, float, bool, Array]:
    """Return the covariance of a fit's parameters, of which none is held fixed, and how frames disagree.

    That is by how much they disagree about the parameters, over what their residuals' scatter explains, and whether
    this is more than chance allows, so that the covariance is that of leaving out frames. Last, the RMS error of each
    pose for a camera fitted to the others, to first order. Shapes: `weights` (n,).
    """
    count = len(fit.numbers)
    _, blocks = problem.blocks(fit.numbers, fit.poses, weights, np.arange(count))
    scale = np.sqrt((np.concatenate(blocks)[:, :count] ** 2).sum(0))
    blocks = [block / np.append(scale, 1.0) for block in blocks]
    row_counts = 2 * np.bincount(problem.corners.pose, weights > 0)
    squares = (weights[:, None] * problem.residuals(fit.numbers, fit.poses) ** 2).sum()
    variance = float(squares) / max(1, row_counts.sum() - count - fit.poses.size)
    inverse = np.linalg.pinv(np.linalg.qr(np.concatenate(blocks)[:, :count], mode="r"))
    covariance = variance * inverse @ inverse.T
    frames = len(row_counts)
    moved = 0.0
    freedom = -count
    for block, values in zip(blocks, row_counts, strict=False):
        # The triangle's last column: what the parameters can explain of the frame's residuals, and what is left of
        # them.
        left_over = int(values) - fit.poses.shape[1] - count
        if left_over > 0:
            scatter = float(block[count, -1] ** 2) / left_over
            # a frame's scatter is well measured from a hundred degrees of freedom on
            moved += float((block[:count, -1] ** 2).sum()) / (scatter if left_over > 100 else max(scatter, variance))
            freedom += count
    disagreement = max(1.0, moved / freedom) if freedom > 0 else 1.0
    by_frames = freedom > 0 and disagreement > chi2.ppf(1 - 1e-3, freedom) / freedom
    others = [np.concatenate(blocks[:g] + blocks[g + 1 :]) for g in range(frames)]
    without = np.array([np.linalg.lstsq(block[:, :count], block[:, -1])[0] for block in others])
    left_out = [np.linalg.norm(block[:, :count] @ x - block[:, -1]) for block, x in zip(blocks, without, strict=False)]
    held_out = np.array(left_out) / np.sqrt(np.bincount(problem.corners.pose, weights))
    if by_frames:
        without -= without.mean(0)
        # From few frames the variance itself is uncertain, and errors over it follow Student's distribution.
        student = (frames - 1) / max(frames - 3, 0.5)
        covariance = covariance + student * (frames - 1) / frames * without.T @ without
    else:
        covariance = covariance * disagreement
    if problem.grid is not None and problem.centres is not None:
        # Of views the white picture's scale along x and y is the scale of the distances, which its centres' scatter
        # does not tell.
        places, by_numbers = predict_centres(fit.numbers, problem.centres.lens, **problem.geometry)
        moved_by = np.einsum("na,nak->ka", SCALE_ERROR * (places - places.mean(0)), by_numbers) / scale[:, None]
        moved_by = problem.centre_weight**2 * inverse @ inverse.T @ moved_by
        covariance = covariance + moved_by @ moved_by.T
    return covariance / np.outer(scale, scale), float(np.sqrt(disagreement)), bool(by_frames), held_out


def moved_solutions(problem: Problem, fit: Adjusted, weights: Array, covariance: Array) -> list[Adjusted]:
    """Return solutions one standard deviation away along each independent combination of parameters, poses refitted.

    For any quantity that follows from parameters and poses, the squared changes add up to its variance.
    """
    heads, _ = problem.blocks(fit.numbers, fit.poses, weights, np.arange(len(fit.numbers)))
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    moved = []
    for step in (vectors * np.sqrt(values.clip(0))).T * scale:
        poses = [-np.linalg.solve(head[:, :6], head[:, 6:-1] @ step) for head in heads]
        moved.append(Adjusted(fit.numbers + step, fit.poses + poses, fit.cost))
    return moved


def prediction_deviation(problem: Problem, fit: Adjusted, covariance: Array) -> float:
    """Return the RMS displacement, in pixels, of corners of turned boards due to errors of the parameters."""
    observed = problem.corners
    count = len(fit.numbers)
    middle = np.append((observed.board.min(0) + observed.board.max(0)) / 2, 0.0)
    square = 0.0
    rows = 0
    for turn in np.deg2rad(30) * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]):
        old = Rotation.from_rotvec(fit.poses[:, :3])
        new = Rotation.from_rotvec(turn) * old
        translation = fit.poses[:, 3:] + old.apply(middle) - new.apply(middle)
        poses = np.concatenate([new.as_rotvec(), translation], axis=1)
        # A corner within the focal length has no image.
        imaged = np.isfinite(problem.residuals(fit.numbers, poses)).all(1)
        turned = replace(problem, corners=observed.keep(imaged), centres=None)
        _, blocks = turned.blocks(fit.numbers, poses, np.ones(imaged.sum()), np.arange(count))
        by_numbers = np.concatenate(blocks)[:, :count]
        square += float(((by_numbers @ covariance) * by_numbers).sum())
        rows += int(imaged.sum())
    return float(np.sqrt(square / rows)) if rows else np.inf
