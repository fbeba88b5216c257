"""A camera like a small Raytrix with tilt and distortion, boards before it, and corners seen through its lenses."""

import os
from functools import lru_cache
from pathlib import Path

import numpy as np

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.calibration import Board, LensIndex, Table
from mitsuba_plenoptic.extensions.calibrate.board_model import Observations, numbers_of, predict, predict_centres

REAL = Path(os.environ.get("MITSUBA_PLENOPTIC_DATA", "data")) / "raytrix_r12a"

CAMERA = PlenopticCamera.preset("raytrix").replace(
    resolution=(2100, 1540), crop_size=(2000, 1500), crop_offset=(60, 0), detector_width=2100 * 0.0055,
    mla_pitch=(0.12744, 0.1275), mla_rotation=0.3, mla_offset=(0.02, -0.03), mla_tilt=(0.05, -0.04),
    distortion=(3e-4, -2e-6, 1e-8, -1e-4, 5e-5),
)  # fmt: skip
BOARD = Board(6, 4, 6.0)
INDEX = LensIndex(-0.5, 1, (40, 36))
POSES = np.array(
    [
        [0.10, 0.05, 3.10, 14, 9, 345],
        [0.55, -0.10, 3.15, 15, 8, 330],
        [-0.15, 0.60, 3.05, 13, 8, 310],
        [-0.45, -0.40, 3.20, 16, 9, 285],
        [0.05, -0.50, 3.12, 14, 7, 260],
        [0.30, 0.30, 3.00, 14, 9, 240],
    ]
)


def corners(noise: float = 0.0, seed: int = 0, poses: np.ndarray = POSES) -> tuple[Table, Observations]:
    """Corners that lenses see through the pupil, as a file has them and as a fit takes them."""
    k, l, pixel, corner, pose = _exact(tuple(map(tuple, poses.tolist())))  # noqa: E741
    pixel = pixel + np.random.default_rng(seed).normal(0, noise, pixel.shape)
    columns = {"k": k, "l": l, "u": pixel[:, 0], "v": pixel[:, 1], "cluster": corner, "frame": 10 + pose}
    return Table("corners.csv", columns), Observations(INDEX.unit(k, l), pixel, BOARD.places(corner), pose)


@lru_cache
def _exact(poses: tuple[tuple[float, ...], ...]) -> tuple[np.ndarray, ...]:
    """Lenses, pixels, corners and poses of what is seen, without noise."""
    numbers, geometry = numbers_of(CAMERA), {"pixel_size": 0.0055, "row_ratio": 0.75**0.5}
    k, l = (index.ravel() for index in np.mgrid[0:81, 0:73])  # noqa: E741
    unit = INDEX.unit(k, l)
    middle, _ = predict_centres(numbers, unit, **geometry)
    radius = 0.9 * CAMERA.micro_image_diameter / 2 / 0.0055
    inside = ((middle > radius) & (middle < np.array(CAMERA.crop_size) - 1 - radius)).all(1)
    k, l, unit, middle = k[inside], l[inside], unit[inside], middle[inside]  # noqa: E741
    found = []
    for pose in range(len(poses)):
        for corner in range(BOARD.columns * BOARD.rows):
            place = np.tile(BOARD.places(np.array([corner])), (len(unit), 1))
            seen = Observations(unit, middle, place, np.zeros(len(unit), dtype=int))
            pixel, _, _ = predict(numbers, np.array(poses[pose : pose + 1]), seen, **geometry)
            lit = np.hypot(*(pixel - middle).T) < radius
            same = np.ones(lit.sum(), dtype=int)
            found.append((k[lit], l[lit], pixel[lit], corner * same, pose * same))
    return tuple(np.concatenate(parts) for parts in zip(*found, strict=True))
