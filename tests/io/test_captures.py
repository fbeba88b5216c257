"""Captures on disk."""

import numpy as np
import OpenEXR
import pytest

from mitsuba_plenoptic import Capture, PlenopticCamera, read_capture, write_capture


@pytest.fixture
def camera():
    return PlenopticCamera(
        detector_width=0.128, resolution=(64, 48), crop_offset=(8, 4), crop_size=(40, 32), lens_model="parabolic"
    )


@pytest.mark.parametrize("channels", [(), (3,)])
def test_a_capture_survives_the_disk(tmp_path, camera, channels):
    image = np.random.default_rng(1).random((32, 40, *channels), dtype=np.float32)
    wavelength = (610.0, 550.0, 465.0) if channels else 633.0
    path = tmp_path / "raw.exr"
    write_capture(path, Capture(image, camera, wavelength, "wave", {"seed": 3, "scene": 'ä "quoted"'}))
    read = read_capture(path)
    np.testing.assert_array_equal(read.image, image)
    assert (read.camera, read.wavelength, read.model) == (camera, wavelength, "wave")
    assert read.metadata == {"seed": 3, "scene": 'ä "quoted"'}
    assert list(tmp_path.iterdir()) == [path]


def test_a_capture_is_described_in_one_line(camera):
    grey = np.full((32, 40), 0.25)
    assert repr(Capture(grey, camera)) == "Capture(40 x 32 pixels by rays, mean 0.25)"
    colours = grey[..., None].repeat(3, axis=2)
    waves = Capture(colours, camera, (600, 550, 450), "wave", noise=0.1 * colours)
    assert repr(waves) == "Capture(40 x 32 x 3 pixels by waves, (600.0, 550.0, 450.0) nm, mean 0.25, noise 10.00%)"


def test_any_viewer_sees_the_window_and_the_pixels(tmp_path, camera):
    write_capture(tmp_path / "raw.exr", Capture(np.ones((32, 40)), camera))
    with OpenEXR.File(str(tmp_path / "raw.exr")) as file:
        header = file.header()
        assert [tuple(corner) for corner in header["dataWindow"]] == [(8, 4), (47, 35)]
        assert [tuple(corner) for corner in header["displayWindow"]] == [(0, 0), (63, 47)]
        assert file.channels()["Y"].pixels.dtype == np.float32
