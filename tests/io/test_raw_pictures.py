"""Raw captures as 16-bit pictures: what is read back is what the detector gave."""

import json

import numpy as np
import pytest
import tifffile
from PIL import Image

from mitsuba_plenoptic import Capture, Detector, InputError, PlenopticCamera, expose, read_raw, write_raw


def capture_of(channels=3):
    camera = PlenopticCamera(detector_width=0.128, resolution=(64, 64), crop_offset=(3, 2), crop_size=(40, 33))
    return Capture(np.random.default_rng(0).random((33, 40, channels)).astype(np.float32).squeeze(), camera)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".tiff"])
def test_a_mosaic_comes_back_as_it_was(tmp_path, suffix):
    """The numbers are those that other programs see: 12 bits, black where it is dark."""
    raw = expose(capture_of(), Detector(mosaic="GBRG", bits=12, dark_electrons=3.0), photons=9000, seed=2)
    path = tmp_path / f"raw{suffix}"
    write_raw(path, raw)
    back = read_raw(path)
    np.testing.assert_allclose(back.image, raw.image, atol=1e-6)
    assert back.camera == raw.camera and back.metadata == json.loads(json.dumps(raw.metadata))
    seen = np.asarray(Image.open(path)) if suffix == ".png" else tifffile.imread(path)
    assert seen.dtype == np.uint16 and seen.shape == (33, 40)
    assert 40 < seen.max() <= 4095


def test_three_channels_go_to_tiff(tmp_path):
    raw = expose(capture_of(), Detector(), photons=2000)
    write_raw(tmp_path / "raw.tiff", raw)
    np.testing.assert_allclose(read_raw(tmp_path / "raw.tiff").image, raw.image, atol=1e-6)
    with pytest.raises(InputError, match=r"raw pictures of three channels are written as .tiff"):
        write_raw(tmp_path / "raw.png", raw)


def test_pictures_of_other_programs_need_a_camera(tmp_path, complaint):
    tifffile.imwrite(tmp_path / "other.tiff", np.full((33, 40), 1064, np.uint16))
    said = complaint("reconstruct", tmp_path / "other.tiff", "-o", tmp_path / "a.exr", "--distance", "240")
    assert "other.tiff: it states no camera and detector; such a raw picture needs its --camera" in said
