"""Metrics against closed forms, and how much of two captures' difference is noise."""

import math

import numpy as np
import pytest
import scipy
import skimage.metrics
from refusals import refused, refuses
from scipy.special import erf

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import Capture, PlenopticCamera
from mitsuba_plenoptic.report import metrics
from mitsuba_plenoptic.report.edge import square_sharpness, window_sharpness


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
    scale = (image * reference).sum() / (image**2).sum()
    assert metrics.common_scale(half[:1], half[1:]) == pytest.approx(scale, rel=1e-5)
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


def edge(sigma, angle, *, shape=(80, 64), offset=3.3, parts=1, rise=erf):
    """Return a Gaussian or other edge, `offset` right of the middle, as means of `parts` x `parts` points."""
    rows, columns = np.mgrid[: shape[0], : shape[1]].astype(float)
    turn = math.radians(angle)
    within = (np.arange(parts) + 0.5) / parts - 0.5

    def at(down, across):
        x, y = columns + across - (shape[1] - 1) / 2 - offset, rows + down - (shape[0] - 1) / 2
        return 0.1 + 0.4 * (1 + rise((x * math.cos(turn) - y * math.sin(turn)) / (sigma * 2**0.5)))

    return np.mean([at(down, across) for down in within for across in within], axis=0)


@pytest.mark.parametrize("angle", [2, -5, 7.125, 10])
@pytest.mark.parametrize("sigma", [0.4, 1.5])
@pytest.mark.parametrize("parts", [1, 12])
def test_known_transfer_functions(angle, sigma, parts):
    found = mp.edge_sharpness(edge(sigma, angle, parts=parts))
    turn, frequency = math.radians(angle), found.frequency[found.frequency <= 0.5]
    pixel = np.sinc(frequency * math.cos(turn)) * np.sinc(frequency * math.sin(turn)) if parts > 1 else 1
    known = np.exp(-2 * (math.pi * sigma * frequency) ** 2) * pixel
    np.testing.assert_allclose(found.transfer[: frequency.size], known, atol=0.005)
    assert found.angle == pytest.approx(angle, abs=0.1)
    assert found.upright and found.row == pytest.approx(39.5)
    assert found.column == pytest.approx(31.5 + 3.3, abs=0.05)
    if parts == 1:
        assert found.width == pytest.approx(2 * 1.28155 * sigma, abs=0.05)
        assert found.mtf50 == pytest.approx(math.sqrt(math.log(2) / 2) / (math.pi * sigma), rel=0.01)


def test_diffracted_light_beyond_the_reach_counts():
    """Against the transfer function of a round pupil that ends at a third of a cycle per pixel."""
    part = np.arange(0.5, 4000) / 4000
    known = 2 / math.pi * (np.arccos(part) - part * np.sqrt(1 - part**2))
    at = np.linspace(-50, 50, 4001)
    rise = np.sin(2 / 3 * math.pi * np.outer(at, part)) @ (known / part) / (2000 * math.pi)
    found = mp.edge_sharpness(edge(0.5**0.5, 7, rise=lambda distance: np.interp(distance, at, rise)))
    np.testing.assert_allclose(found.transfer[1:], np.interp(found.frequency[1:], part / 3, known, right=0), atol=0.004)


@pytest.mark.parametrize(("width", "offset"), [(0.3, 3.3), (4.0, 3.3), (8.0, -6.0), (15.0, 3.3)])
@pytest.mark.parametrize("noise", [0.0, 0.016])
def test_wide_edges_are_one(width, offset, noise):
    """Widths from 10 to 90 %; two edges 1.8 widths apart, of which each is as wide, are two."""
    random = np.random.default_rng(1)
    image = edge(width / 2.5631, 5, shape=(90, 90), offset=offset) + noise * random.standard_normal((90, 90))
    found = mp.edge_sharpness(image)
    assert found.width == pytest.approx(width, abs=0.1 + noise * width)
    if width > 1:
        assert found.mtf50 == pytest.approx(0.4805 / width, rel=0.03)
    second = edge(width / 2.5631, 5, shape=(90, 90), offset=offset + max(1.8 * width, 6))
    refuses("it has two edges or more", mp.edge_sharpness, (image + second) / 2)


def test_edges_are_found_anywhere_and_either_way():
    small, picture = edge(0.7, 6, shape=(60, 60)), np.full((140, 160), 0.1)
    picture[50:110, 30:90] = small
    # The bright half ends at the picture's ground, which is another edge beside it.
    refuses("it has two edges or more; cut out the one to measure", mp.edge_sharpness, picture)
    for image, upright in ((small, True), (small.T, False), (1 - small, True)):
        found = mp.edge_sharpness(image)
        assert found.upright is upright and found.mtf50 == pytest.approx(0.268, abs=0.003)
    bordered = np.pad(small, ((3, 0), (7, 2)), constant_values=np.nan)
    inside, whole = mp.edge_sharpness(bordered), mp.edge_sharpness(small)
    assert (inside.row, inside.column) == pytest.approx((whole.row + 3, whole.column + 7))
    colours = mp.edge_sharpness(np.stack([small] * 3, axis=2))
    np.testing.assert_allclose(colours.transfer, whole.transfer, atol=1e-6)


def square(sigma, tilt, size=48, side=26, fine=8):
    """Pixel means of a turned square whose edges are blurred by a Gaussian."""
    grid = (np.arange(size * fine) + 0.5) / fine - size / 2
    x, y = np.meshgrid(grid, grid)
    angle = math.radians(tilt)
    u, v = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)

    def box(w):
        return 0.5 * (erf((w + side / 2) / (sigma * 2**0.5)) - erf((w - side / 2) / (sigma * 2**0.5)))

    return (box(u) * box(v)).reshape(size, fine, size, fine).mean(axis=(1, 3))


@pytest.mark.parametrize(("sigma", "tilt"), [(0.5, 5), (1.0, -5)])
def test_edge_of_known_sharpness(sigma, tilt):
    picture = square(sigma, tilt)
    width, mtf50 = square_sharpness(picture, 24, 24, 26)
    frequency = np.linspace(1e-3, 1, 5000)
    transfer = np.exp(-2 * (math.pi * sigma * frequency) ** 2) * np.sinc(frequency)
    assert mtf50 == pytest.approx(frequency[np.argmax(transfer < 0.5)], rel=0.08)
    assert width == pytest.approx(2 * 1.2816 * math.hypot(sigma, 12**-0.5), rel=0.05)
    picture[4:6, 18:30] = 1
    assert square_sharpness(picture, 24, 24, 26)[0] == pytest.approx(width, rel=0.1)


test_what_is_no_single_slanted_edge_is_refused = refused(
    (
        lambda: mp.edge_sharpness(1 + 0.01 * np.random.default_rng(0).random((40, 40))),
        "it has no edge: all of it is alike",
    ),
    (lambda: mp.edge_sharpness(np.ones((3, 40))), "it has no edge: it is too small"),
    (lambda: mp.edge_sharpness(edge(0.7, 5) + edge(0.7, 5, offset=-15)), "it has two edges or more"),
    (lambda: mp.edge_sharpness(edge(0.7, 5, shape=(64, 64)) + edge(0.7, 3, shape=(64, 64)).T), "it has two edges"),
    (lambda: mp.edge_sharpness(np.minimum(edge(0.7, 5), 0.7)), "its edge is saturated"),
    (lambda: mp.edge_sharpness(edge(0.7, 0)), "its edge is turned by 0.0 degrees"),
    (lambda: mp.edge_sharpness(edge(0.7, 2, shape=(20, 64))), "its edge is 20 pixels long"),
    (lambda: mp.edge_sharpness(edge(0.7, 5, offset=26)), "its edge is nearer than 5 pixels to the border"),
    (lambda: mp.edge_sharpness(np.where(np.arange(64) == 40, np.nan, edge(0.7, 5))), "it has unknown values"),
    (lambda: window_sharpness(1 + 1e-3 * np.random.default_rng(0).random((16, 16))), "no edge"),
    (lambda: square_sharpness(square(0.7, 5), 4, 24, 26), "not in view"),
)
