"""Blur radii tell the microlenses' focal lengths, whatever their scale and sign, and are refused where they do not."""

import json

import calibration_cases as cases
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mitsuba_plenoptic import InputError, calibrate
from mitsuba_plenoptic.calibration import Board, read_camera, read_centres, read_corners, write_calibration
from mitsuba_plenoptic.extensions.calibrate.blur import fit_blur
from mitsuba_plenoptic.extensions.calibrate.board_model import Observations, numbers_of

FOCAL_LENGTHS = np.array(cases.CAMERA.mla_focal_lengths)


@pytest.fixture(scope="module")
def seen():
    return cases.corners()[1]


def radii_of(seen, focal_lengths):
    # The main lens's image of each corner, the microlens's image of that, and the cone's width at the detector.
    camera = cases.CAMERA
    radii = np.empty(len(seen))
    for row, (lens, board, pose) in enumerate(zip(seen.lens, seen.board, cases.POSES[seen.pose], strict=True)):
        distance = (Rotation.from_rotvec(pose[:3]).apply([*board, 0]) + pose[3:])[2]
        image = 1 / (1 / camera.focal_length - 1 / distance)
        j = round(lens[1])
        f = focal_lengths[(round(lens[0] - j / 2) - j) % 3]
        focus = 1 / (1 / f - 1 / (camera.mla_distance - image))
        radii[row] = camera.mla_pitches[0] / 2 * (focus - camera.detector_distance) / focus / camera.pixel_size
    return radii


@pytest.fixture(scope="module")
def radius(seen):
    return radii_of(seen, FOCAL_LENGTHS)


def fitted(radius, seen, types=3):
    camera = cases.CAMERA
    return fit_blur(radius, seen, numbers_of(camera), cases.POSES, camera.lattice, types)


@pytest.mark.parametrize("factor", [1.0, -0.7])
def test_focal_lengths_come_back(seen, radius, factor):
    found = fitted(factor * radius, seen)
    np.testing.assert_allclose(found.focal_lengths, FOCAL_LENGTHS, rtol=1e-9)
    assert found.scale == pytest.approx(abs(factor) * cases.CAMERA.mla_pitches[0] / 2 / 0.0055, rel=1e-9)
    assert found.error < 1e-9


def test_deviations_are_true_where_a_corner_errs_as_a_whole(seen, radius):
    group = np.unique(np.column_stack([seen.pose, seen.board]), axis=0, return_inverse=True)[1].ravel()
    errors = []
    for seed in range(60):
        noise = np.random.default_rng(seed).normal(0, 0.1, group.max() + 1)[group]
        found = fitted(radius + noise, seen)
        errors.append((np.array(found.focal_lengths) - FOCAL_LENGTHS) / found.deviations)
    # The mean square of 60 normal deviates is 1 to 0.18, and the three share their errors.
    assert 0.5 < np.mean(np.square(errors)) < 1.7


def test_radii_that_say_nothing_of_focus_are_refused(seen):
    # Lenses that are in focus amid the boards, of which a program leaves out on which side they blur.
    signed = radii_of(seen, (0.355, 0.361, 0.367))
    assert np.quantile(signed, 0.2) < 0 < np.quantile(signed, 0.8)
    np.testing.assert_allclose(fitted(signed, seen).focal_lengths, (0.355, 0.361, 0.367), rtol=1e-9)
    with pytest.raises(InputError, match=r"rho: .* must have a sign"):
        fitted(np.abs(signed), seen)
    with pytest.raises(InputError, match="rho"):
        fitted(np.random.default_rng(0).normal(size=len(seen)), seen)
    with pytest.raises(InputError, match=r"rho: .* too few lenses or all at one depth"):
        fit_blur(
            signed[:2],
            Observations(*(rows[:2] for rows in (seen.lens, seen.pixel, seen.board, seen.pose))),
            numbers_of(cases.CAMERA),
            cases.POSES[:1],
            cases.CAMERA.lattice,
            3,
        )


def test_a_calibration_takes_them_and_keeps_them(tmp_path, radius):
    table = cases.corners(0.05)[0]
    start = cases.CAMERA.replace(
        resolution=(2000, 1500),
        crop_size=(2000, 1500),
        crop_offset=(0, 0),
        detector_width=11.0,
        mla_focal_length=(0.5,) * 3,
    )
    path = tmp_path / "corners.csv"
    columns = {**table.columns, "rho": radius}
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="")
    found = calibrate(read_corners(path, cases.BOARD, start.crop_size), cases.BOARD, start)
    assert found.blur is not None
    # Corners alone leave the distances open by a common factor, but z/f is told.
    ratio = np.array(found.blur.focal_lengths) / found.numbers["detector_distance"]
    # Its lens (0, 0) is another, of another type.
    place, row = cases.INDEX.unit(*(np.array([number]) for number in found.index.first))[0]
    other = round(place - row / 2 - row) % 3
    np.testing.assert_allclose(ratio, np.roll(FOCAL_LENGTHS, -other) / cases.CAMERA.detector_distance, rtol=0.01)
    output = tmp_path / "camera.json"
    write_calibration(output, found, cases.BOARD)
    assert read_camera(output)[0].mla_focal_lengths == pytest.approx(found.blur.focal_lengths)
    assert json.loads(output.read_text())["calibration"]["blur"]["scale"] == pytest.approx(found.blur.scale)


def test_a_column_of_one_value_is_left_out(tmp_path):
    table = cases.corners()[0]
    path = tmp_path / "corners.csv"
    columns = {**table.columns, "rho": np.zeros(len(table["k"]))}
    np.savetxt(path, np.column_stack(list(columns.values())), delimiter=",", header=",".join(columns), comments="")
    assert "rho" not in read_corners(path, cases.BOARD, (2000, 1500)).columns


@pytest.mark.skipif(not cases.REAL.is_dir(), reason="needs the data of a real camera")
def test_the_types_of_a_real_camera_are_those_that_compote_found():
    start = read_camera("raytrix")[0]
    board = Board(9, 5, 10.0)
    corners = read_corners(cases.REAL / "corners.csv", board, start.crop_size)
    found = calibrate(corners, board, start, read_centres(cases.REAL / "centres.csv"))
    theirs = json.loads((cases.REAL / "compote_intrinsics.json").read_text())
    z = float(theirs["d"])
    assert found.blur is not None
    ours = np.sort(found.numbers["detector_distance"] / np.array(found.blur.focal_lengths))
    np.testing.assert_allclose(ours, np.sort([z / float(f) for f in theirs["mla"]["focal_lengths"]]), rtol=0.02)
    assert found.blur.error < 0.06
