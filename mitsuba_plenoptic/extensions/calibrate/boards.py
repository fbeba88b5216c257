r"""Corners of checkerboards in raw pictures: a sharp view of the board, in which OpenCV finds the corners.

With C the centre of a micro-image, a point is seen in it at :math:`p = C + \sigma (C - Q)`: Q is where the point would
be seen through a lens on the line to the main lens's centre, and :math:`\sigma` its disparity, the same for all points
of one depth. Both are in pixels of the raw picture and need no parameter of the camera. A view takes each position Q
from the nearest lenses.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import erf

from ...camera import PlenopticCamera
from ...errors import InputError, require_module
from ...runtime import Array, Named, Pair, Triple, set_variant
from .observations import Board

# Lenses of which a position of the view is the mean.
_LENSES = 3


@dataclass(frozen=True)
class Picture:
    """A raw picture divided by its white image, with the centres of its micro-images."""

    name: str
    # Values over those of white; (rows, columns).
    image: Array
    # How much light white gives, at most 1; 0 where that is too little; (rows, columns).
    weight: Array
    # Column and row of the micro-images' centres, (n, 2).
    centre: Array
    # Of the micro-images in pixels.
    radius: float
    # Distance from their centres up to which the main lens's rim takes no light from them.
    even: float


def find_board(picture: Picture, board: Board) -> tuple[float, Array]:
    """Return the disparity of a board found in a raw picture, and positions Q of its corners (rows, columns, 2).

    Columns run to the right and rows down, as seen from the front of the board.
    """
    cv2 = require_module("cv2", "detecting corners needs a package: pip install 'mitsuba-plenoptic[calibration]'")
    tree = cKDTree(picture.centre)
    for disparity in _disparities(picture, tree)[:6]:
        step = max(1.0, 0.6 / abs(disparity))
        positions = _positions(picture, step)
        flat = positions.reshape(-1, 2)
        view = _seen(picture, flat, tree.query(flat, k=_LENSES)[1], disparity)[0].reshape(positions.shape[:2])
        if not np.isfinite(view).any():
            continue
        low, high = np.nanpercentile(view, [2, 98])
        grey = np.nan_to_num((view - low) / max(high - low, 1e-12)).clip(0, 1)
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        # The other detector, findChessboardCornersSB, finds corners in noise here, others each time.
        is_board, corners = cv2.findChessboardCorners(
            (255 * grey).astype(np.uint8), (board.columns, board.rows), flags=flags
        )
        if is_board:
            corners = corners.reshape(board.rows, board.columns, 2) * step
            if (corners[:, -1] - corners[:, 0])[:, 0].sum() < 0:
                corners = corners[::-1, ::-1]
            along = (corners[:, -1] - corners[:, 0]).sum(0)
            across = (corners[-1] - corners[0]).sum(0)
            return disparity, corners if np.linalg.det([along, across]) > 0 else corners[::-1]
    raise InputError(
        f"{picture.name}: no checkerboard of {board.columns}x{board.rows} inner corners is seen in it, whole, at any "
        "distance at which several lenses see each corner"
    )


def _disparities(picture: Picture, tree: cKDTree) -> Array:
    """Return candidate disparities, sorted by how well neighbouring lenses agree about the picture."""
    # disparities: below, a micro-image shows too little of the scene; above, too few lenses see a point
    sizes = np.geomspace(0.04, 0.6, 28)
    disparities = np.concatenate([sizes, -sizes])
    position = _positions(picture, max(picture.radius, np.sqrt(picture.image.size / 30_000))).reshape(-1, 2)
    _, lens = tree.query(position, k=_LENSES)
    errors = []
    for disparity in disparities:
        view, spread = _seen(picture, position, lens, disparity)
        finite = np.isfinite(spread)
        total = np.var(view[finite]) if finite.sum() > 0.1 * finite.size else 0.0
        errors.append(float(spread[finite].mean() / total) if total > 0 else np.inf)
    return disparities[np.argsort(errors)]


def _positions(picture: Picture, step: float) -> Array:
    """Return a grid of positions (rows, columns, 2) with a given spacing in pixels."""
    rows, columns = picture.image.shape
    return np.stack(np.meshgrid(np.arange(0, columns, step), np.arange(0, rows, step)), axis=-1)


def _seen(picture: Picture, position: Array, lens: Array, disparity: float) -> Pair:
    """Return the mean, over lenses, of their views of positions, and its variance (NaN for a single view).

    `position` is (n, 2), `lens` (n, lenses).
    """
    centre = picture.centre[lens]
    arm = disparity * (centre - position[:, None])
    at = (centre + arm)[:, :, ::-1].transpose(2, 0, 1)
    weight = map_coordinates(picture.weight, at, order=1, mode="constant")
    weight *= np.hypot(*arm.transpose(2, 0, 1)) < picture.radius - 0.5
    value = map_coordinates(picture.image, at, order=1, mode="nearest")
    total = weight.sum(1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = (weight * value).sum(1) / total
        spread = (weight * (value - mean[:, None]) ** 2).sum(1) / total
    spread[(weight > 0).sum(1) < 2] = np.nan
    return mean, spread


def board_scene(
    board: Board, pose: Array, camera: PlenopticCamera, *, dark: float = 0.1, light: float = 1.0, spp: int = 16
) -> Any:
    """Return a Mitsuba scene of a uniformly luminous board in front of a camera.

    Parameters
    ----------
    board : Board
        The board. It has a square more than corners along each axis, and a white margin of one square.
    pose : (6,) array
        Rotation vector in radians and position of its first inner corner in mm, from the board's to the camera frame,
        as `Calibration` gives them. The board's front is towards -z in its own frame.
    camera : PlenopticCamera
        The camera, at the origin.
    dark, light : float
        Radiance of the squares. The first corner's upper left square is dark.
    spp : int
        Samples for each pixel.

    Returns
    -------
    mitsuba.Scene
        The scene in the active variant, or in ``llvm_ad_mono`` if none is active.
    """
    set_variant(None)
    rotation = Rotation.from_rotvec(pose[:3]).as_matrix()
    squares = np.array([board.columns + 1, board.rows + 1])

    def shining(radiance: Any, margin: float, back: float) -> Named:
        # The rectangle's front is its own +z: turned to the board's -z, which turns its y, too.
        half = (squares / 2 + margin) * board.square
        matrix = np.eye(4)
        matrix[:3, :3] = rotation * [half[0], -half[1], -1.0]
        matrix[:3, 3] = rotation @ [*(squares / 2 - 1) * board.square, back] + pose[3:]
        return {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f(matrix),
            "emitter": {"type": "area", "radiance": radiance},
            "bsdf": {"type": "diffuse", "reflectance": 0.0},
        }

    # Two periods of the texture are a unit of it; its rows rise with the rectangle's y, that is against the board's.
    first = [light, dark] if board.rows % 2 else [dark, light]
    texture = {
        "type": "checkerboard",
        "color0": first[0],
        "color1": first[1],
        "to_uv": mi.ScalarTransform3f().scale(mi.ScalarPoint2f(squares / 2)),
    }
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 1},
            "sensor": camera.to_sensor() | {"sampler": {"type": "independent", "sample_count": spp}},
            "squares": shining(texture, 0.0, 0.0),
            "margin": shining(light, 1.0, 1e-3 * board.square),
        },
        parallel=False,
    )


# Radius of the window about a corner: pixels at least, and the fraction of the micro-image's radius at most.
_WINDOW = 0.6

# A corner moves by no more than this from where it was looked for, in pixels.
_FARTHEST = 3.0


@dataclass(frozen=True)
class Saddles:
    """Candidates for corners, as arrays with one row per candidate."""

    # Column and row of the corner, 0 at the centre of the first pixel, (n, 2).
    position: Array
    # Standard deviation of the position along its worse direction, from what the fit leaves; (n,).
    deviation: Array
    # Half the difference between light and dark squares; (n,).
    contrast: Array


def find_saddles(
    image: Array,
    weight: Array,
    position: Array,
    angles: Array,
    centre: Array,
    *,
    radius: float,
    even: float,
    displacement: Callable[[Array, Array], Array] | None = None,
) -> Saddles:
    """Return corners refined by least squares, each within a window in its micro-image.

    Shapes: `image`, `weight` (rows, columns), `position` (n, 2), `angles` (n, 2), `centre` (n, 2).
    """
    half = int(np.ceil(_WINDOW * radius))
    steps = np.indices((2 * half + 1,) * 2)[::-1].reshape(2, -1).T - half

    def fitted(rows: Array) -> Triple:
        start = position[rows]
        # Cut off at the rim of the micro-image alone, a window would draw the corner to one side.
        reach = (radius - np.hypot(*(start - centre[rows]).T)).clip(2.0, _WINDOW * radius)[:, None]
        pixel = np.round(start).astype(int)[:, None] + steps
        x, y = (pixel[:, :, axis].clip(0, image.shape[1 - axis] - 1) for axis in (0, 1))
        arm = pixel - centre[rows][:, None]
        shown_at = pixel if displacement is None else pixel + displacement(rows, arm)
        # A window with a soft rim that is symmetrical about the corner, without what is beyond the evenly lit part.
        w = weight[y, x] * (reach + 0.5 - np.hypot(*np.moveaxis(shown_at - start[:, None], 2, 0))).clip(0, 1)
        w *= np.hypot(*np.moveaxis(arm, 2, 0)) < even
        w *= (pixel == np.stack([x, y], axis=-1)).all(2)
        return located(shown_at, image[y, x], w, start, angles[rows])

    blocks = np.array_split(np.arange(len(position)), max(1, -(-len(position) // 2048)))
    return Saddles(*map(np.concatenate, zip(*map(fitted, blocks), strict=True)))


def located(shown_at: Array, value: Array, w: Array, start: Array, angles: Array) -> Triple:
    """Return the `Saddles` (n,) fitted to weighted values at places (n, pixels, 2), as a tuple."""
    total = w.sum(1)
    p = np.column_stack([start, angles, np.full(len(start), np.log(1.2))])
    p, linear, square, information = _descend(shown_at, value, w, p)
    covariance = np.linalg.pinv(information[:, :2, :2]) * (square / np.maximum(total - 7, 1))[:, None, None]
    deviation = np.sqrt(np.linalg.eigvalsh(covariance)[:, 1].clip(0))
    good = (total > 12) & (np.hypot(*(p[:, :2] - start).T) < _FARTHEST)
    return p[:, :2], np.where(good, deviation, np.inf), np.abs(linear[:, 1])


def _descend(pixel: Array, value: Array, w: Array, p: Array) -> tuple[Array, Array, Array, Array]:
    """Return position, angles and blur of a corner that minimise the residual; level and contrast follow."""
    position = p[:, :2].copy()
    linear, square, jacobian, residual = best = _model(pixel, value, w, p)
    damping = np.full(len(p), 1e-2)
    low, high = np.log([0.3, 6.0])
    for _ in range(12):
        matrix = np.einsum("npa,np,npb->nab", jacobian, w, jacobian, optimize=True)
        slope = np.einsum("npa,np,np->na", jacobian, w, residual, optimize=True)
        scale = np.einsum("naa->na", matrix) + 1e-12
        damped = matrix + (damping[:, None] * scale)[:, :, None] * np.eye(5)
        new = p + np.linalg.solve(damped, slope[:, :, None])[:, :, 0].clip(-1, 1)
        new[:, :2] = position + (new[:, :2] - position).clip(-_FARTHEST, _FARTHEST)
        new[:, 4] = new[:, 4].clip(low, high)
        tried = _model(pixel, value, w, new)
        better = tried[1] < square
        damping = np.where(better, damping / 5, damping * 5).clip(1e-6, 1e6)
        for values, others in zip((p, *best), (new, *tried), strict=True):
            values[better] = others[better]
    information = np.einsum("npa,np,npb->nab", jacobian, w, jacobian, optimize=True)
    return p, linear, square, information


def _model(pixel: Array, value: Array, w: Array, p: Array) -> tuple[Array, Array, Array, Array]:
    """Return level and contrast of a blurred corner's model, the sum of squares, its derivatives, and residuals."""
    arm = pixel - p[:, None, :2]
    blur = np.exp(p[:, 4])[:, None]
    # Of both edges: positions across and along them.
    angles = p[:, 2:4].T[:, :, None]
    cosine = np.cos(angles)
    sine = np.sin(angles)
    x, y = np.moveaxis(arm, 2, 0) / blur
    t = cosine * y - sine * x
    along = sine * y + cosine * x
    edges = erf(t)
    product = edges.prod(0)
    weights = w.sum(1) + 1e-30
    mean = (w * product).sum(1) / weights
    mean_value = (w * value).sum(1) / weights
    about = product - mean[:, None]
    contrast = (w * about * value).sum(1) / ((w * about * about).sum(1) + 1e-30)
    level = mean_value - contrast * mean
    residual = value - level[:, None] - contrast[:, None] * product
    by_t = 2 / np.sqrt(np.pi) * np.exp(-t * t) * contrast[:, None] * edges[::-1]
    by_x = (by_t * sine).sum(0) / blur
    by_y = -(by_t * cosine).sum(0) / blur
    jacobian = np.stack([by_x, by_y, *(-by_t * along), -(by_t * t).sum(0)], axis=-1)
    # What level and contrast make up for is no information.
    for base in (np.ones_like(product), about):
        projection = np.einsum("np,np,npa->na", w, base, jacobian) / ((w * base * base).sum(1) + 1e-30)[:, None]
        jacobian -= base[:, :, None] * projection[:, None]
    return np.stack([level, contrast], axis=-1), (w * residual * residual).sum(1), jacobian, residual
