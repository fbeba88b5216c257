"""The model of boards and what it leaves: derivatives, corners, groups, lenses, arrows."""

import calibration_cases as cases
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mitsuba_plenoptic.calibration import Calibration, Evaluation
from mitsuba_plenoptic.extensions.calibrate.board_model import NAMES, numbers_of, predict, predict_centres
from mitsuba_plenoptic.extensions.calibrate.calibration_page import arrows, lens_errors, write_calibration_report
from mitsuba_plenoptic.extensions.calibrate.calibration_result import residual_map

TABLE, SEEN = cases.corners()
GEOMETRY = {"pixel_size": 0.0055, "row_ratio": 0.75**0.5}
ODD = (TABLE["k"] == TABLE["k"][500]) & (TABLE["l"] == TABLE["l"][500])


@pytest.fixture
def calibration():
    # Exact, but for one lens that shows everything two pixels to the right, and noise.
    residuals = np.random.default_rng(1).normal(0, 0.1, (len(SEEN), 2))
    residuals[ODD, 0] -= 2
    numbers = dict(zip(NAMES, numbers_of(cases.CAMERA).tolist(), strict=True))
    evaluation = Evaluation(residuals, np.unique(TABLE["frame"]), SEEN.pose, cases.POSES)
    exact = dict.fromkeys(numbers, 1.0), np.eye(len(numbers)), np.zeros((0, 2))
    left = None, 1.0, False, np.zeros(0, int), 0.0, evaluation.pose_errors, {}, np.zeros(0)
    return Calibration(cases.CAMERA, cases.INDEX, evaluation, numbers, *exact, *left)


@pytest.mark.parametrize(("by", "columns"), [("lens", 4), ("field", 2), ("depth", 2)])
def test_groups_add_up_to_all(calibration, by, columns):
    found = residual_map(calibration, cases.BOARD, TABLE, by)
    assert found.key.shape == (len(found.count), columns)
    assert found.count.sum() == len(SEEN)
    square = (found.error**2 * found.count).sum() / len(SEEN)
    assert np.sqrt(square) == pytest.approx(calibration.evaluation.error)
    mean = (found.mean * found.count[:, None]).sum(0) / len(SEEN)
    np.testing.assert_allclose(mean, -calibration.evaluation.residuals.mean(0), atol=1e-12)


def test_the_lens_that_errs_is_told(calibration):
    found = residual_map(calibration, cases.BOARD, TABLE, "lens")
    worst = int(found.error.argmax())
    assert tuple(found.key[worst, :2]) == (TABLE["k"][500], TABLE["l"][500])
    assert found.count[worst] == ODD.sum()
    assert found.mean[worst] == pytest.approx((2, 0), abs=0.3)
    unit = cases.INDEX.unit(TABLE["k"][500:501], TABLE["l"][500:501])
    middle, _ = predict_centres(numbers_of(cases.CAMERA), unit, **GEOMETRY)
    np.testing.assert_allclose(found.key[worst, 2:], middle[0], atol=1e-9)


def test_depths_are_those_of_the_boards(calibration):
    depth = residual_map(calibration, cases.BOARD, TABLE, "depth", 4)
    assert np.ptp(depth.count) <= 1
    assert (depth.key[1:, 0] >= depth.key[:-1, 1]).all()
    # The first corner of the nearest board is 240 mm away and that of the farthest 345 mm.
    assert 225 < depth.key[0, 0] < 245
    assert 345 <= depth.key[-1, 1] < 365


def test_the_report_shows_lenses_and_residuals(calibration, tmp_path, coarse_figures):
    write_calibration_report(tmp_path / "report.html", calibration, cases.BOARD, TABLE, None)
    text = (tmp_path / "report.html").read_text()
    assert "Error of the corners that each lens shows" in text and text.count("data:image/png") == 3
    assert "held out" in text
    lenses = residual_map(calibration, cases.BOARD, TABLE, "lens")
    (shown,) = lens_errors(lenses, calibration.camera.crop_size).axes[0].collections
    assert len(shown.get_offsets()) == len(lenses.count)
    assert shown.get_array().max() == lenses.error.max()


def test_arrows_are_residuals_a_hundred_times_as_long():
    plot = arrows(np.array([[100.0, 50.0]]), np.array([[0.25, -0.1]]), (400, 300))
    (arrow,) = plot.axes[0].collections
    # Pixels of the centre of the first are at 0.5; rows go down.
    assert arrow.get_offsets()[0] == pytest.approx((100.5, 50.5))
    assert (arrow.U[0], arrow.V[0]) == pytest.approx((25, -10))
    assert plot.axes[0].get_ylim() == (300, 0)


def slope(function, values, index):
    step = np.zeros_like(values)
    step[index] = max(abs(values[index]), {12: 1e-3, 13: 1e-5, 14: 1e-7}.get(index, 1e-3)) * 1e-5
    return (function(values + step) - function(values - step)) / (2 * step[index])


def test_derivatives_are_those_of_differences():
    numbers = numbers_of(cases.CAMERA)
    pixel, by_numbers, by_pose = predict(numbers, cases.POSES, SEEN, **GEOMETRY)
    _, of_centres = predict_centres(numbers, SEEN.lens, **GEOMETRY)
    for index in range(len(NAMES)):
        near = slope(lambda values: predict(values, cases.POSES, SEEN, **GEOMETRY)[0], numbers, index)
        assert np.abs(near - by_numbers[:, :, index]).max() < 1e-5 * np.abs(near).max(), NAMES[index]
        near = slope(lambda values: predict_centres(values, SEEN.lens, **GEOMETRY)[0], numbers, index)
        assert np.abs(near - of_centres[:, :, index]).max() < 1e-5 * max(np.abs(near).max(), 1e-9), NAMES[index]
    for index in range(6):
        moved = cases.POSES.copy()
        ends = []
        for sign in (1, -1):
            moved[:, index] = cases.POSES[:, index] + sign * 1e-5
            ends.append(predict(numbers, moved, SEEN, **GEOMETRY)[0])
        near = (ends[0] - ends[1]) / 2e-5
        assert np.abs(near - by_pose[:, :, index]).max() < 1e-5 * np.abs(near).max()
    assert np.abs(pixel - SEEN.pixel).max() < 1e-9


def test_the_sensor_sees_the_corners():
    # From the predicted pixel, rays through the middle of the lens's small aperture reach the corner on the board.
    sensor = mi.load_dict(cases.CAMERA.replace(mla_aperture="circle", mla_fill=1e-3).to_sensor())
    pixel = (SEEN.pixel + 0.5) / cases.CAMERA.crop_size
    n = len(pixel)
    middle = mi.Point2f(np.zeros((2, n), dtype=np.float32))
    ray, weight = sensor.sample_ray(0.0, 0.5, mi.Point2f(pixel.T.astype(np.float32)), middle)
    assert (weight.numpy() > 0).all()
    corner = np.concatenate([SEEN.board, np.zeros((n, 1))], axis=1)
    place = Rotation.from_rotvec(cases.POSES[SEEN.pose, :3]).apply(corner) + cases.POSES[SEEN.pose, 3:]
    origin, direction = (np.array(v, dtype=np.float64).T for v in (ray.o, ray.d))
    length = (place[:, 2] - origin[:, 2]) / direction[:, 2]
    miss = np.hypot(*(origin + length[:, None] * direction - place)[:, :2].T)
    # Of a board some 300 mm away: single precision, and a pixel is 0.1 mm there.
    assert np.sqrt((miss**2).mean()) < 3e-3
