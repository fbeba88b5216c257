"""Readings of the paper's four subsets: their sums, the light that a letter's image needs, and colourings."""

from __future__ import annotations

import numpy as np
import pytest
from cameras import HALF, WAVELENGTH, small_camera

from mitsuba_plenoptic import Capture, reconstruct
from mitsuba_plenoptic.extensions.paper.readings import colour_count, diagonals, of_subsets, quarters, surroundings
from mitsuba_plenoptic.report.metrics import interference
from mitsuba_plenoptic.views import white_image


def white(camera):
    return Capture(white_image(camera), camera, wavelength=WAVELENGTH)


def interleaved(i, j):
    return i % 2 + 2 * (j % 2)


def test_interleaved_labels_are_interleave():
    camera = small_camera(8, **HALF)
    rows, columns = np.indices(camera.shape)
    # Micro-images of different brightness.
    image = white_image(camera) * (1 + np.sin(rows / 32) ** 2 + np.cos(columns / 50) ** 2)
    capture = Capture(image.astype(np.float32), camera, wavelength=WAVELENGTH)
    image = of_subsets(capture, 140.0, interleaved)
    expected = reconstruct(capture, 140.0, method="partial", interleave=2).image
    # What strays to the next lens's cell is another subset's there.
    assert interference(image, expected, np.isfinite(expected)) < 3e-3
    assert interference(image, of_subsets(capture, 140.0, quarters), np.isfinite(expected)) > 0.008


def test_quarters_meet_on_the_axis():
    i, j = np.meshgrid(np.arange(-3, 3), np.arange(-3, 3))
    assert [np.count_nonzero(quarters(i, j) == quarter) for quarter in range(4)] == [9] * 4
    assert len({int(quarters(x, y)) for x in (-1, 0) for y in (-1, 0)}) == 4


def test_an_image_needs_the_light_around_it_alone():
    capture, window = white(small_camera(24)), (slice(8, 12), slice(12, 16))
    part = surroundings(capture, window, 250.0)
    assert 0.1 < np.count_nonzero(part.image) / np.count_nonzero(capture.image) < 0.6
    images = [reconstruct(each, 250.0, method="coherent").image[window] for each in (capture, part)]
    assert images[1] == pytest.approx(images[0], rel=5e-3)


@pytest.mark.parametrize("distance", [225.0, 280.0])
def test_colours_are_as_many_as_the_blur_asks_for(distance):
    # The whole pupil, imaged through the point of the lens, written out.
    blur = abs(1 + 120 / distance - 120 / 80) * 10.0 / 0.064
    x, y = np.meshgrid(np.arange(20), np.arange(20))
    # Lenses that all overlap need a colour each; and a period of the blur and three bins would be enough.
    together = np.count_nonzero(np.hypot(x - 9.5, y - 9.5) < blur / 2)
    assert together <= colour_count(white(small_camera(20)), distance) <= (np.ceil(blur) + 3) ** 2


def test_dark_lenses_take_no_colours():
    camera = small_camera(20)
    image = white_image(camera)
    cut = np.zeros_like(image)
    cut[:, 6 * 32 : 8 * 32] = image[:, 6 * 32 : 8 * 32]
    some = colour_count(Capture(cut, camera, wavelength=WAVELENGTH), 225.0)
    assert some < colour_count(Capture(image, camera, wavelength=WAVELENGTH), 225.0) / 2


def regular(along, across, shift):
    """Label the lattice of steps (along, 0) and (shift, across), and its shifted copies."""
    return lambda i, j: j % across * along + (i - shift * (j // across)) % along


@pytest.mark.slow
def test_diagonals_interfere_least_of_the_regular_subsets():
    """On a bright square: an even world is divided by itself and shows nothing."""
    capture = white(small_camera(24))
    rows, columns = np.abs(np.indices(capture.image.shape) - 383.5)
    capture.image[(rows > 150) | (columns > 150)] = 0
    limit = reconstruct(capture, 280.0, method="partial", interleave="auto").image

    def left(label):
        return interference(of_subsets(capture, 280.0, label), limit, (slice(3, -3),) * 2)

    # The other diagonal, 4 1 1, is its mirror image.
    others = sorted(left(regular(along, 4 // along, shift)) for along in (1, 2, 4) for shift in range(along))
    of_diagonals = left(diagonals)
    assert of_diagonals == pytest.approx(others[0], rel=0.1)
    assert of_diagonals < 0.7 * others[2]
    assert of_diagonals < 0.7 * left(interleaved) < 0.3 * left(quarters)
