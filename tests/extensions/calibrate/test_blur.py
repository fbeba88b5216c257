"""Blur radii tell the microlenses' focal lengths, whatever their scale and sign, and are refused where they do not."""

import json

import calibration_cases as cases
import numpy as np
import pytest
from refusals import refuses
from scipy.spatial.transform import Rotation

from mitsuba_plenoptic import PlenopticCamera, calibrate
from mitsuba_plenoptic.calibration import Board, read_camera, read_centres, read_corners, write_calibration
from mitsuba_plenoptic.extensions.calibrate.blur import CutBlur, fit_blur
from mitsuba_plenoptic.extensions.calibrate.board_model import Observations, numbers_of
from mitsuba_plenoptic.extensions.calibrate.boards import find_saddles

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
        found = fitted(radius + np.random.default_rng(seed).normal(0, 0.1, group.max() + 1)[group], seen)
        errors.append((np.array(found.focal_lengths) - FOCAL_LENGTHS) / found.deviations)
    # The mean square of 60 normal deviates is 1 to 0.18, and the three share their errors.
    assert 0.5 < np.mean(np.square(errors)) < 1.7


def test_radii_that_say_nothing_of_focus_are_refused(seen):
    # Lenses that are in focus amid the boards, of which a program leaves out on which side they blur.
    signed = radii_of(seen, (0.355, 0.361, 0.367))
    assert np.quantile(signed, 0.2) < 0 < np.quantile(signed, 0.8)
    np.testing.assert_allclose(fitted(signed, seen).focal_lengths, (0.355, 0.361, 0.367), rtol=1e-9)
    refuses(r"rho: .* must have a sign", fitted, np.abs(signed), seen)
    refuses("rho", fitted, np.random.default_rng(0).normal(size=len(seen)), seen)
    few = Observations(*(rows[:2] for rows in (seen.lens, seen.pixel, seen.board, seen.pose)))
    model = numbers_of(cases.CAMERA), cases.POSES[:1], cases.CAMERA.lattice
    refuses(r"rho: .* too few lenses or all at one depth", fit_blur, signed[:2], few, *model, 3)


def write_table(path, columns):
    np.savetxt(path, np.column_stack(list(columns.values())), delimiter=",", header=",".join(columns), comments="")


@pytest.mark.slow
def test_a_calibration_takes_them_and_keeps_them(tmp_path, radius):
    whole = {"resolution": (2000, 1500), "crop_size": (2000, 1500), "crop_offset": (0, 0), "detector_width": 11.0}
    start = cases.CAMERA.replace(**whole, mla_focal_length=(0.5,) * 3)
    path = tmp_path / "corners.csv"
    write_table(path, {**cases.corners(0.05)[0].columns, "rho": radius})
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


def test_a_column_of_one_value_is_left_out(tmp_path, radius):
    path = tmp_path / "corners.csv"
    write_table(path, {**cases.corners()[0].columns, "rho": 0 * radius})
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


CAMERA = PlenopticCamera.preset("raytrix").replace(mla_aperture="circle")
COUNT, SIDE = 20, 23
RADIUS = CAMERA.micro_image_diameter / 2 / CAMERA.pixel_size


def micro_images(kind, distance, place, angles):
    """Draw micro-images, side by side, of corners at places from their middle, and white ones, by traced rays."""
    b, z, size = CAMERA.mla_distance, CAMERA.detector_distance, CAMERA.pixel_size
    f, generator = np.array(CAMERA.mla_focal_lengths)[kind], np.random.default_rng(5)
    points = generator.uniform(-1, 1, (800, 2))
    lens = points[np.hypot(*points.T) < 1] * CAMERA.lattice.aperture_width / 2
    image, white = np.zeros((2, SIDE, SIDE * COUNT))
    axis = np.arange(SIDE) - SIDE // 2
    for number, (corner, (first, second)) in enumerate(zip(place, angles, strict=True)):
        # The image of the corner, which the centre of the lens shows at its place.
        middle = -corner * size * distance / z
        for row, column in np.ndindex(SIDE, SIDE):
            pixel = (np.array([axis[column], axis[row]]) + generator.uniform(-0.5, 0.5, lens.shape)) * size
            slope = (lens - pixel) / z - lens / f
            open_ = np.hypot(*(lens + b * slope).T) < CAMERA.aperture_radius
            x, y = (lens + distance * slope - middle)[open_].T * (-z / distance / size)
            light = np.sign(np.cos(first) * y - np.sin(first) * x) * np.sign(np.cos(second) * y - np.sin(second) * x)
            white[row, number * SIDE + column] = open_.mean()
            image[row, number * SIDE + column] = (0.5 + 0.4 * light).sum() / len(lens)
    return image, white


def test_corners_are_met_in_spite_of_the_rim():
    kind, ratio = 1, -0.15
    # z/a; the disparity is that of neighbouring lenses in the array's plane, over the pitch of micro-images.
    over = CAMERA.detector_distance / CAMERA.mla_distance
    generator = np.random.default_rng(3)
    bearing, arm = generator.uniform(0, 2 * np.pi, COUNT), generator.uniform(0.35, 0.6, COUNT) * RADIUS
    place = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1) * arm[:, None]
    angles = generator.uniform(0, 0.5, (COUNT, 1)) + np.array([0, 1.5])
    image, white = micro_images(kind, CAMERA.detector_distance / ratio, place, angles)
    weight = np.where(white > 0.25 * white.max(), white, 0)
    centre = np.stack([np.arange(COUNT) * SIDE + SIDE // 2, np.full(COUNT, SIDE // 2)], axis=-1).astype(float)
    given = weight, centre + place + generator.uniform(-0.5, 0.5, place.shape), angles, centre
    cut, kinds = CutBlur(CAMERA), np.full(COUNT, kind)
    defocus = cut.defocus(kinds, np.full(COUNT, (ratio - over) / (1 + over)))
    assert defocus == pytest.approx(1 - CAMERA.detector_distance / CAMERA.mla_focal_lengths[kind] + ratio)
    outwards = []
    for seen in (None, lambda rows, arms: cut.displaced(kinds[rows], defocus[rows], arms)):
        found = find_saddles(image / np.maximum(white, 1e-9), *given, radius=RADIUS, even=RADIUS, displacement=seen)
        good = np.isfinite(found.deviation)
        assert good.sum() > 0.7 * COUNT
        miss = (found.position - centre - place)[good]
        outwards.append(float(((miss * place[good]).sum(1) / arm[good]).mean()))
    plain, mended = outwards
    assert abs(plain) > 0.15
    assert abs(mended) < 0.3 * abs(plain)
