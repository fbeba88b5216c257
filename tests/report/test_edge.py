"""Slanted edges: their transfer functions against closed forms, their places, and what is no such edge."""

import math

import numpy as np
import pytest
from refusals import refuses
from scipy.special import erf

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.report.edge import square_sharpness, window_sharpness


def edge(sigma, angle, *, shape=(80, 64), offset=3.3, parts=1):
    """Return an edge blurred by a Gaussian, `offset` right of the middle, as means of `parts` x `parts` points."""
    rows, columns = np.mgrid[: shape[0], : shape[1]].astype(float)
    turn = math.radians(angle)
    within = (np.arange(parts) + 0.5) / parts - 0.5

    def at(down, across):
        x, y = columns + across - (shape[1] - 1) / 2 - offset, rows + down - (shape[0] - 1) / 2
        return 0.1 + 0.4 * (1 + erf((x * math.cos(turn) - y * math.sin(turn)) / (sigma * 2**0.5)))

    return np.mean([at(down, across) for down in within for across in within], axis=0)


@pytest.mark.parametrize("angle", [2, -2, 5, 7.125, -8, 10])
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


def test_noise_and_digital_numbers_change_little():
    known = mp.edge_sharpness(edge(0.7, 5))
    noisy = edge(0.7, 5) + 0.004 * np.random.default_rng(1).standard_normal((80, 64))
    for image in (noisy, np.round(255 * edge(0.7, 5))):
        found = mp.edge_sharpness(image)
        lower = found.frequency <= 0.5
        np.testing.assert_allclose(found.transfer[lower], known.transfer[lower], atol=0.02)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (1 + 0.01 * np.random.default_rng(0).random((40, 40)), "it has no edge: all of it is alike"),
        (np.ones((3, 40)), "it has no edge: it is too small"),
        (edge(0.7, 5) + edge(0.7, 5, offset=-15), "it has two edges or more"),
        (edge(0.7, 5, shape=(64, 64)) + edge(0.7, 3, shape=(64, 64)).T, "it has two edges or more"),
        (np.minimum(edge(0.7, 5), 0.7), "its edge is saturated"),
        (edge(0.7, 0), "its edge is turned by 0.0 degrees"),
        (edge(0.7, 2, shape=(20, 64)), "its edge is 20 pixels long"),
        (edge(0.7, 5, offset=26), "its edge is nearer than 5 pixels to the border"),
        (np.where(np.arange(64) == 40, np.nan, edge(0.7, 5)), "it has unknown values"),
    ],
)
def test_what_is_no_single_slanted_edge_is_refused_in_one_line(image, words):
    with pytest.raises(mp.InputError) as found:
        mp.edge_sharpness(image)
    assert str(found.value).partition("image")[2].lstrip(": ").startswith(words)
    assert "\n" not in str(found.value)


def square(sigma, tilt, size=48, side=26, fine=8):
    """Pixel means of a turned square whose edges are blurred by a Gaussian."""
    grid = (np.arange(size * fine) + 0.5) / fine - size / 2
    x, y = np.meshgrid(grid, grid)
    angle = math.radians(tilt)
    u, v = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)

    def box(w):
        return 0.5 * (erf((w + side / 2) / (sigma * 2**0.5)) - erf((w - side / 2) / (sigma * 2**0.5)))

    return (box(u) * box(v)).reshape(size, fine, size, fine).mean(axis=(1, 3))


@pytest.mark.parametrize("sigma", [0.5, 0.7, 1.0])
@pytest.mark.parametrize("tilt", [5, -5])
def test_edge_of_known_sharpness(sigma, tilt):
    width, mtf50 = square_sharpness(square(sigma, tilt), 24, 24, 26)
    frequency = np.linspace(1e-3, 1, 5000)
    transfer = np.exp(-2 * (math.pi * sigma * frequency) ** 2) * np.sinc(frequency)
    assert mtf50 == pytest.approx(frequency[np.argmax(transfer < 0.5)], rel=0.08)
    assert width == pytest.approx(2 * 1.2816 * math.hypot(sigma, 12**-0.5), rel=0.05)


def test_an_object_near_one_edge_does_not_matter():
    picture = square(0.7, 5)
    clean, _ = square_sharpness(picture, 24, 24, 26)
    picture[4:6, 18:30] = 1
    assert square_sharpness(picture, 24, 24, 26)[0] == pytest.approx(clean, rel=0.1)


def test_where_there_is_no_edge():
    refuses("no edge", window_sharpness, np.ones((16, 16)) + 1e-3 * np.random.default_rng(0).random((16, 16)))
    refuses("not in view", square_sharpness, square(0.7, 5), 4, 24, 26)
