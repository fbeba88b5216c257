"""How much of two captures' difference is noise."""

import numpy as np
import pytest
from cameras import letters

from mitsuba_plenoptic import Capture, PlenopticCamera, load_scene, render_capture
from mitsuba_plenoptic.report.metrics import capture_difference, middle_of_micro_images

CAMERA = PlenopticCamera(detector_width=0.512, resolution=(256, 256))


def noisy(image, sigma, seed):
    rng = np.random.default_rng(seed)
    return Capture(image + rng.normal(0, sigma, image.shape), CAMERA, noise=np.full(image.shape, sigma))


@pytest.mark.parametrize("sigma", [0.02, 0.3])
def test_the_true_difference_does_not_depend_on_noise(sigma):
    image = np.ones(CAMERA.shape)
    found = capture_difference(noisy(image, sigma, 0), noisy(1.1 * image, sigma, 1))
    assert found.true == pytest.approx(0.1 / 1.1, rel=0.1)
    assert found.measured == pytest.approx(np.hypot(found.noise, found.true), rel=1e-3)
    assert not found.noise_alone


def test_two_renders_by_rays_differ_by_noise_alone():
    scene = load_scene("letters", parameters=letters(8))
    a, b = (render_capture(scene, model="ray", spp=8, seed=seed, noise=True) for seed in (0, 1))
    found = capture_difference(a, b)
    assert found.noise_alone and found.measured > 0.01
    assert found.true < 0.35 * found.measured


def test_noise_that_is_not_known_is_not_told():
    image = np.ones(CAMERA.shape)
    found = capture_difference(Capture(image, CAMERA), noisy(image, 0.1, 0))
    assert found.noise is found.true is found.noise_alone is None


def test_the_middle_and_the_rim_share_the_difference():
    image = np.ones(CAMERA.shape)
    middle = middle_of_micro_images(CAMERA)
    # 64 discs of 80 % of the micro-image's 21.3 pixels.
    assert middle.sum() == pytest.approx(64 * np.pi / 4 * (0.8 * 21.33) ** 2, rel=0.05)
    other = Capture(np.where(middle, 1.2, 1.0), CAMERA, noise=np.zeros(CAMERA.shape))
    known = Capture(image, CAMERA, noise=np.zeros(CAMERA.shape))
    rim, inside, every = (capture_difference(other, known, pixels).true for pixels in (~middle, middle, None))
    assert rim == 0 and inside == pytest.approx(every)
