"""Which white captures a capture may be divided by."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_plenoptic import Capture, Detector, InputError, PlenopticCamera, expose, reconstruct
from mitsuba_plenoptic.lightfield.white import white_image

CAMERA = PlenopticCamera(detector_width=0.512, resolution=(128, 128))
WHITE = white_image(CAMERA)
COLOURS = (620.0, 540.0, 460.0)
RGB = np.stack([WHITE, 0.8 * WHITE, 0.6 * WHITE], axis=-1)
CROPS = [CAMERA.replace(crop_offset=offset, crop_size=(64, 96)) for offset in ((0, 0), (64, 32))]


def wave(image, wavelength=633.0):
    return Capture(image, CAMERA, wavelength, "wave")


@pytest.mark.parametrize(
    ("capture", "white", "message"),
    [
        (
            Capture(WHITE, CAMERA),
            Capture(WHITE, CAMERA.replace(aperture_radius=4.0)),
            "white: its camera has aperture_radius = 4.0, that of the capture 5.0: it must be by the camera of the",
        ),
        (
            *(Capture(white_image(crop), crop) for crop in CROPS),
            r"white: its camera has crop_offset = \(64, 32\), that of the capture \(0, 0\)",
        ),
        (wave(WHITE), wave(WHITE, 532.0), "white of 532.0 nm: the capture is of 633.0 nm"),
        (wave(RGB, COLOURS), wave(WHITE, 540.0), r"white of 540.0 nm: the capture is of \(620.0, 540.0, 460.0\) nm"),
        (Capture(WHITE, CAMERA), wave(WHITE), "white: it was captured by waves, and the capture by rays"),
        (
            Capture(WHITE, CAMERA),
            expose(Capture(RGB, CAMERA), Detector(mosaic="RGGB"), photons=1e4),
            "mosaic = RGGB: each pixel of the capture has one colour",
        ),
        (Capture(WHITE, CAMERA), RGB, r"white of shape \(128, 128, 3\): it must have the pixels of the capture"),
        (Capture(WHITE, CAMERA), np.where(WHITE > 0, np.nan, 0), "white: .* of its pixels are NaN or infinite"),
        (Capture(WHITE, CAMERA), -WHITE, "distance = 210: no light comes from any of the 64 bins"),
    ],
    ids=["camera", "crop", "wavelength", "colours", "model", "mosaic", "channels", "NaN", "dark"],
)
def test_whites_that_do_not_suit_are_refused(capture, white, message):
    with pytest.raises(InputError, match=message):
        reconstruct(capture, 210.0, white=white)


def test_whites_may_be_by_the_camera_that_recorded_or_the_one_that_is_given():
    found = CAMERA.replace(mla_distance=119.5)
    for camera in (CAMERA, found):
        image = reconstruct(Capture(0.5 * WHITE, CAMERA), 210.0, camera=found, white=Capture(WHITE, camera)).image
        np.testing.assert_allclose(image, 0.5, rtol=1e-5)
    with pytest.raises(InputError, match=r"its camera has mla_distance = 119.0, that of the capture 120"):
        white = Capture(WHITE, CAMERA.replace(mla_distance=119.0))
        reconstruct(Capture(WHITE, CAMERA), 210.0, camera=found, white=white)


@pytest.mark.parametrize(
    "options", [{"method": "ray"}, pytest.param({"method": "coherent"}, marks=pytest.mark.slow)], ids=str
)
def test_whites_in_colours_divide_each_channel_by_its_own(options):
    waves = options["method"] != "ray"
    given = {"wavelength": COLOURS} if waves else {}
    image = reconstruct(0.5 * RGB, 210.0, camera=CAMERA, white=RGB, **options, **given).image
    np.testing.assert_allclose(image, 0.5, rtol=1e-4)
    image = reconstruct(RGB, 210.0, camera=CAMERA, white=WHITE, **options, **given).image
    np.testing.assert_allclose(image, np.broadcast_to([1, 0.8, 0.6], image.shape), rtol=1e-4)


def test_crops_and_exposed_captures_read_their_radiance_by_a_white_reference():
    """A crop cuts micro-images, whose light diffracts; noise makes pixels negative."""
    camera = CROPS[0]
    image = white_image(camera)
    dim = expose(Capture(0.5 * image, camera), Detector(read_noise=3.0), photons=1e4)
    assert dim.image.min() < 0
    for options in ({"method": "ray"}, {"method": "coherent"}, {"method": "partial", "interleave": "auto"}):
        given = {} if options["method"] == "ray" else {"wavelength": 633.0}
        found = reconstruct(dim, 210.0, white=Capture(image, camera), **options, **given).image
        assert np.nanmax(np.abs(found - 0.5)) < 0.02
        assert np.nanmean(found) == pytest.approx(0.5, abs=0.003)
