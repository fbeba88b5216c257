"""Which white captures a capture may be divided by."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_plenoptic import (
    Capture,
    Detector,
    InputError,
    PlenopticCamera,
    decode,
    expose,
    load_scene,
    reconstruct,
    render_capture,
)
from mitsuba_plenoptic.views import white_image

import mitsuba as mi  # isort: skip

CAMERA = PlenopticCamera(detector_width=0.512, resolution=(128, 128))
WHITE = white_image(CAMERA)
COLOURS = (620.0, 540.0, 460.0)
RGB = np.stack([WHITE, 0.8 * WHITE, 0.6 * WHITE], axis=-1)
SKY = {"type": "scene", "integrator": {"type": "direct"}, "sky": {"type": "constant", "radiance": 1.0}}
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
        (Capture(WHITE, CAMERA), -WHITE, "white: it is dark"),
        (
            Capture(WHITE, CAMERA),
            np.where(np.arange(128) < 48, 0, WHITE),
            r"white: 24 of 64 lenses have less than 0\.125 of the light of the brightest: it must fill the view",
        ),
        (
            Capture(WHITE, CAMERA),
            expose(Capture(WHITE, CAMERA), Detector(), photons=2e4),
            "white: [0-9]+ of its 16384 pixels are saturated: they must be at most 1%",
        ),
    ],
    ids=["camera", "crop", "wavelength", "colours", "model", "mosaic", "channels", "NaN", "dark", "part", "saturated"],
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
    """Each channel has its own unevenness; its radiance, and so the colour, is that of the capture."""
    waves = options["method"] != "ray"
    given = {"wavelength": COLOURS} if waves else {}
    slopes = 1 + np.linspace(-0.2, 0.2, 128)[:, None] * [1, 0, -1]
    image = reconstruct(0.5 * RGB * slopes, 210.0, camera=CAMERA, white=RGB * slopes, **options, **given).image
    np.testing.assert_allclose(image, np.broadcast_to([0.5, 0.4, 0.3], image.shape), rtol=1e-4)
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


@pytest.mark.parametrize("radiance", [0.02, 0.5, 2.0, 300.0])
def test_the_radiance_of_a_white_does_not_scale_images(radiance):
    """A white that falls off from the axis as cos^4 does, recorded at any exposure."""
    px, py = CAMERA.pixel_coordinates(0), CAMERA.pixel_coordinates(1)
    falling = (1 + (px**2 + py[:, None] ** 2) / 0.6**2) ** -2
    image = reconstruct(0.7 * WHITE * falling, 210.0, camera=CAMERA, white=radiance * WHITE * falling).image
    assert np.ptp(image) < 1e-4
    # The quarter of the lenses by which the radiance is found lies a little off the axis.
    assert image.mean() == pytest.approx(0.7, rel=0.1)
    even = reconstruct(0.7 * WHITE, 210.0, camera=CAMERA, white=Capture(radiance * WHITE, CAMERA)).image
    np.testing.assert_allclose(even, 0.7, rtol=1e-4)
    lf = decode(0.7 * WHITE, camera=CAMERA, white=radiance * WHITE)
    np.testing.assert_allclose(lf.values[lf.weight.values > 0], 0.7, rtol=1e-4)


def test_a_rendered_white_that_does_not_fill_the_view_is_refused_and_a_dim_one_named():
    """Squares of radiance 1: half as wide as the view, and seen by a small part of the pupil only."""
    sheet = {"type": "rectangle", "emitter": {"type": "area", "radiance": 1.0}}
    for distance, words in ((240, "of 64 lenses have less than 0.125"), (300, "16% of its light is distributed over")):
        place = mi.ScalarTransform4f().translate([0, 0, distance]).rotate([0, 1, 0], 180).scale(0.32)
        scene = {"type": "scene", "integrator": {"type": "direct"}, "sheet": {**sheet, "to_world": place}}
        white = render_capture(load_scene(scene | {"camera": CAMERA.to_sensor()}), spp=16)
        with pytest.raises(InputError, match=words):
            reconstruct(Capture(WHITE, CAMERA), 240.0, white=white)
        with pytest.raises(InputError, match=words):
            decode(WHITE, camera=CAMERA, white=white)
    with pytest.warns(UserWarning, match=r"white: 8 of 64 lenses have less than 0\.5 of the light of the brightest"):
        reconstruct(Capture(WHITE, CAMERA), 240.0, white=WHITE * np.where(np.arange(128) < 16, 0.3, 1))


def test_whites_by_pixels_of_slanted_response_restore_the_radiance():
    """Rays reach pixels at up to six degrees, which lose 15 % of them; the white knows how much."""
    camera = CAMERA.replace(pixel_response=(0, 1, 10, 0.5))
    white = render_capture(load_scene(SKY | {"camera": camera.to_sensor()}), spp=64)
    assert white.image.sum() / WHITE.sum() == pytest.approx(0.85, abs=0.01)
    np.testing.assert_allclose(reconstruct(white, 240.0, white=white).image, 1, rtol=1e-5)
