"""The command ``convert`` to and from files of other programs."""

from __future__ import annotations

import configparser

import numpy as np
import pytest
from PIL import Image

from mitsuba_plenoptic import Capture, PlenopticCamera, decode, read_capture, write_capture
from mitsuba_plenoptic.exchange import open_light_field, read_hci
from mitsuba_plenoptic.io.exr import read_exr
from mitsuba_plenoptic.report.images import Brightness, to_bytes
from mitsuba_plenoptic.views import camera_of, refocus, white_image

CAMERA = PlenopticCamera(detector_width=0.512, resolution=(128, 128))


@pytest.fixture(scope="module")
def raw(tmp_path_factory):
    """Write a capture of random light once."""
    image = np.random.default_rng(0).random(CAMERA.shape, dtype=np.float32) * white_image(CAMERA)
    path = tmp_path_factory.mktemp("capture") / "raw.exr"
    write_capture(path, Capture(image, CAMERA))
    return path


@pytest.fixture(scope="module")
def lf(raw):
    return decode(read_capture(raw))


def test_convert_there_and_back(raw, lf, tmp_path, run):
    run("convert", raw, "-o", tmp_path / "a.mat")
    run("convert", tmp_path / "a.mat", "-o", tmp_path / "a.eslf.png")
    run("convert", tmp_path / "a.eslf.png", "--view-count", lf.sizes["u"], "-o", tmp_path / "b.mat")
    # A file of LFToolbox is as good a source as a capture, with its distances where it tells the camera.
    run("stack", tmp_path / "a.mat", "-o", tmp_path / "a.exr", "--distance", 210)
    image = read_exr(tmp_path / "a.exr")[0]
    np.testing.assert_allclose(image, refocus(lf, 210).values, atol=2e-4)


def test_hci_states_the_size_of_pictures_of_a_cropped_capture(tmp_path, run):
    camera = PlenopticCamera(resolution=(128, 128), detector_width=0.512, crop_offset=(40, 16), crop_size=(64, 80))
    raw, folder = tmp_path / "raw.exr", tmp_path / "hci"
    write_capture(raw, Capture(np.ones(camera.shape, np.float32), camera))
    run("convert", raw, "-o", folder, "--format", "hci")
    stated = configparser.ConfigParser()
    stated.read(folder / "parameters.cfg")
    with Image.open(folder / "input_Cam000.png") as picture:
        size = tuple(int(stated["intrinsics"][f"image_resolution_{axis}_px"]) for axis in "xy")
        assert size == picture.size
    assert size != camera.bin_count
    assert read_hci(folder).shape[2:4] == size[::-1]


def test_one_capture_is_converted_to_a_folder_of_another_benchmark(tmp_path, run, complaint):
    raw, folder = tmp_path / "raw.exr", tmp_path / "hci"
    words = ["-D", "resolution=256", "-D", "detector_width=0.512", "--spp", "4", "--aov", "depth"]
    run("render", "letters", "-o", raw, *words)
    assert run("convert", raw, "-o", folder, "--format", "hci") == f"{folder}: 15 x 15 views of 8 x 8 pixels\n"
    read = configparser.ConfigParser()
    read.read(folder / "parameters.cfg")
    camera, lf = read_capture(raw).camera, decode(read_capture(raw))
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
    truth = np.frombuffer((folder / "gt_depth_lowres.pfm").read_bytes().split(b"\n", 3)[3], "<f4").reshape(8, 8)[::-1]
    assert np.nanmin(truth) == pytest.approx(0.24, rel=1e-5)
    back = tmp_path / "back.nc"
    assert run("convert", folder, "-o", back) == f"{back}: 15 x 15 views of 8 x 8 pixels\n"
    found, square = open_light_field(back), lf[middle - 7 : middle + 8, middle - 7 : middle + 8]
    assert camera_of(found) == camera
    for axis in "vuts":
        np.testing.assert_allclose(found[axis], square[axis])
    # Pictures have eight bits, of which half a step is lost, and end at white.
    white = Brightness().peak([square.values])
    linear = (np.clip(one.values / white, 0, 1) for one in (found, square))
    # IEC 61966-2-1.
    codes = [255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055) for x in linear]
    assert abs(codes[0] - codes[1]).max() < 0.51
    assert "parameters.cfg" in complaint("convert", tmp_path, "-o", back)
    (folder / "input_Cam007.png").unlink()
    assert complaint("convert", folder, "-o", back) == f"{folder / 'input_Cam007.png'}: there is no such file"
    (folder / "parameters.cfg").write_bytes(b"\xff\xfe")
    assert "it is not text in UTF-8" in complaint("convert", folder, "-o", back)
    assert complaint("convert", raw, "-o", folder, "--format", "hcl").startswith("--format = 'hcl': it must be")
    assert complaint("convert", raw, "-o", raw, "--format", "hci") == f"{raw}: it is a file; name a folder"
    run("convert", raw, "-o", tmp_path / "a.eslf.png")
    views = ["--view-count", lf.sizes["u"]]
    words = complaint("convert", tmp_path / "a.eslf.png", *views, "-o", folder, "--format", "hci")
    assert words.startswith(f"{tmp_path / 'a.eslf.png'}: ") and "camera" in words
