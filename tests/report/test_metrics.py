"""Metrics against closed forms, and how much of two captures' difference is noise."""

import math

import numpy as np
import pytest
import scipy
import skimage.metrics

from mitsuba_plenoptic import Capture, PlenopticCamera
from mitsuba_plenoptic.report import metrics


def test_a_black_reference_is_met_by_black_alone():
    black = np.zeros((8, 8))
    for image, best in ((black, (math.inf, 1)), (black + 0.1, (-math.inf, math.inf))):
        found = metrics.image_metrics(image, black)
        assert (found.psnr, found.energy) == best
        assert found.ssim is None


@pytest.mark.parametrize("shape", [(64, 64), (64, 48, 3)])
def test_what_is_unknown_does_not_count(shape):
    """Against scikit-image on the known part alone, in both images and in each."""
    random = np.random.default_rng(4)
    reference = random.random(shape, dtype=np.float32)
    image = (reference + random.normal(0, 0.3, shape)).astype(np.float32)
    part, peak = (slice(9, 40), slice(None, 30)), float(reference[9:40, :30].max())
    half = [np.full(shape, np.nan, np.float32) for _ in range(2)]
    half[0][9:40], half[1][:, :30] = image[9:40], reference[:, :30]
    image, reference = image[part], reference[part]
    found = metrics.image_metrics(*half)
    channels = -1 if len(shape) == 3 else None
    psnr = skimage.metrics.peak_signal_noise_ratio(reference, image, data_range=peak)
    ssim = skimage.metrics.structural_similarity(reference, image, data_range=peak, channel_axis=channels)
    assert (found.psnr, found.ssim) == pytest.approx((psnr, ssim), rel=1e-4)
    assert found.energy == pytest.approx(image.sum() / reference.sum(), rel=1e-5)
    assert metrics.common_scale(half[:1], half[1:]) == pytest.approx(
        (image * reference).sum() / (image**2).sum(), rel=1e-5
    )
    nothing = metrics.image_metrics(half[0], np.full(shape, np.nan))
    assert math.isnan(nothing.psnr) and nothing.ssim is None


def test_errors_and_interference_are_root_mean_squares():
    references = [np.full((4, 4), 2.0), np.full((4, 4), 6.0)]
    assert metrics.common_scale([0.5 * one for one in references], references) == pytest.approx(2)
    assert metrics.common_scale([np.zeros((4, 4))], references[:1]) == 1
    assert metrics.relative_error(np.array([1.0, 1.1]), np.ones(2)) == pytest.approx(0.1 / math.sqrt(2))
    limit = np.full((8, 8), 4.0)
    mesh = limit + 0.2 * (-1) ** np.add.outer(np.arange(8), np.arange(8))
    for part in (metrics.lit_region(limit), (slice(0, 2), slice(0, 2))):
        assert metrics.interference(mesh, limit, part) == pytest.approx(0.05)


def test_the_window_of_a_letter_holds_its_image():
    # The 8 of the letters: 4 mm tall around (2.8, 0, 210); +x is left in the picture.
    rows, columns = metrics.shape_window(PlenopticCamera(), np.array([1.7, -2, 210]), np.array([3.9, 2, 210]))
    assert (columns.start, columns.stop) == (64 - math.ceil(3.9 / 0.112), 64 - math.floor(1.7 / 0.112))
    assert (rows.start, rows.stop) == (64 - math.ceil(2 / 0.112), 64 + math.ceil(2 / 0.112))
    assert metrics.shape_window(PlenopticCamera(), np.array([50, 0, 240]), np.array([60, 1, 240])) is None


def test_images_smaller_than_the_window_of_ssim_have_none():
    reference = np.linspace(1, 2, 240).reshape(6, 40)
    found = metrics.image_metrics(1.1 * reference, reference)
    assert found.ssim is None and found.energy == pytest.approx(1.1)
    assert found.psnr == pytest.approx(20 * math.log10(reference.max() / (0.1 * np.sqrt(np.mean(reference**2)))))


CAMERA = PlenopticCamera(detector_width=0.512, resolution=(256, 256))


def noisy(image, sigma, seed):
    rng = np.random.default_rng(seed)
    return Capture(image + rng.normal(0, sigma, image.shape), CAMERA, noise=np.full(image.shape, sigma))


@pytest.mark.parametrize("sigma", [0.02, 0.3])
def test_the_true_difference_does_not_depend_on_noise(sigma):
    image = np.ones(CAMERA.shape)
    found = metrics.capture_difference(noisy(image, sigma, 0), noisy(1.1 * image, sigma, 1))
    assert found.true == pytest.approx(0.1 / 1.1, rel=0.1)
    assert found.measured == pytest.approx(np.hypot(found.noise, found.true), rel=1e-3)
    assert not found.noise_alone
    unknown = metrics.capture_difference(Capture(image, CAMERA), noisy(image, sigma, 0))
    assert unknown.noise is unknown.true is unknown.noise_alone is None


def test_the_middle_and_the_rim_share_the_difference():
    image = np.ones(CAMERA.shape)
    middle = metrics.middle_of_micro_images(CAMERA)
    # 64 discs of 80 % of the micro-image's 21.3 pixels.
    assert middle.sum() == pytest.approx(64 * np.pi / 4 * (0.8 * 21.33) ** 2, rel=0.05)
    other = Capture(np.where(middle, 1.2, 1.0), CAMERA, noise=np.zeros(CAMERA.shape))
    known = Capture(image, CAMERA, noise=np.zeros(CAMERA.shape))
    rim, inside, every = (metrics.capture_difference(other, known, pixels).true for pixels in (~middle, middle, None))
    assert rim == 0 and inside == pytest.approx(every)


def test_noise_is_not_taken_for_a_change_of_contrast():
    random = np.random.default_rng(1)
    truth = np.kron(random.random((8, 8)), np.ones((4, 4)))
    changed = 0
    for _ in range(40):
        images = (truth + 0.05 * random.normal(size=truth.shape) for _ in range(2))
        changed += metrics.contrast_change(*images, truth).ratio != 1
    # Half, with a scatter of independent frequencies.
    assert changed < 2


@pytest.mark.parametrize(("blur", "noise", "ratio"), [(0.8, 0.01, 0.8), (0.1, 0.01, 1.0), (0.8, 30.0, 1.0)])
def test_a_change_of_contrast_is_told_from_noise(blur, noise, ratio):
    random = np.random.default_rng(0)
    truth = random.random((96, 128))
    images = (truth, scipy.ndimage.gaussian_filter(truth, blur, mode="wrap"))
    found = metrics.contrast_change(*(image + noise * random.normal(size=truth.shape) for image in images), truth)
    # The transfer function of a Gaussian.
    expected = math.exp(-2 * (math.pi * blur * found.frequency) ** 2) if ratio < 1 else 1
    assert found.ratio == pytest.approx(expected, abs=0.03)
    assert (found.ratio < 0.8) == (ratio < 1)
    assert (found.finest > 0.4) == (noise < 1)
