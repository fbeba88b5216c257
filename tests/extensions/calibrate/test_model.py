"""The model of corners and centres: its derivatives, and the rays that the sensor traces."""

import calibration_cases as cases
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mitsuba_plenoptic.extensions.calibrate.board_model import NAMES, numbers_of, predict, predict_centres

GEOMETRY = {"pixel_size": 0.0055, "row_ratio": 0.75**0.5}


@pytest.fixture(scope="module")
def seen():
    return cases.corners()[1]


def slope(function, values, index):
    step = np.zeros_like(values)
    step[index] = max(abs(values[index]), {12: 1e-3, 13: 1e-5, 14: 1e-7}.get(index, 1e-3)) * 1e-5
    return (function(values + step) - function(values - step)) / (2 * step[index])


def test_derivatives_are_those_of_differences(seen):
    numbers = numbers_of(cases.CAMERA)
    pixel, by_numbers, by_pose = predict(numbers, cases.POSES, seen, **GEOMETRY)
    _, of_centres = predict_centres(numbers, seen.lens, **GEOMETRY)
    for index in range(len(NAMES)):
        near = slope(lambda values: predict(values, cases.POSES, seen, **GEOMETRY)[0], numbers, index)
        assert np.abs(near - by_numbers[:, :, index]).max() < 1e-5 * np.abs(near).max(), NAMES[index]
        near = slope(lambda values: predict_centres(values, seen.lens, **GEOMETRY)[0], numbers, index)
        assert np.abs(near - of_centres[:, :, index]).max() < 1e-5 * max(np.abs(near).max(), 1e-9), NAMES[index]
    for index in range(6):
        moved = cases.POSES.copy()
        ends = []
        for sign in (1, -1):
            moved[:, index] = cases.POSES[:, index] + sign * 1e-5
            ends.append(predict(numbers, moved, seen, **GEOMETRY)[0])
        near = (ends[0] - ends[1]) / 2e-5
        assert np.abs(near - by_pose[:, :, index]).max() < 1e-5 * np.abs(near).max()
    assert np.abs(pixel - seen.pixel).max() < 1e-9


def test_the_sensor_sees_the_corners(seen):
    # From the predicted pixel, rays through the middle of the lens's small aperture reach the corner on the board.
    sensor = mi.load_dict(cases.CAMERA.replace(mla_aperture="circle", mla_fill=1e-3).to_sensor())
    pixel = (seen.pixel + 0.5) / cases.CAMERA.crop_size
    n = len(pixel)
    middle = mi.Point2f(np.zeros((2, n), dtype=np.float32))
    ray, weight = sensor.sample_ray(0.0, 0.5, mi.Point2f(pixel.T.astype(np.float32)), middle)
    assert (weight.numpy() > 0).all()
    corner = np.concatenate([seen.board, np.zeros((n, 1))], axis=1)
    place = Rotation.from_rotvec(cases.POSES[seen.pose, :3]).apply(corner) + cases.POSES[seen.pose, 3:]
    origin, direction = (np.array(v, dtype=np.float64).T for v in (ray.o, ray.d))
    length = (place[:, 2] - origin[:, 2]) / direction[:, 2]
    miss = np.hypot(*(origin + length[:, None] * direction - place)[:, :2].T)
    # Of a board some 300 mm away: single precision, and a pixel is 0.1 mm there.
    assert np.sqrt((miss**2).mean()) < 3e-3
