"""Parameters of a fitted camera: the blur of its detector, against Gaussian convolutions by SciPy."""

import mitsuba as mi
import numpy as np
import pytest
from cameras import error
from scipy.ndimage import gaussian_filter

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, reconstruct, render_capture
from mitsuba_plenoptic.io.captures import Capture
from mitsuba_plenoptic.light.detector import mix_pixels
from mitsuba_plenoptic.views.white import white_image

CAMERA = PlenopticCamera(resolution=(32, 32), detector_width=0.256)
"""Of 4 x 4 lenses with pixels of 8 micrometres."""

BLUR = 0.012
"""A blur of 1.5 pixels."""


def capture(camera, spp, model="ray", **options):
    """Return the capture of a small lamp in focus."""
    place = mi.ScalarTransform4f().translate([0.05, 0, 238]).scale(0.1).rotate([0, 1, 0], 180)
    lamp = {"type": "rectangle", "to_world": place, "light": {"type": "area", "radiance": 1.0}}
    scene = {"type": "scene", "camera": camera.to_sensor(), "lamp": lamp, "integrator": {"type": "direct"}}
    return render_capture(mi.load_dict(scene), spp=spp, model=model, **options)


def render(*given):
    return capture(*given).image


def blurred(image, blur, camera):
    return gaussian_filter(image, blur / camera.pixel_size, mode="reflect", truncate=8, axes=(0, 1))


# -- blur --------------------------------------------------------------------------------------------


def test_blurs_are_gaussian_and_keep_the_light():
    a, b = np.random.default_rng(0).random((2, 19, 17, 2))
    camera = CAMERA.replace(detector_blur=BLUR)
    mixed = mix_pixels(a, camera)
    assert mixed == pytest.approx(blurred(a, BLUR, camera), abs=1e-6)
    assert mixed.sum() == pytest.approx(a.sum())
    assert np.sum(mixed * b) == pytest.approx(np.sum(a * mix_pixels(b, camera)))
    # Below a pixel, where samples of a Gaussian would have too small a variance.
    impulse = np.zeros((1, 41))
    impulse[0, 20] = 1
    narrow = mix_pixels(impulse, CAMERA.replace(detector_blur=0.4 * CAMERA.pixel_size))
    # Nowhere does it take light away, however wide it is.
    for width in (1e-6, 0.05, 0.4, 1.0, 1.5, 30.0):
        assert mix_pixels(impulse, CAMERA.replace(detector_blur=width * CAMERA.pixel_size)).min() >= 0
    along = np.arange(41)
    smooth = 1 + np.cos(2 * np.pi * (along - 20) / 16)
    assert (narrow * smooth).sum() == pytest.approx(1 + np.exp(-0.5 * (0.4 * 2 * np.pi / 16) ** 2), abs=1e-3)


def test_ray_captures_are_blurred_within_pixels():
    """By a third of a pixel, against pixels of a fifteenth, whose sums are blurred by SciPy."""
    fine = CAMERA.replace(resolution=(160, 160))
    parts = blurred(render(fine, 256), 0.0027, fine).reshape(32, 5, 32, 5).mean((1, 3))
    found = render(CAMERA.replace(detector_blur=0.0027), 4096)
    plain = render(CAMERA, 4096)
    assert error(found, parts) < 0.02
    assert error(plain, parts) > 0.04


def test_wave_captures_are_blurred_captures():
    plain, found = (render(CAMERA.replace(detector_blur=x), 32, "wave") for x in (0.0, BLUR))
    assert error(found, blurred(plain, BLUR, CAMERA)) < 1e-5
    assert error(found, plain) > 0.1
    # Their noise is that of blurred images, whose pixels do not deviate independently.
    camera = CAMERA.replace(detector_blur=BLUR)
    every = [capture(camera, 32, "wave", seed=seed, noise=True) for seed in range(8)]
    variance = np.var([each.image for each in every], axis=0, ddof=1).mean()
    assert np.mean([each.noise**2 for each in every]) == pytest.approx(variance, rel=0.25)


def test_points_are_blurred_forward_and_back():
    camera = CAMERA.replace(detector_blur=BLUR, pixel_crosstalk=0.0)
    points, given = [(0.0, 0.0, 236.0), (0.03, 0.02, 240.0)], np.array([1.0, 2.0])
    plain, operator = (CaptureOperator(each, points, wavelength=633) for each in (CAMERA, camera))
    image, other = operator.forward(given), np.random.default_rng(0).random(camera.shape, np.float32)
    assert error(image, blurred(plain.forward(given), BLUR, camera)) < 1e-5
    assert np.sum(image * other) == pytest.approx(operator.adjoint(other) @ given, rel=1e-5)
    change = {"detector_distance": 1.0}
    slope = operator.derivative(given, change)
    assert error(slope, blurred(plain.derivative(given, change), BLUR, camera)) < 1e-4
    felt = operator.gradient(given, other, ["detector_distance"])["detector_distance"]
    assert np.sum(slope * other) == pytest.approx(float(np.sum(felt)), rel=1e-3)


def test_white_images_are_blurred():
    camera = CAMERA.replace(detector_blur=BLUR)
    assert error(white_image(camera), blurred(white_image(CAMERA), BLUR, camera)) < 1e-5


@pytest.mark.parametrize("model", ["ray", "wave"])
def test_reconstructions_know_the_blur(model):
    """They show the lamp as the camera without blur does; its blur by 1.5 of 8 pixels a lens moves light off lenses."""
    sharp, blurry = (capture(CAMERA.replace(detector_blur=x), 1024, model) for x in (0.0, BLUR))
    for method in ("ray", "coherent", "partial", "incoherent", "deconvolved"):
        options = {"method": method, "wavelength": None if method in ("ray", "deconvolved") else 633.0}
        found, expected = (reconstruct(each, 240, **options).image for each in (blurry, sharp))
        assert error(found, expected) < 0.05, method
    ignored = reconstruct(Capture(blurry.image, CAMERA, 633.0, model), 240).image
    assert error(ignored, reconstruct(sharp, 240).image) > 0.2
