r"""A sharp view of a board from the raw picture of a focused camera, and where OpenCV finds the board in it.

With C the centre of a micro-image, a point is seen in it at :math:`p = C + \sigma (C - Q)`: Q is where the point would
be seen through a lens on the line to the main lens's centre, and :math:`\sigma` its disparity, the same for all points
of one depth. Both are in pixels of the raw picture and ask for no number of the camera. A view takes each place Q from
the nearest lenses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ..camera import PlenopticCamera
from ..errors import InputError
from ..runtime.variant import set_variant
from .observations import Board

# Disparities that are tried: below, a micro-image shows too little of the scene, above, too few lenses see a point.
_LEAST, _MOST, _COUNT = 0.04, 0.6, 28

# Places at which lenses are compared, about; and the best disparities at which the board is looked for.
_TRIED = 30_000
_LOOKED_AT = 6

# Lenses of which a place of the view is the mean.
_LENSES = 3


@dataclass(frozen=True)
class Picture:
    """A raw picture over its white image, and where its micro-images are."""

    name: str
    # Values over those of white; (rows, columns).
    image: np.ndarray
    # How much light white gives, at most 1; 0 where that is too little; (rows, columns).
    weight: np.ndarray
    # Centres of micro-images, column and row; (n, 2).
    centre: np.ndarray
    # Of the micro-images in pixels.
    radius: float
    # Distance from their centres up to which the main lens's rim takes no light from them.
    even: float


@dataclass(frozen=True)
class BoardView:
    """Where a board is, roughly."""

    disparity: float
    # Places Q of its inner corners; columns run to the right and rows down; (rows, columns, 2).
    corners: np.ndarray


def find_board(picture: Picture, board: Board) -> BoardView:
    """Find a board in a raw picture."""
    try:
        import cv2
    except ImportError:
        raise InputError("detecting corners needs a package: pip install 'mitsuba-plenoptic[calibration]'") from None
    tree = cKDTree(picture.centre)
    for disparity in _disparities(picture, tree)[:_LOOKED_AT]:
        step = max(1.0, 0.6 / abs(disparity))
        places = _places(picture, step)
        flat = places.reshape(-1, 2)
        view = _seen(picture, flat, tree.query(flat, k=_LENSES)[1], disparity)[0].reshape(places.shape[:2])
        if not np.isfinite(view).any():
            continue
        low, high = np.percentile(view[np.isfinite(view)], [2, 98])
        grey = np.nan_to_num((view - low) / max(high - low, 1e-12)).clip(0, 1)
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        # The other detector, findChessboardCornersSB, finds corners in noise here, others each time.
        found, corners = cv2.findChessboardCorners(
            (255 * grey).astype(np.uint8), (board.columns, board.rows), flags=flags
        )
        if found:
            return BoardView(disparity, _upright(corners.reshape(board.rows, board.columns, 2) * step))
    raise InputError(
        f"{picture.name}: no checkerboard of {board.columns}x{board.rows} inner corners is seen in it, whole, at any "
        "distance at which several lenses see each corner"
    )


def _upright(corners: np.ndarray) -> np.ndarray:
    """Let the columns run to the right and the rows down, as on a board that is seen from its front."""
    if (corners[:, -1] - corners[:, 0])[:, 0].sum() < 0:
        corners = corners[::-1, ::-1]
    along, across = (corners[:, -1] - corners[:, 0]).sum(0), (corners[-1] - corners[0]).sum(0)
    return corners if along[0] * across[1] > along[1] * across[0] else corners[::-1]


def _disparities(picture: Picture, tree: cKDTree) -> np.ndarray:
    """Return disparities, the one first at which neighbouring lenses agree best about what they see."""
    sizes = np.geomspace(_LEAST, _MOST, _COUNT)
    disparities = np.concatenate([sizes, -sizes])
    place = _places(picture, max(picture.radius, np.sqrt(picture.image.size / _TRIED))).reshape(-1, 2)
    _, lens = tree.query(place, k=_LENSES)
    errors = []
    for disparity in disparities:
        view, spread = _seen(picture, place, lens, disparity)
        known = np.isfinite(spread)
        total = np.var(view[known]) if known.sum() > 0.1 * known.size else 0.0
        errors.append(float(spread[known].mean() / total) if total > 0 else np.inf)
    return disparities[np.argsort(errors)]


def _places(picture: Picture, step: float) -> np.ndarray:
    """Return a grid of places, (rows, columns, 2), so many pixels apart."""
    rows, columns = picture.image.shape
    return np.stack(np.meshgrid(np.arange(0, columns, step), np.arange(0, rows, step)), axis=-1)


def _seen(picture: Picture, place: np.ndarray, lens: np.ndarray, disparity: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what lenses show of places: the mean, and the variance between them where several see the place, or NaN.

    `place` is (n, 2), `lens` (n, lenses).
    """
    centre = picture.centre[lens]
    arm = disparity * (centre - place[:, None])
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


# What lies behind the board is hidden by its margin of so many squares.
_MARGIN = 1.0


def board_scene(
    board: Board, pose: np.ndarray, camera: PlenopticCamera, *, dark: float = 0.1, light: float = 1.0, spp: int = 16
) -> Any:
    """Return a Mitsuba scene of a board that shines evenly, before a camera.

    Parameters
    ----------
    board : Board
        The board. It has a square more than corners along each axis, and a white margin of one square.
    pose : (6,) array
        Rotation vector in radians and place of its first inner corner in mm, from the board's to the camera frame, as
        `Calibration` gives them. The board's front is towards -z in its own frame.
    camera : PlenopticCamera
        The camera, at the origin.
    dark, light : float
        Radiance of the squares. The first corner's upper left square is dark.
    spp : int
        Samples for each pixel.

    Returns
    -------
    mitsuba.Scene
        In the active variant, or ``llvm_ad_mono`` if none is.
    """
    set_variant(None)
    rotation = Rotation.from_rotvec(pose[:3]).as_matrix()
    squares = np.array([board.columns + 1, board.rows + 1])

    def rectangle(margin: float, back: float) -> Any:
        # The rectangle's front is its own +z: turned to the board's -z, which turns its y, too.
        half = (squares / 2 + margin) * board.square
        middle = np.array([*(squares / 2 - 1) * board.square, back])
        matrix = np.eye(4)
        matrix[:3, :3] = rotation @ np.diag([half[0], -half[1], -1.0])
        matrix[:3, 3] = rotation @ middle + pose[3:]
        return mi.ScalarTransform4f(matrix)

    def shining(radiance: Any, to_world: Any) -> dict[str, Any]:
        return {
            "type": "rectangle",
            "to_world": to_world,
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
            "squares": shining(texture, rectangle(0.0, 0.0)),
            "margin": shining(light, rectangle(_MARGIN, 1e-3 * board.square)),
        }
    )
