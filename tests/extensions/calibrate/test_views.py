"""Boards in the views of an unfocused camera: known cameras come back, deviations are true, mistakes get one line."""

import json
from dataclasses import replace

import numpy as np
import pytest
import view_cases as cases
from refusals import refuses

from mitsuba_plenoptic import Capture, Checkpoint, calibrate, decode, render_capture, write_capture
from mitsuba_plenoptic import calibration as cal
from mitsuba_plenoptic.calibration import Board, board_scene, detect_view_corners
from mitsuba_plenoptic.extensions.calibrate import picture_corners
from mitsuba_plenoptic.extensions.calibrate.board_model import NAMES, PRINCIPAL, numbers_of, predict
from mitsuba_plenoptic.extensions.calibrate.detect import camera_centres
from mitsuba_plenoptic.extensions.calibrate.observations import find_lens_index, observations
from mitsuba_plenoptic.io import checkpoints
from mitsuba_plenoptic.views import disparity, open_light_field, save_light_field, white_image

NOISE = 0.03
TRUE = numbers_of(cases.CAMERA) + np.array([0] * 8 + [0.01, -0.02, 12, -8, 2e-3, 1e-5, 1e-7, 1e-5, -2e-5])
# What a data sheet states, wrong by some per cent.
SHEET = cases.CAMERA.replace(focal_length=6.5, mla_distance=7.5)


def slope(function, values, index, step):
    move = step * (np.arange(values.shape[-1]) == index)
    return (function(values + move) - function(values - move)) / (2 * step)


def test_derivatives_are_those_of_differences():
    seen, grid = cases.exact(TRUE)
    pixel, _, _ = predict(TRUE, cases.poses(), seen, **cases.GEOMETRY)
    # Behind the lens where the view shows it, the corner is at the view's pixel.
    assert np.abs(pixel - seen.pixel).max() < 1e-9
    # Half a pitch beside.
    seen = cases.noisy(seen, grid, 0.2, np.random.default_rng(0)).keep(slice(None, None, 20))
    poses, given = cases.poses(), cases.GEOMETRY | {"grid": grid}
    _, by_numbers, by_pose = predict(TRUE, poses, seen, **given)
    for index, value in enumerate(TRUE):
        near = slope(lambda n: predict(n, poses, seen, **given)[0], TRUE, index, max(abs(value), 1e-4) * 1e-5)
        assert np.abs(near - by_numbers[:, :, index]).max() < 1e-4 * np.abs(near).max(), NAMES[index]
    for index in range(6):
        near = slope(lambda at: predict(TRUE, at, seen, **given)[0], poses, index, 1e-6)
        assert np.abs(near - by_pose[:, :, index]).max() < 1e-4 * np.abs(near).max()


def fitted(sheet=SHEET):
    corners, centres = cases.tables(TRUE, cases.BOARD, NOISE, np.random.default_rng(0))
    return calibrate(corners, cases.BOARD, sheet, centres)


@pytest.fixture(scope="module")
def found():
    return fitted()


def test_a_known_camera_comes_back(found, tmp_path):
    true = cases.indexed(TRUE, found.index)
    apart = (np.array(list(found.numbers.values())) - true) / list(found.deviations.values())
    assert np.abs(np.delete(apart, PRINCIPAL)).max() < 4.5
    assert found.evaluation.error == pytest.approx(NOISE * 2**0.5, rel=0.05)
    assert found.held_out == pytest.approx(found.evaluation.pose_errors, rel=0.1)
    assert (found.held_out > found.evaluation.pose_errors).all()
    np.testing.assert_allclose(found.evaluation.poses[:, 5], cases.poses()[:, 5], rtol=2e-3)
    # Corners do not tell the lenses' focal length: it follows the detector, if the data sheet has none.
    assert found.camera.mla_focal_length == pytest.approx(found.numbers["detector_distance"])
    assert fitted(sheet=SHEET.replace(mla_focal_length=0.026)).camera.mla_focal_length == 0.026
    cal.write_calibration(tmp_path / "camera.json", found, cases.BOARD)
    camera, index = cal.read_camera(tmp_path / "camera.json")
    corners, _ = cases.tables(TRUE, cases.BOARD, NOISE, np.random.default_rng(1))
    assert cal.evaluate(corners, cases.BOARD, camera, index).error == pytest.approx(found.evaluation.error, rel=0.05)


def test_pixels_of_another_width_explain_the_corners_as_well(found):
    """The open combination: lengths follow the data sheet's width of pixels as the summary says."""
    wide = fitted(sheet=SHEET.replace(detector_width=1.01 * SHEET.detector_width))
    assert wide.evaluation.error == pytest.approx(found.evaluation.error, rel=1e-3)
    ratio = {name: wide.numbers[name] / found.numbers[name] for name in NAMES[:5]}
    assert ratio["mla_distance"] == pytest.approx(1.01, abs=1e-3)
    assert ratio["detector_distance"] == pytest.approx(1.02, abs=1e-3)
    assert ratio["pitch_along"] == pytest.approx(1.01, abs=1e-3)
    np.testing.assert_allclose(wide.evaluation.poses, found.evaluation.poses, rtol=5e-3, atol=0.3)


def test_an_error_of_the_white_moves_distances_as_stated(found):
    """Centres ten deviations too far apart along both axes, as their scatter does not tell, move the array."""
    given = cases.BOARD, 1e-4, np.random.default_rng(0)
    corners, centres = cases.tables(TRUE, *given, scatter=1e-3, scale=(1 + 1e-4, 1 + 1e-4))
    moved = calibrate(corners, cases.BOARD, SHEET, centres)
    off = abs(moved.numbers["mla_distance"] - TRUE[1])
    assert 8 < off / moved.deviations["mla_distance"] < 16


def test_the_shape_of_a_bent_board_is_found():
    bend = np.random.default_rng(3).normal(0, 0.3, cases.BOARD.shapes(np.zeros(1, int)).shape[1])
    corners, centres = cases.tables(TRUE, cases.BOARD, NOISE, np.random.default_rng(0), bend=bend)
    flat, bent = (calibrate(corners, cases.BOARD, SHEET, centres, bent=bent) for bent in (False, True))
    heights = cases.BOARD.shapes(np.arange(30)) @ bend
    assert np.ptp(heights) > 1
    assert np.abs(bent.board_heights - heights).max() < 0.05
    assert bent.evaluation.error == pytest.approx(NOISE * 2**0.5, rel=0.05)
    apart = np.array(list(bent.numbers.values())) - cases.indexed(TRUE, bent.index)
    assert np.abs(np.delete(apart / list(bent.deviations.values()), PRINCIPAL)).max() < 4.5
    # Of a board that is taken for flat, frames disagree.
    assert flat.by_frames and flat.evaluation.error > 2 * bent.evaluation.error


@pytest.mark.slow
def test_deviations_are_true():
    errors = np.array([cases.normalised_errors(seed) for seed in range(40)])
    # Poses that disagree by chance widen deviations, and none narrow them: 0.89 over 200 seeds.
    assert 0.75 < (errors**2).mean() < 1.1
    assert (np.abs(errors.mean(0)) < 0.6).all()


@pytest.mark.parametrize(("name", "other"), [("principal_u", 40.0), ("k1", 2e-3), ("k2", 2e-4), ("p1", 2e-4)])
def test_what_part_of_the_field_leaves_open_is_named(name, other):
    """Data made with another value give the same residual, and the result says so."""
    board, results = Board(6, 5, 5.0), []
    for step in (0.0, other):
        numbers = TRUE + step * (np.array(NAMES) == name)
        seen = cases.tables(numbers, board, 0.5, np.random.default_rng(0), at=cases.poses(board, 0.1))
        results.append(calibrate(seen[0], board, SHEET, seen[1]))
    usual, moved = results
    assert moved.evaluation.error == pytest.approx(usual.evaluation.error, rel=0.01)
    assert name in usual.assumed and name in moved.assumed
    assert abs(moved.numbers[name] - usual.numbers[name]) < 0.5 * other


def test_squares_of_another_size_explain_the_corners_of_a_light_field_as_well():
    """Without an f-number the board's squares alone tell the scale of all distances."""
    corners, centres = cases.tables(TRUE, cases.BOARD, NOISE, np.random.default_rng(0))
    small, large = (
        calibrate(corners, replace(cases.BOARD, square=square), SHEET, centres, fills_pupil=True)
        for square in (28.0, 56.0)
    )
    assert large.evaluation.error == pytest.approx(small.evaluation.error, rel=1e-3)
    np.testing.assert_allclose(large.evaluation.poses[:, 3:], 2 * small.evaluation.poses[:, 3:], rtol=5e-3, atol=1.5)
    with pytest.warns(match="check the sizes of squares"):
        calibrate(corners, replace(cases.BOARD, square=42.0), SHEET, centres)
    assert large.camera.f_number == pytest.approx(small.camera.f_number / 2, rel=0.03)


def changed(table, **columns):
    return replace(table, columns=table.columns | columns)


def mirrored(table):
    """Views counted from the other end: pixels beside their lenses' centres on the other side."""
    return changed(table, u=2 * table["x"] - table["u"], v=2 * table["y"] - table["v"])


@pytest.mark.parametrize(("change", "board", "words"), [
    (mirrored, cases.BOARD, "pictures are mirrored"),
    (lambda table: changed(table, cluster=table["cluster"] - 2 * (table["cluster"] % 6) + 5), cases.BOARD, "mirrored"),
    (lambda table: table, Board(6, 5, 0.028), "squares of 0.028 mm"),
    (lambda table: table.keep(table["frame"] < 2), cases.BOARD, "2 poses .* at least 3"),
])  # fmt: skip
def test_mistakes_get_one_line(change, board, words):
    corners, centres = cases.tables(TRUE, cases.BOARD, NOISE, np.random.default_rng(0))
    refuses(words, calibrate, change(corners), board, SHEET, centres)


# A part of the first Lytro's picture, with boards to match.
SMALL = cases.CAMERA.replace(
    resolution=(700, 700), detector_width=0.98, mla_offset=(0.003, -0.002), distortion=(2e-3, 0, 0, 0, 0)
)
FEW = Board(6, 5, 7.0)
PHOTONS = 200


@pytest.fixture(scope="module")
def pictures():
    poses = cases.poses(FEW, 0.1)[:5]
    images = [render_capture(board_scene(FEW, pose, SMALL), spp=8).image for pose in poses]
    return poses, images, white_image(SMALL)


def noisy(image, generator, filters=((1, 1), (1, 1))):
    mosaic = np.tile(np.array(filters), (350, 350)) * image
    return generator.poisson(PHOTONS * mosaic) / PHOTONS


def errors(table, pose, white_centres):
    index, grid = find_lens_index(white_centres, True, np.full(2, 349.5))
    seen, _ = observations(table, FEW, index, grid)
    numbers = numbers_of(SMALL)
    places, _, _ = predict(numbers, pose[None], seen, grid=grid, **cases.GEOMETRY)
    return seen.lens * [1, cases.GEOMETRY["row_ratio"]] - places


@pytest.mark.parametrize("filters", [((1, 1), (1, 1)), ((0.5, 1), (1, 0.4))])
def test_corners_are_found_where_the_model_sees_them(pictures, filters):
    poses, images, white = pictures
    centres, generator = camera_centres(SMALL), np.random.default_rng(1)
    table = detect_view_corners(noisy(images[0], generator, filters), white, centres, FEW, SMALL)
    assert len(np.unique(table["cluster"])) == 30 and len(table["x"]) > 30 * 20
    off = errors(table, poses[0], centres)
    assert np.sqrt((off**2).mean()) < 0.09
    assert np.abs(off.mean(0)).max() < 0.01


def test_parts_of_a_board_suffice(pictures):
    _, images, white = pictures
    half = images[0] * (np.arange(700)[:, None] > 250)
    table = detect_view_corners(half, white, camera_centres(SMALL), FEW, SMALL)
    # Counted from the first that is seen, as a board that lies some squares aside.
    whole = detect_view_corners(images[0], white, camera_centres(SMALL), FEW, SMALL)
    assert 12 <= len(np.unique(table["cluster"])) < 30 == len(np.unique(whole["cluster"]))


def test_pictures_of_something_else_get_one_line(pictures):
    _, images, white = pictures
    given = (white, camera_centres(SMALL))
    refuses("one of 6x5", detect_view_corners, images[0], *given, Board(5, 4, 1.0), SMALL, name="a")
    refuses("no checkerboard of 6x5 .* has", detect_view_corners, white, *given, FEW, SMALL, name="a")


def test_pictures_become_a_camera_in_millimetres(pictures, tmp_path, run, complaint, coarse_figures):
    poses, images, white = pictures
    generator = np.random.default_rng(0)
    sheet = SMALL.replace(focal_length=6.7, mla_distance=7.3, mla_offset=(0.0, 0.0), distortion=(0.0,) * 5)
    (tmp_path / "sheet.json").write_text(sheet.to_json())
    names = [tmp_path / f"board{number}.exr" for number in range(len(images))]
    for name, image in zip([*names, tmp_path / "white.exr"], [*images, 10 * white], strict=True):
        write_capture(name, Capture(noisy(image, generator).astype(np.float32), sheet))
    output, page = tmp_path / "camera.json", tmp_path / "page.html"
    given = ["--white", tmp_path / "white.exr", "--board", "6x5", "--square", "7", "-o", output, "--report", page]
    printed = run("calibrate", "boards", *names, *given)
    assert "frame 4, board4.exr: 30 corners" in printed and "poses left out one by one: 0.1" in printed
    assert "mla_focal_length" in printed and "is assumed" in printed
    # A part of the field leaves more open.
    held = next(line for line in printed.splitlines() if line.startswith("held, as the data leave them open: "))
    assert "principal_u +- 1" in held and "focal_length" not in held
    record = json.loads(output.read_text())["calibration"]
    # A small part of the field tells distances to a per cent.
    depths = np.array([pose[5] for pose in record["poses"].values()])
    np.testing.assert_allclose(depths, poses[:, 5], rtol=0.03)
    text = page.read_text()
    assert "held out" in text and "views" in text
    shifted = tmp_path / "other.exr"
    write_capture(shifted, Capture(np.roll(10 * white, 3, axis=1).astype(np.float32), sheet))
    assert "of another camera" in complaint("calibrate", "boards", *names, "--white", shifted, *given[2:])


def test_a_stopped_run_goes_on(pictures, tmp_path, monkeypatch):
    poses, images, white = pictures
    del poses
    paths = [tmp_path / f"board{number}.exr" for number in range(len(images))]
    for name, image in zip([*paths, tmp_path / "white.exr"], [*images, white], strict=True):
        write_capture(name, Capture(image, SMALL))
    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)
    looked_at = []

    def detect(*given, name, **others):
        looked_at.append(name)
        if len(looked_at) == 4:
            raise KeyboardInterrupt
        return detect_view_corners(*given, name=name, **others)

    monkeypatch.setattr(picture_corners, "detect_view_corners", detect)

    def found():
        with Checkpoint(tmp_path / "kept", "resume_if_same") as kept:
            return picture_corners.corners_of_pictures(
                paths, tmp_path / "white.exr", FEW, None, None, True, kept, lambda *_: None
            )[1]

    with pytest.raises(KeyboardInterrupt):
        found()
    table = found()
    assert looked_at == [str(path) for path in [*paths[:4], *paths[3:]]] and not (tmp_path / "kept").exists()
    assert (np.bincount(table["frame"]) > 30 * 20).all()


def test_light_fields_without_raw_pictures_become_metric(pictures, tmp_path, run):
    poses, images, _ = pictures
    paths = [tmp_path / f"field{number}.mat" for number in range(len(images))]
    fields = [decode(Capture(image, SMALL)) for image in images]
    for path, lf in zip(paths, fields, strict=True):
        save_light_field(path, lf.drop_attrs())
    output = tmp_path / "camera.json"
    run("calibrate", "boards", *paths, "--board", "6x5", "--square", "7", "-o", output)
    record = json.loads(output.read_text())["calibration"]
    depths = np.array([pose[5] for pose in record["poses"].values()])
    np.testing.assert_allclose(depths, poses[:, 5], rtol=0.03)
    # A bin moves from view to view as in front of the camera that took the picture.
    lf = open_light_field(paths[0], camera=cal.read_camera(output)[0])
    refuses("has 630 x 630 pixels, the camera.s picture .700, 700.", open_light_field, paths[0], camera=SMALL)
    for distance in (250.0, 400.0, 900.0):
        assert disparity(lf, distance) == pytest.approx(disparity(fields[0], distance), abs=0.02)
