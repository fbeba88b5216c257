"""What captures, detectors, exposures and pictures of theirs refuse."""

import math

import numpy as np
import pytest
import tifffile

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import Capture, Detector, PlenopticCamera, expose, read_capture, write_capture, write_raw
from mitsuba_plenoptic.io import read_picture
from refusals import refused, refuses

CAMERA = PlenopticCamera(detector_width=0.128, resolution=(64, 48), crop_offset=(8, 4), crop_size=(40, 32))
IMAGE = np.random.default_rng(0).random(CAMERA.shape, np.float32)
GREY = Capture(IMAGE, CAMERA)
MOSAIC = expose(Capture(np.stack([IMAGE] * 3, -1), CAMERA), Detector(mosaic="RGGB"), photons=2000)


def captured(**changes):
    return Capture(**{"image": np.ones((32, 40)), "camera": CAMERA} | changes)


test_refused = refused(
    (lambda: captured(image=np.ones((40, 32))), "32 rows and 40 columns"),
    (lambda: captured(model="magic"), "model = 'magic'"),
    (lambda: captured(wavelength=-5.0), "wavelength = -5"),
    (lambda: captured(camera=None), "camera = None"),
    (lambda: Detector(quantum_efficiency=1.1), "quantum_efficiency = 1.1"),
    (lambda: Detector(dark_electrons=math.nan), "dark_electrons"),
    (lambda: Detector(bits=17), "bits = 17"),
    (lambda: Detector(black_level=4095), "black_level = 4095"),
    (lambda: expose(GREY, Detector(), photons=0), "photons = 0"),
)


test_files_that_cannot_be_written = refused(
    (lambda folder: write_capture(folder / "nowhere" / "raw.exr", GREY), "nowhere"),
    (lambda folder: write_capture(folder, GREY), "folder"),
    (lambda folder: write_raw(folder / "a.tiff", GREY), "capture: .*expose"),
    (
        lambda folder: write_raw(folder / "a.tiff", Capture(MOSAIC.image * 1.03, CAMERA, metadata=MOSAIC.metadata)),
        "capture: .*digital numbers",
    ),
)


RAMP = np.linspace(0.1, 0.9, 32).reshape(4, 8)


@pytest.mark.parametrize(("numbers", "options", "words"), [
    (np.stack([RAMP] * 5).astype("f4"), {}, "it holds 5 pictures"),
    ((RAMP * 100).astype("i2"), {}, "int16"),
    (RAMP.astype("f4"), {"photometric": "miniswhite"}, "MINISWHITE, float32"),
    ((RAMP * 100).astype("u1"), {"extratags": [(274, 3, 1, 6, True)]}, "orientation 6"),
    ((RAMP[..., None].repeat(4, 2) * 9).astype("u1"), {"photometric": "separated"}, "SEPARATED"),
])  # fmt: skip
def test_other_tiff_are_refused(tmp_path, numbers, options, words):
    tifffile.imwrite(tmp_path / "a.tiff", numbers, **options)
    refuses(rf"a\.tiff: it cannot be read as a picture: it holds [^\n]*{words[-8:]}", read_picture, tmp_path / "a.tiff")


@pytest.mark.parametrize("text", ['{"mitsuba_plenoptic": {"camera": {}, "metadata": {"exposure": {}}}}', "{" * 9])
def test_pictures_that_are_no_raw_captures(tmp_path, text):
    tifffile.imwrite(tmp_path / "lies.tiff", np.zeros((3, 3), np.uint16), description=text, metadata=None)
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\nnothing")
    refuses(r"lies.tiff: ", read_capture, tmp_path / "lies.tiff")
    refuses(r"broken.png: it cannot be read as a picture", read_capture, tmp_path / "broken.png")


WHOLE = PlenopticCamera(detector_width=0.256, resolution=(64, 64))


@pytest.mark.parametrize(
    "take",
    [
        lambda image: mp.decode(image, camera=WHOLE),
        lambda image: mp.CaptureOperator(WHOLE, [[0, 0, 236.0]], wavelength=633).adjoint(image),
    ],
)
def test_masks_and_imaginary_parts_are_not_lost(take):
    image = np.random.default_rng(0).random((64, 64))
    refuses("of its values are masked", take, np.ma.masked_greater(image, 0.5))
    refuses("it must hold real numbers", take, image + 1j)
