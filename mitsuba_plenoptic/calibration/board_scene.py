"""A scene of a checkerboard, for pictures of it by a camera."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from ..camera import PlenopticCamera
from ..runtime.variant import set_variant
from .observations import Board

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
