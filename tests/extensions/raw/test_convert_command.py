"""The command ``convert`` to and from files of other programs."""

import configparser

import numpy as np
import pytest
import scipy
from PIL import Image

from mitsuba_plenoptic import Capture, PlenopticCamera, decode, read_capture, write_capture
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.exchange import open_light_field
from mitsuba_plenoptic.io.exr import read_exr, read_exr_parts
from mitsuba_plenoptic.report.images import Brightness, to_bytes
from mitsuba_plenoptic.views import camera_of, focal_stack, refocus, view


def test_convert_there_and_back(shot, lf, tmp_path, run, complaint):
    run("convert", shot, "-o", tmp_path / "a.nc")
    run("convert", tmp_path / "a.nc", "-o", tmp_path / "a.mat")
    run("convert", tmp_path / "a.mat", "-o", tmp_path / "a.eslf.png")
    run("convert", tmp_path / "a.eslf.png", "--view-count", lf.sizes["u"], "-o", tmp_path / "b.mat")
    # Mosaics state their number of views and how these lie, whatever their name.
    run("convert", tmp_path / "a.eslf.png", "-o", tmp_path / "c.png")
    (tmp_path / "a.eslf.png").rename(tmp_path / "d.png")
    for name in ("c.png", "d.png"):
        found = open_light_field(tmp_path / name)
        np.testing.assert_allclose(found.values, open_light_field(tmp_path / "b.mat").values, atol=1e-4)
    said = complaint("views", tmp_path / "d.png", "--view-count", 3, "-o", tmp_path / "e.png")
    assert said.startswith(f"--view-count = 3: {tmp_path / 'd.png'} states {lf.sizes['u']} views")
    # A file of LFToolbox is as good a source as a capture, with its distances where it tells the camera.
    run("stack", tmp_path / "a.mat", "-o", tmp_path / "a.exr", "--distance", 210)
    np.testing.assert_allclose(read_exr(tmp_path / "a.exr")[0], refocus(lf, 210).values, atol=2e-4)


def test_hci_states_the_size_of_pictures_of_a_cropped_capture(tmp_path, run):
    camera = PlenopticCamera(resolution=(128, 128), detector_width=0.512, crop_offset=(40, 16), crop_size=(64, 80))
    shot, folder = tmp_path / "raw.exr", tmp_path / "hci"
    write_capture(shot, Capture(np.ones(camera.shape, np.float32), camera))
    run("convert", shot, "-o", folder, "--format", "hci")
    stated = configparser.ConfigParser()
    stated.read(folder / "parameters.cfg")
    with Image.open(folder / "input_Cam000.png") as picture:
        size = tuple(int(stated["intrinsics"][f"image_resolution_{axis}_px"]) for axis in "xy")
        assert size == picture.size
    assert size != camera.bin_count
    assert open_light_field(folder).shape[2:4] == size[::-1]


def test_one_capture_is_converted_to_a_folder_of_another_benchmark(tmp_path, run, complaint):
    shot, folder = tmp_path / "raw.exr", tmp_path / "hci"
    words = ["-D", "resolution=256", "-D", "detector_width=0.512", "--spp", "4", "--aov", "depth"]
    run("render", "letters", "-o", shot, *words)
    assert run("convert", shot, "-o", folder, "--format", "hci") == f"{folder}: 15 x 15 views of 8 x 8 pixels\n"
    read = configparser.ConfigParser()
    read.read(folder / "parameters.cfg")
    camera, lf = read_capture(shot).camera, decode(read_capture(shot))
    assert float(read["extrinsics"]["baseline_mm"]) == pytest.approx(camera.pupil_step)
    assert float(read["extrinsics"]["focus_distance_m"]) == pytest.approx(camera.focus_distance / 1000)
    assert read["meta"]["scene"] == "raw" and int(read["extrinsics"]["num_cams_x"]) == 15
    middle = lf.sizes["v"] // 2
    pictures = sorted(folder.glob("input_Cam*.png"))
    assert len(pictures) == 225
    # In the order of rows from the upper left, the first of the square.
    for number, (v, u) in ((0, (middle - 7, middle - 7)), (112, (middle, middle)), (113, (middle, middle + 1))):
        square = lf.values[middle - 7 : middle + 8, middle - 7 : middle + 8]
        known = to_bytes(lf.values[v, u], Brightness().peak([square]))
        assert (np.asarray(Image.open(pictures[number]))[..., 0] == known).all()
    maps = {}
    for name in ("gt_depth_lowres", "gt_disp_lowres"):
        head, size, scale, values = (folder / f"{name}.pfm").read_bytes().split(b"\n", 3)
        assert (head, size, scale) == (b"Pf", b"8 8", b"-1")
        maps[name] = np.frombuffer(values, "<f4").reshape(8, 8)[::-1]
    depth, shift = maps.values()
    np.testing.assert_allclose(1000 * depth, open_light_field(shot, truth=True).depth.values[middle, middle], rtol=1e-5)
    # The formula by which that benchmark turns depths, in metres, into disparities.
    inside, outside = read["intrinsics"], read["extrinsics"]
    factor = float(outside["baseline_mm"]) / 1000 * float(inside["focal_length_mm"]) * 8
    factor /= float(inside["sensor_size_mm"])
    np.testing.assert_allclose(shift, factor * (1 / depth - 1 / float(outside["focus_distance_m"])), atol=1e-4)
    back = tmp_path / "back.nc"
    assert run("convert", folder, "-o", back) == f"{back}: 15 x 15 views of 8 x 8 pixels\n"
    found, square = open_light_field(back), lf[middle - 7 : middle + 8, middle - 7 : middle + 8]
    assert camera_of(found) == camera
    for axis in "vuts":
        np.testing.assert_allclose(found[axis], square[axis])
    # Pictures have eight bits, and end at white.
    white = Brightness().peak([square.values])
    np.testing.assert_array_equal(to_bytes(found.values, white), to_bytes(square.values, white))
    assert "parameters.cfg" in complaint("convert", tmp_path, "-o", back)
    (folder / "input_Cam007.png").unlink()
    assert complaint("convert", folder, "-o", back).startswith(f"{folder / 'input_Cam007.png'}: ")
    assert complaint("convert", shot, "-o", folder, "--format", "hcl").startswith("--format = 'hcl': ")
    assert complaint("convert", shot, "-o", shot, "--format", "hci").startswith(f"{shot}: it is a file")
    run("convert", shot, "-o", tmp_path / "a.eslf.png")
    words = complaint("convert", tmp_path / "a.eslf.png", "-o", folder, "--format", "hci")
    assert words.startswith(f"{tmp_path / 'a.eslf.png'}: ") and "camera" in words


PARAMETERS = """[intrinsics]
focal_length_mm = 100.0
sensor_size_mm = 35.0
[extrinsics]
num_cams_x = 5
num_cams_y = 5
baseline_mm = 40.0
focus_distance_m = 4.25
"""


def write_array(folder, parameters, square_shift=1, wall_shift=-1):
    """Write a folder of another program: a near square before a far wall, seen by 5 x 5 cameras."""
    random, size = np.random.default_rng(1), (48, 64)
    near, far = (scipy.ndimage.gaussian_filter(random.random((96, 112)), 1.0) for _ in range(2))
    at = np.mgrid[: size[0], : size[1]].astype(float)
    for number in range(25):
        # HCI's disparities, positive nearer: cameras farther to the right see a near point farther to the left.
        step = np.array([number // 5 - 2, number % 5 - 2])[:, None, None]
        square, wall = (
            scipy.ndimage.map_coordinates(texture, at + shift * step + 24, order=3)
            for texture, shift in ((near, square_shift), (far, wall_shift))
        )
        moved = at + square_shift * step
        inside = ((moved >= [[[16]], [[20]]]) & (moved < [[[32]], [[44]]])).all(axis=0)
        picture = (np.where(inside, square, wall) - 0.25) * 2
        Image.fromarray(to_bytes(picture.clip(0, 1))).save(folder / f"input_Cam{number:03d}.png")
    (folder / "parameters.cfg").write_text(parameters)
    return folder


@pytest.fixture(scope="module")
def array_of_cameras(tmp_path_factory):
    return write_array(tmp_path_factory.mktemp("array"), PARAMETERS)


def require_depths(found, *places):
    """See that at places of two disparities depths are those of 1/Z = d / (f in pixels * baseline) + 1 / focus."""
    for where, disparity, baseline in places:
        true = 1000 / (disparity / (100 / 35 * 64 * baseline) + 1 / 4.25)
        # It is lower beside the edges of what is nearer.
        assert np.mean(found["confidence"]["Y"][where] > 0.5) > 0.85
        assert np.nanmedian(found["depth"]["Y"][where]) == pytest.approx(true, rel=0.01)
        # Files have this package's sign.
        assert np.median(found["disparity"]["Y"][where]) == pytest.approx(-disparity, abs=0.02)


@pytest.mark.slow
def test_depth_is_sought_where_a_folder_says_that_the_scene_is(tmp_path, run, capfd):
    """Disparities of 2.4 and -2.2 are beyond those that are sought where nothing is known of the scene."""
    parameters, disparities = PARAMETERS.replace("40.0", "120"), "[meta]\ndisp_min = -2.2\ndisp_max = 2.4\n"
    (tmp_path / "a").mkdir()
    folder, depth = write_array(tmp_path / "a", parameters + disparities, 2.4, -2.2), tmp_path / "a.exr"
    run("convert", folder, "-o", tmp_path / "a.nc")
    run("depth", tmp_path / "a.nc", "-o", depth, "--planes", 65)
    places = (np.s_[22:26, 26:38], 2.4, 0.12), (np.s_[2:8, 6:58], -2.2, 0.12)
    require_depths(read_exr_parts(depth)[0], *places)
    for text, words in (
        (PARAMETERS.replace("focus_distance_m = 4.25\n", disparities), "it has no focus_distance_m"),
        (parameters, "hardly any bin determines it"),
    ):
        (folder / "parameters.cfg").write_text(text)
        assert main(["depth", str(folder), "-o", str(depth), "--planes", "17"]) == 0
        assert words in capfd.readouterr().err


@pytest.mark.slow
def test_depth_of_an_array_of_cameras_is_metric(array_of_cameras, tmp_path, run, complaint):
    run("depth", array_of_cameras, "-o", tmp_path / "depth.exr", "--planes", 65)
    places = (np.s_[20:28, 24:40], 1, 0.04), (np.s_[4:12, 4:60], -1, 0.04)
    require_depths(read_exr_parts(tmp_path / "depth.exr")[0], *places)
    back = tmp_path / "back"
    assert run("convert", array_of_cameras, "-o", back, "--format", "hci").startswith(f"{back}: 5 x 5 views")
    for line, wrong, words in (
        ("baseline_mm = 40.0", "baseline_mm = -25", "baseline_mm = -25: "),
        ("baseline_mm = 40.0", "baseline_mm = abc", "baseline_mm = 'abc': "),
        ("num_cams_x = 5", "num_cams_x = 5.5", "num_cams_x = 5.5: "),
        ("num_cams_y = 5", "", "num_cams_y: "),
        ("[intrinsics]", "[meta]\ndisp_min = near\n[intrinsics]", "disp_min = 'near': "),
    ):
        (back / "parameters.cfg").write_text(PARAMETERS.replace(line, wrong))
        assert complaint("depth", back, "-o", tmp_path / "b.exr").startswith(f"{back / 'parameters.cfg'}: {words}")


def test_without_a_camera_disparities_are_found_and_refocused(array_of_cameras, tmp_path, run, complaint):
    mosaic, no = tmp_path / "field.eslf.png", tmp_path / "no.exr"
    run("convert", array_of_cameras, "-o", mosaic)
    said = run("depth", mosaic, "-o", tmp_path / "depth.exr", "--planes", 33)
    assert "pixels per view" in said and "negative nearer" in said and "HCI's have the other sign" in said
    disparity = read_exr_parts(tmp_path / "depth.exr")[0]["disparity"]["Y"]
    assert np.median(disparity[20:28, 24:40]) == pytest.approx(-1, abs=0.02)
    assert np.median(disparity[4:12, 4:60]) == pytest.approx(1, abs=0.02)
    focused = "--disparity", -1, "--disparity", 1
    assert run("stack", mosaic, "-o", tmp_path / "stack.exr", *focused).endswith("2 images of 64 x 48 bins\n")
    # Focused, what is seen is as it is in the central view.
    lf = open_light_field(mosaic)
    central, (near, far) = view(lf, u=0.0, v=0.0).values, focal_stack(lf, [-1, 1], by="disparity").values
    np.testing.assert_allclose(near[20:28, 24:40], central[20:28, 24:40], atol=0.01)
    np.testing.assert_allclose(far[4:10, 4:60], central[4:10, 4:60], atol=0.01)
    assert "--disparity" in complaint("stack", mosaic, "-o", no, "--distance", 240)
    assert "disparity" in complaint("depth", mosaic, "-o", no, "--far", 240)
    said = run("stack", mosaic, "-o", tmp_path / "sweep.gif", *focused)
    assert said.endswith("from -1 to 1 pixels per view and back\n")
