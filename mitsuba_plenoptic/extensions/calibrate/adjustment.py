"""Bundle adjustment: least squares for one camera and many poses of a board, with the deviation of each parameter.

Levenberg and Marquardt's method with exact derivatives. The six parameters of each pose are eliminated by an orthogonal
(QR) step before the camera's are solved for, so that normal equations, which square the condition number, are never
formed (B. Triggs et al., "Bundle adjustment - a modern synthesis", 2000, section 6).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ...errors import refuse_if
from ...runtime import Array, Pair, Triple, single_threaded_blas
from .board_model import AT, NAMES, Observations, predict, predict_centres

# Rows beyond this number of deviations are outliers: they are named, and do not count in a fit. In data with normal
# errors one row in 60 million lies there.
OUTLIER = 6.0


def deviation(distance: Array) -> float:
    """Return the standard deviation along one axis, estimated from the median of two-dimensional distances."""
    return float(np.median(distance)) / 1.17741


def rms(residuals: Array) -> float:
    """Return the root mean square of two-dimensional distances."""
    return float(np.sqrt((residuals**2).sum(1).mean()))


def outlying(distance: Array) -> Array:
    """Return a mask of outliers by their distance from the expected position."""
    return distance > OUTLIER * max(deviation(distance), 1e-9)


def huber(distance: Array) -> Array:
    """Return Huber's weights for robust fits: beyond a limit, residuals count by their size instead of its square."""
    bound = 4.0 * max(deviation(distance), 1e-9)
    return bound / np.maximum(distance, bound)


def robust_lines(matrix: Array, values: Array) -> Triple:
    """Return coefficients that solve linear equations for positions, if more than half of the equations hold.

    The least sum of distances shows which rows are outliers; the others are then fitted by least squares.

    Shapes: `matrix` (n, 2, k), `values` (n, 2); the result (k,), (n,), (n,).
    """
    scale = np.sqrt((matrix**2).sum((0, 1)))
    matrix = matrix / np.where(scale > 0, scale, 1)

    def solve(weights: Array) -> Pair:
        root = np.sqrt(weights)
        rows = (matrix * root[:, None, None]).reshape(-1, matrix.shape[2])
        solution = np.linalg.lstsq(rows, (values * root[:, None]).ravel())[0]
        return solution, np.hypot(*(matrix @ solution - values).T)

    solution, distance = solve(np.ones(len(values)))
    last = np.inf
    for _ in range(30):
        total = float(distance.sum())
        if not total < 0.999 * last:
            break
        last = total
        solution, distance = solve(1 / np.maximum(distance, 1e-3 * np.median(distance) + 1e-12))
    good = ~outlying(distance)
    for _ in range(30):
        solution, distance = solve(good.astype(float))
        before = good
        good = ~outlying(distance)
        if (before == good).all():
            break
    return solution / np.where(scale > 0, scale, 1), distance, good


def both_axes(matrix: Array) -> Array:
    """Return the matrix (n, 2, 2 k) that applies a matrix (n, k) to x and to y, with coefficients for each axis."""
    return np.kron(np.eye(2), matrix[:, None])


@dataclass(frozen=True)
class Problem:
    """Corners and centres that are fitted together, with their weights."""

    # Corners seen through lenses.
    corners: Observations
    pixel_size: float
    row_ratio: float
    # Centres of micro-images, fitted jointly; their `board` and `pose` mean nothing.
    centres: Observations | None = None
    # Weight of a centre's residual: the deviation of a corner over that of a centre.
    centre_weight: float = 1.0
    # Places of lenses in pixels, (3, 2), if corners are seen in views, as for `predict`.
    grid: Array | None = None
    # Numbers that are roughly known beforehand, and the weights of the differences from them, (2, 17).
    known: Array = field(default_factory=lambda: np.zeros((2, len(NAMES))))

    @property
    def observed(self) -> Array:
        """What is predicted, as it was observed: pixels, or the positions of lenses in views in pitches."""
        return self.corners.pixel if self.grid is None else self.corners.lens * [1.0, self.row_ratio]

    @property
    def geometry(self) -> dict[str, float]:
        """The numbers of the camera that are not fitted."""
        return {"pixel_size": self.pixel_size, "row_ratio": self.row_ratio}

    def residuals(self, numbers: Array, poses: Array) -> np.ndarray:
        """Return predicted minus observed positions of the corners, (n, 2)."""
        off = -self.observed
        with np.errstate(all="ignore"):
            # Pose by pose, as derivatives of all corners take much memory.
            for pose in range(len(poses)):
                rows = self.corners.pose == pose
                off[rows] += predict(numbers, poses, self.corners.keep(rows), grid=self.grid, **self.geometry)[0]
        return off

    def centre_residuals(self, numbers: Array) -> Array:
        """Return predicted minus observed pixels of the centres, (n, 2)."""
        if self.centres is None:
            return np.zeros((0, 2))
        return predict_centres(numbers, self.centres.lens, **self.geometry)[0] - self.centres.pixel

    def cost(self, numbers: Array, poses: Array, weights: Array) -> float:
        """Return half the weighted sum of squared residuals; infinite where the model has no value."""
        square = (weights * (self.residuals(numbers, poses) ** 2).sum(1)).sum()
        square += self.centre_weight**2 * (self.centre_residuals(numbers) ** 2).sum()
        square += ((self.known[1] * (numbers - self.known[0])) ** 2).sum()
        return 0.5 * float(square) if np.isfinite(square) else np.inf

    def blocks(self, numbers: Array, poses: Array, weights: Array, free: Array) -> tuple[list[Array], list[Array]]:
        """Return the weighted linear system's triangular factor for each pose, and its rows for the camera alone.

        The result has the shape (6, 6 + free + 1), (rows, free + 1).
        """
        triangles = []
        for pose in range(len(poses)):
            chosen = self.corners.pose == pose
            corners = self.corners.keep(chosen)
            pixel, by_numbers, by_pose = predict(numbers, poses, corners, grid=self.grid, **self.geometry)
            off = (self.observed[chosen] - pixel)[:, :, None]
            rows = np.concatenate([by_pose, by_numbers[:, :, free], off], axis=2)
            triangles.append(_triangle(rows * np.sqrt(weights[chosen])[:, None, None]))
        camera = [triangle[6:, 6:] for triangle in triangles]
        if self.centres is not None:
            pixel, by_numbers = predict_centres(numbers, self.centres.lens, **self.geometry)
            rows = np.concatenate([by_numbers[:, :, free], (self.centres.pixel - pixel)[:, :, None]], axis=2)
            camera.append(_triangle(self.centre_weight * rows))
        if self.known[1].any():
            value, weight = self.known
            camera.append(np.column_stack([np.diag(weight)[:, free], weight * (value - numbers)]))
        return [triangle[:6] for triangle in triangles], camera


def _triangle(rows: Array) -> Array:
    """Return the triangular factor of a matrix or of stacked ones, with at least as many rows as columns."""
    rows = rows.reshape(-1, rows.shape[-1])
    return np.asarray(np.linalg.qr(np.pad(rows, ((0, max(0, rows.shape[1] - len(rows))), (0, 0))), mode="r"))


@dataclass(frozen=True)
class Adjusted:
    """Parameters, poses and residuals that an adjustment has found."""

    # (17,).
    numbers: Array
    poses: Array
    # Half the weighted sum of squares.
    cost: float


@single_threaded_blas()
def adjust(
    problem: Problem,
    numbers: Array,
    poses: Array,
    free: Sequence[str] = NAMES,
    weights: Array | None = None,
    *,
    most_steps: int = 200,
) -> Adjusted:
    """Return the camera parameters and poses that minimise the weighted sum of squared residuals.

    A bent board's shape is fitted with any parameter of the camera. Shapes: `weights` (n,).
    """
    shape = range(len(NAMES), len(numbers)) if free else ()
    free_index = np.array([*(AT[name] for name in free), *shape], dtype=int)
    weights = np.ones(len(problem.corners)) if weights is None else weights
    cost = problem.cost(numbers, poses, weights)
    refuse_if(
        not np.isfinite(cost),
        "calibration: the camera cannot see the board at the start: its numbers do not fit the data",
    )
    damping = 1e-3
    steps = 0
    camera_scale = np.zeros(len(free_index))
    pose_scale = np.zeros((len(poses), 6))
    while steps < most_steps:
        triangles, camera_blocks = problem.blocks(numbers, poses, weights, free_index)
        camera = np.concatenate(camera_blocks)
        both = np.concatenate([*(triangle[:, 6:] for triangle in triangles), camera])
        camera_scale = np.maximum(camera_scale, np.sqrt((both[:, :-1] ** 2).sum(0)))
        pose_scale = np.maximum(pose_scale, [np.sqrt((triangle[:, :6] ** 2).sum(0)) for triangle in triangles])
        while True:
            steps += 1
            step, pose_steps = _solve(triangles, camera, np.sqrt(damping) * camera_scale, np.sqrt(damping) * pose_scale)
            new = numbers.copy()
            new[free_index] += step
            new_poses = poses + pose_steps
            new_cost = problem.cost(new, new_poses, weights)
            if new_cost <= cost:
                break
            damping *= 8
            if damping > 1e10:
                return Adjusted(numbers, poses, cost)
        gain = cost - new_cost
        numbers = new
        poses = new_poses
        cost = new_cost
        damping = max(damping / 10, 1e-12)
        if gain <= 1e-8 * cost:
            break
    return Adjusted(numbers, poses, cost)


def adjust_poses(problem: Problem, numbers: Array, poses: Array, weights: Array) -> Array:
    """Return the poses of the board that fit best to a fixed camera.

    A flat board looks much the same tilted to either side (Necker's reversal); both are tried for each pose.
    """
    fitted = adjust(problem, numbers, poses, (), weights, most_steps=60).poses
    mirrored = adjust(problem, numbers, fitted * [-1, -1, 1, 1, 1, 1], (), weights, most_steps=60).poses
    squares = [
        np.bincount(problem.corners.pose, weights * (problem.residuals(numbers, candidate) ** 2).sum(1))
        for candidate in (fitted, mirrored)
    ]
    return np.where((squares[1] < squares[0])[:, None], mirrored, fitted)


def _solve(triangles: list[Array], camera: Array, camera_damping: Array, pose_damping: Array) -> Pair:
    """Return the steps of camera and poses that solve the damped linear system, its columns scaled to equal norms."""
    reduced = [camera, np.pad(np.diag(camera_damping), ((0, 0), (0, 1)))]
    heads = []
    for triangle, damping in zip(triangles, pose_damping, strict=True):
        damped = _triangle(np.concatenate([triangle, np.pad(np.diag(damping), ((0, 0), (0, triangle.shape[1] - 6)))]))
        heads.append(damped[:6])
        reduced.append(damped[6:, 6:])
    matrix = np.concatenate(reduced)
    scale = np.sqrt((matrix[:, :-1] ** 2).sum(0))
    scale[scale == 0] = 1
    step = np.linalg.lstsq(matrix[:, :-1] / scale, matrix[:, -1], rcond=1e-14)[0] / scale if scale.size else scale
    pose_steps = [np.linalg.solve(head[:, :6], head[:, -1] - head[:, 6:-1] @ step) for head in heads]
    return step, np.array(pose_steps)
