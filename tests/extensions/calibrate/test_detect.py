"""Corners in pictures: blurred corners of closed form, and boards that the sensor renders, held to the model."""

import calibration_cases as cases
import numpy as np
import pytest
from refusals import refuses
from scipy.ndimage import gaussian_filter, uniform_filter

from mitsuba_plenoptic import Capture, render_capture, write_capture
from mitsuba_plenoptic.calibration import Board, board_scene, detect_corners, read_corners
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.extensions.calibrate.board_model import Observations, numbers_of, predict
from mitsuba_plenoptic.extensions.calibrate.boards import find_saddles
from mitsuba_plenoptic.extensions.calibrate.detect import camera_centres, evenly_lit
from mitsuba_plenoptic.views import white_image

pytest.importorskip("cv2")

FINE = 8


@pytest.mark.parametrize("blur", [0.0, 2.0])
def test_saddles_and_their_deviations_are_true(blur):
    # Corners of skewed squares, averaged over pixels, a disc's blur for one; many places at once beside each other.
    generator = np.random.default_rng(3)
    noise, side, count = 0.05, 19, 80
    true = np.full((count, 2), side // 2) + generator.uniform(-0.5, 0.5, (count, 2))
    angles = generator.uniform(0, 0.5, (count, 1)) + np.array([0, 1.4])
    fine = (np.arange(side * FINE) + 0.5) / FINE - 0.5
    strip = np.empty((side, side * count))
    for number, (place, (first, second)) in enumerate(zip(true, angles, strict=True)):
        x, y = np.meshgrid(fine - place[0], fine - place[1])
        sharp = np.sign(np.cos(first) * y - np.sin(first) * x) * np.sign(np.cos(second) * y - np.sin(second) * x)
        blurred = uniform_filter(gaussian_filter(sharp, blur * FINE), FINE, origin=-1)
        strip[:, number * side : (number + 1) * side] = blurred[FINE // 2 - 1 :: FINE, FINE // 2 - 1 :: FINE]
    strip = 0.5 + 0.4 * strip + generator.normal(0, noise, strip.shape)
    shift = np.stack([np.arange(count) * side, np.zeros(count)], axis=-1)
    start = true + shift + generator.uniform(-0.7, 0.7, (count, 2))
    centre = np.full((count, 2), side // 2) + shift
    found = find_saddles(strip, np.ones_like(strip), start, angles + 0.1, centre, radius=9.0, even=9.0)
    error = found.position - true - shift
    assert np.abs(error.mean(0)).max() < 4 * np.sqrt((error**2).mean() / count)
    assert np.sqrt((error**2).sum(1).mean()) < 0.06 + 0.06 * blur
    # The deviation is that along the worse axis.
    assert 0.6 < np.sqrt((error**2).mean()) / np.median(found.deviation) < 1.1


# Small round lenses, so that the pupil cuts off nothing of their blur.
CAMERA = cases.CAMERA.replace(
    resolution=(1000, 760), crop_size=(960, 760), crop_offset=(20, 0), detector_width=5.5, mla_aperture="circle",
    mla_fill=0.2,
)  # fmt: skip
BOARD = Board(4, 3, 3.0)
POSES = np.array([[0.1, 0.05, 3.1, 4.5, 3, 300], [0.45, -0.1, 3.15, 4, 3, 280], [-0.15, 0.5, 3.05, 4.5, 2.5, 260]])
PHOTONS = 300


def test_pixels_whose_light_the_rim_cuts_are_told():
    camera = CAMERA.replace(mla_fill=0.5, mla_tilt=(0.0, 0.0), distortion=(0.0,) * 5)
    # Through a lens's point d from its centre, a pixel p from its micro-image's sees the pupil at b p / z + d s.
    b, z = camera.mla_distance, camera.detector_distance
    slopes = [abs(1 + b / z - b / f) for f in camera.mla_focal_lengths]
    reach = camera.aperture_radius - np.array(slopes) * camera.row_pitch / 2 * camera.mla_fill
    even = reach * z / b / camera.pixel_size
    assert even.min() - 0.5 <= evenly_lit(white_image(camera), camera_centres(camera).pixel, 9.0) <= even.max() + 0.5


@pytest.fixture(scope="module")
def pictures():
    generator = np.random.default_rng(2)
    images = (render_capture(board_scene(BOARD, pose, CAMERA), spp=8).image for pose in POSES)
    return [generator.poisson(PHOTONS * image) / PHOTONS for image in images]


@pytest.fixture(scope="module")
def corners(pictures, tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures")
    names = [str(folder / f"board{number}.exr") for number in range(len(pictures))]
    for name, image in zip(names, pictures, strict=True):
        write_capture(name, Capture(image.astype(np.float32), CAMERA))
    (folder / "camera.json").write_text(CAMERA.to_json())
    output = folder / "corners.csv"
    given = ["--board", "4x3", "--camera", str(folder / "camera.json"), "-o", str(output)]
    assert main(["calibrate", "corners", *names, *given]) == 0
    return read_corners(output, BOARD, CAMERA.crop_size)


def test_boards_are_found_where_the_model_sees_them(corners):
    assert set(corners["frame"]) == set(range(len(POSES)))
    numbers = numbers_of(CAMERA)
    assert len(corners["k"]) > 200
    for frame in range(len(POSES)):
        mine = corners.keep(corners["frame"] == frame)
        assert len(np.unique(mine["cluster"])) == 12
        lens = np.stack([mine["k"] + 0.5 * (mine["l"] % 2), mine["l"]], axis=-1).astype(float)
        seen = Observations(lens, mine.pixel, BOARD.places(mine["cluster"]), np.zeros(len(lens), dtype=int))
        pixel, _, _ = predict(numbers, POSES[frame : frame + 1], seen, pixel_size=0.0055, row_ratio=0.75**0.5)
        error = mine.pixel - pixel
        assert np.sqrt((error**2).sum(1).mean()) < 0.25
        assert np.abs(error.mean(0)).max() < 0.05


def test_pictures_without_a_board_get_one_line(pictures):
    image, given = pictures[0], (white_image(CAMERA), camera_centres(CAMERA), BOARD)
    refuses("960 x 100 pixels", detect_corners, image[:100], *given)
    refuses("no checkerboard of 4x3", detect_corners, 0 * image, *given)
    refuses("board: .*NaN", detect_corners, image * np.nan, *given, name="board")
    refuses("must be an image", detect_corners, image.ravel(), *given)
