"""Which white captures a capture may be divided by."""

import numpy as np
import pytest

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.refocus import wave_methods
from mitsuba_plenoptic.views import capture_white, white_image

CAMERA = mp.PlenopticCamera(detector_width=0.512, resolution=(128, 128))
WHITE = white_image(CAMERA)
COLOURS = (620.0, 540.0, 460.0)
RGB = np.stack([WHITE, 0.8 * WHITE, 0.6 * WHITE], axis=-1)
SKY = {"type": "scene", "integrator": {"type": "direct"}, "sky": {"type": "constant", "radiance": 1.0}}
CROPS = [CAMERA.replace(crop_offset=offset, crop_size=(64, 96)) for offset in ((0, 0), (64, 32))]


def test_whites_may_be_by_the_camera_that_recorded_or_the_one_that_is_given():
    found = CAMERA.replace(mla_distance=119.5)
    dim = mp.Capture(0.5 * WHITE, CAMERA)
    for camera in (CAMERA, found):
        image = mp.reconstruct(dim, 210.0, camera=found, white=mp.Capture(WHITE, camera)).image
        np.testing.assert_allclose(image, 0.5, rtol=1e-5)
    with pytest.raises(mp.InputError, match=r"its camera has mla_distance = 119.0, that of the capture 120"):
        white = mp.Capture(WHITE, CAMERA.replace(mla_distance=119.0))
        mp.reconstruct(mp.Capture(WHITE, CAMERA), 210.0, camera=found, white=white)


def test_whites_in_colours_divide_each_channel_by_its_own():
    """Each channel has its own unevenness; its radiance, and so the colour, is that of the capture."""
    slopes = 1 + np.linspace(-0.2, 0.2, 128)[:, None] * [1, 0, -1]
    image = mp.reconstruct(0.5 * RGB * slopes, 210.0, camera=CAMERA, white=RGB * slopes).image
    np.testing.assert_allclose(image, np.broadcast_to([0.5, 0.4, 0.3], image.shape), rtol=1e-4)
    image = mp.reconstruct(RGB, 210.0, camera=CAMERA, white=WHITE).image
    np.testing.assert_allclose(image, np.broadcast_to([1, 0.8, 0.6], image.shape), rtol=1e-4)


def test_crops_and_exposed_captures_read_their_radiance_by_a_white_reference():
    """A crop cuts micro-images, whose light diffracts; noise makes pixels negative."""
    camera = CROPS[0]
    image = white_image(camera)
    dim = mp.expose(mp.Capture(0.5 * image, camera), mp.Detector(read_noise=3.0), photons=1e4)
    assert dim.image.min() < 0
    for options in ({"method": "ray"}, {"method": "coherent"}, {"method": "partial", "interleave": "auto"}):
        given = {} if options["method"] == "ray" else {"wavelength": 633.0}
        found = mp.reconstruct(dim, 210.0, white=mp.Capture(image, camera), **options, **given).image
        assert np.nanmax(np.abs(found - 0.5)) < 0.02
        assert np.nanmean(found) == pytest.approx(0.5, abs=0.003)


@pytest.mark.parametrize("radiance", [0.02, 300.0])
def test_the_radiance_of_a_white_does_not_scale_images(radiance):
    """A white that falls off from the axis as cos^4 does, recorded at any exposure."""
    px, py = CAMERA.pixel_coordinates(0), CAMERA.pixel_coordinates(1)
    falling = (1 + (px**2 + py[:, None] ** 2) / 0.6**2) ** -2
    image = mp.reconstruct(0.7 * WHITE * falling, 210.0, camera=CAMERA, white=radiance * WHITE * falling).image
    assert np.ptp(image) < 1e-4
    # The quarter of the lenses by which the radiance is found lies a little off the axis.
    assert image.mean() == pytest.approx(0.7, rel=0.1)
    even = mp.reconstruct(0.7 * WHITE, 210.0, camera=CAMERA, white=mp.Capture(radiance * WHITE, CAMERA)).image
    np.testing.assert_allclose(even, 0.7, rtol=1e-4)
    lf = mp.decode(0.7 * WHITE, camera=CAMERA, white=radiance * WHITE)
    np.testing.assert_allclose(lf.values[lf.weight.values > 0], 0.7, rtol=1e-4)


WAVES = ({"method": "coherent"}, {"method": "partial"}, {"method": "partial", "interleave": "auto"})
NARROW = mp.PlenopticCamera(
    focal_length=40, aperture_radius=5.0, mla_distance=60, mla_focal_length=0.12, mla_pitch=0.01996,
    detector_width=0.16, resolution=(80, 80),
)  # fmt: skip
WHITES = {"narrow": (NARROW, 115.0, {"oversample": 3}), "crop": (CROPS[1], 180.0, {})}


def read_one(capture, distances, options):
    for result in mp.reconstruct(capture, distances, **options):
        image = np.atleast_3d(result.image)
        assert np.nanmean(image[2:-2, 2:-2]) == pytest.approx(1, abs=0.01)
        for rim in (image[:2], image[-2:], image[:, :2], image[:, -2:]):
            assert not np.isfinite(rim).any() or np.nanmean(rim) == pytest.approx(1, abs=0.02)
        assert np.isfinite(image[2:-2, 2:-2]).mean() > 0.3


@pytest.mark.filterwarnings("ignore::mitsuba_plenoptic.PhysicsWarning")
@pytest.mark.parametrize(
    ("name", "model"),
    [("crop", "ray"), *(pytest.param(name, "wave", marks=pytest.mark.slow) for name in ("narrow", "crop"))],
)
def test_white_worlds_read_one_without_a_white(name, model):
    """In several planes, up to the borders, by every method, in colours of several wavelengths."""
    camera, distance, options = WHITES[name]
    scene = mp.load_scene(SKY | {"camera": camera.to_sensor()}, variant="llvm_ad_mono")
    capture = mp.render_capture(scene, model=model, spp=256, **({} if model == "ray" else {"wavelength": 600.0}))
    planes = [distance, 1.1 * distance]
    for waves in WAVES[:: 2 if name == "crop" else 1]:
        read_one(capture, planes, {**options, **waves, "wavelength": 450.0})
    read_one(capture, planes, {"method": "ray", **options})


def test_whites_are_of_each_channel_and_plane_and_known_once(monkeypatch):
    rgb = np.repeat(WHITE[..., None], 3, axis=2)
    calls = []
    propagate = wave_methods.reconstruct_subsets
    monkeypatch.setattr(
        wave_methods, "reconstruct_subsets", lambda *given, **more: calls.append(1) or propagate(*given, **more)
    )
    for count in (6, 9):
        read_one(mp.Capture(rgb, CAMERA), [201.0, 240.0], {"method": "coherent", "wavelength": COLOURS})
        assert len(calls) == count


@pytest.mark.slow
def test_the_white_of_a_wave_capture_is_by_waves():
    """The mean of captures of many samples, whose noise is 0.2 %; that of rays is far off."""
    camera = CAMERA.replace(mla_lattice="hexagonal", mla_rotation=7.0, mla_fill=0.9)
    scene = mp.load_scene(SKY | {"camera": camera.to_sensor()}, variant="llvm_ad_mono")
    captures = [mp.render_capture(scene, model="wave", spp=1024, seed=seed, wavelength=550.0) for seed in range(4)]
    mean = np.mean([capture.image for capture in captures], 0)
    white = capture_white(captures[0], 1)[..., 0]
    assert white.mean() == pytest.approx(mean.mean(), rel=5e-4)
    assert np.sqrt(np.mean((white - mean) ** 2)) < 4e-3 * mean.mean()
    assert np.sqrt(np.mean((white_image(camera) - mean) ** 2)) > 0.1 * mean.mean()
    assert capture_white(captures[0], 1) is capture_white(captures[1], 1)


def test_a_wave_capture_without_a_wavelength_says_that_its_white_is_by_rays():
    capture = mp.Capture(WHITE, CAMERA, model="wave")
    with pytest.warns(UserWarning, match="white: it is computed by rays, .* the capture states none"):
        np.testing.assert_allclose(mp.reconstruct(capture, 240.0).image, 1, rtol=1e-5)
