"""Partitions of the lenses: their arrays, the sums of their subsets, colourings against geometry and interference."""

from __future__ import annotations

import numpy as np
import pytest
from wave_cases import HALF, LATTICES, WAVELENGTH, small_camera

from mitsuba_plenoptic import Capture, reconstruct
from mitsuba_plenoptic.extensions.paper.partitions import (
    LensArray,
    blocks,
    coloured,
    refocused,
    sublattice,
    sublattice_interference,
)
from mitsuba_plenoptic.report.metrics import interference
from mitsuba_plenoptic.views.white_image import white_image

DISTANCE = 140.0
SMALL = small_camera(8, **HALF)


def scene_of(camera, seed=0):
    """Return micro-images of white, each of its own brightness."""
    lenses = LensArray.of(camera)
    brightness = lenses.of_pixels(np.random.default_rng(seed).uniform(0.3, 1, lenses.shape))
    return Capture((white_image(camera) * brightness).astype(np.float32), camera, wavelength=WAVELENGTH)


def partial(capture, **options):
    return reconstruct(capture, DISTANCE, method="partial", **options).image


def of_subsets(capture, labels, distance=DISTANCE):
    return refocused(capture, [distance], labels)[distance]


def interleaved(camera, period):
    """Label every `period`-th lens along both axes alike."""
    lenses = LensArray.of(camera)
    row, column = (index + first for index, first in zip(np.indices(lenses.shape), lenses.first[::-1], strict=True))
    return row % period * period + column % period


@pytest.mark.parametrize("crop", [{}, {"crop_offset": (40, 70), "crop_size": (150, 101)}], ids=["whole", "cropped"])
def test_labels_are_arranged_like_the_micro_images(crop):
    camera = SMALL.replace(**crop)
    lenses = LensArray.of(camera)
    # Micro-images are (b + z) / b as wide as lenses, written out.
    b, z = camera.mla_distance, camera.detector_distance
    row, column = (np.floor(camera.pixel_coordinates(axis) * b / (b + z) / camera.mla_pitch) for axis in (1, 0))
    assert lenses.shape == (len(set(row)), len(set(column)))
    numbers = np.arange(lenses.shape[0] * lenses.shape[1]).reshape(lenses.shape)
    expected = (row - row.min())[:, None] * lenses.shape[1] + column - column.min()
    np.testing.assert_array_equal(lenses.of_pixels(numbers), expected)


@pytest.mark.parametrize("lattice", LATTICES.values(), ids=LATTICES)
def test_every_pixel_has_the_label_of_its_lens_on_any_lattice(lattice):
    camera = small_camera(8, **HALF, **lattice)
    lenses = LensArray.of(camera)
    x, y = (values.reshape(lenses.shape) for values in lenses.centres)
    row, column = np.indices(camera.shape)
    b, z = camera.mla_distance, camera.detector_distance
    at = [camera.pixel_coordinates(axis)[index] * b / (b + z) for axis, index in ((0, column), (1, row))]
    away = np.hypot(lenses.of_pixels(x) - at[0], lenses.of_pixels(y) - at[1])
    assert away.max() <= camera.lattice.cell_reach + 1e-9
    # No other lens is nearer, except on the borders of cells.
    if camera.mla_pitches[0] == camera.mla_pitches[1]:
        nearest = np.min([np.hypot(x.flat[k] - at[0], y.flat[k] - at[1]) for k in range(x.size)], axis=0)
        np.testing.assert_allclose(away, nearest, atol=1e-9)


@pytest.mark.parametrize(
    ("period", "lattice"),
    [
        (1, "hexagonal"),
        (2, "square"),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in ((1, "square"), (2, "hexagonal"), (3, "square"), (3, "hexagonal"))
        ),
    ],
)
def test_interleaved_labels_are_interleave(period, lattice):
    camera = small_camera(8, **HALF, **LATTICES.get(lattice, {}))
    capture = scene_of(camera)
    found = of_subsets(capture, interleaved(camera, period))
    expected = partial(capture, interleave=period)
    # What strays to the next lens's cell is another subset's there.
    assert interference(found, expected, np.isfinite(expected)) < 3e-3
    if period > 1:
        assert interference(found, partial(capture, interleave=1), np.isfinite(expected)) > 0.008


@pytest.mark.slow
def test_a_label_for_each_lens_is_the_limit_without_interference():
    capture = scene_of(SMALL)
    every = np.arange(LensArray.of(SMALL).centres[0].size).reshape(LensArray.of(SMALL).shape)
    limit = partial(capture, interleave="auto")
    region = np.isfinite(limit)
    assert interference(of_subsets(capture, every), limit, region) < 0.01
    assert interference(partial(capture, interleave=1), limit, region) > 0.05


def test_blocks_are_contiguous_rectangles_of_nearly_equal_size():
    labels = blocks(small_camera(8), 3)
    assert len(np.unique(labels)) == 9
    for label in range(9):
        rows, columns = np.nonzero(labels == label)
        height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
        assert len(rows) == height * width and {height, width} <= {2, 3}


@pytest.mark.parametrize("lattice", [{}, LATTICES["hexagonal"]], ids=["square", "hexagonal"])
def test_images_of_lit_lenses_of_one_colour_do_not_overlap(lattice):
    camera = small_camera(20, **lattice)
    distance = 225.0
    capture = Capture(white_image(camera), camera, wavelength=WAVELENGTH)
    labels, (x, y) = coloured(capture, distance).ravel(), LensArray.of(camera).centres
    # The whole pupil, imaged through the point of the lens, written out.
    blur = abs(1 + 120 / distance - 120 / 80) * 10.0
    lit = np.hypot(x, y) < 0.5
    apart = np.hypot(x - x[:, None], y - y[:, None])
    same = (labels == labels[:, None]) & lit & lit[:, None] & (apart > 0)
    assert apart[same].min() > blur
    # Lenses that all overlap need a colour each; and a period of the blur and three bins would be enough.
    near = (np.hypot(x - x[np.argmin(np.hypot(x, y))], y - y[np.argmin(np.hypot(x, y))]) < blur / 2).sum()
    assert near <= labels.max() + 1 <= (np.ceil(blur / 0.064) + 3) ** 2


def test_dark_lenses_take_no_colours():
    camera = small_camera(20)
    lenses = LensArray.of(camera)
    half = np.zeros(lenses.shape)
    half[:, 6:8] = 1
    image = white_image(camera)
    some = coloured(Capture((image * lenses.of_pixels(half)).astype(np.float32), camera, wavelength=WAVELENGTH), 225.0)
    every = coloured(Capture(image, camera, wavelength=WAVELENGTH), 225.0)
    assert some.max() < every.max() / 2
    assert coloured(Capture(0 * image, camera, wavelength=WAVELENGTH), 225.0).max() == 0


@pytest.mark.parametrize("lattice", [{}, LATTICES["hexagonal"]], ids=["square", "hexagonal"])
def test_a_sublattice_has_equal_copies_and_repeats(lattice):
    camera = small_camera(16, **lattice)
    labels = sublattice(camera, 280.0, 7, WAVELENGTH)
    assert sorted(np.unique(labels)) == list(range(7))
    # A prime count, so that seven steps along a row or a column come to the same subset, and fewer do not.
    np.testing.assert_array_equal(labels[:, 7:], labels[:, :-7])
    np.testing.assert_array_equal(labels[7:], labels[:-7])
    assert all((labels[:, k:] != labels[:, :-k]).all() or (labels[k:] != labels[:-k]).all() for k in range(1, 7))


def test_in_focus_a_sublattice_is_as_sparse_as_it_can_be():
    labels = sublattice(small_camera(16), 240.0, 5, WAVELENGTH)
    rows, columns = np.nonzero(labels == labels[8, 8])
    away = np.hypot(rows - 8, columns - 8)
    # Steps of a knight.
    assert away[away > 0].min() == pytest.approx(np.sqrt(5))


@pytest.fixture(scope="module")
def white():
    """Return a capture of white, and its image without interference between lenses."""
    camera = small_camera(24)
    capture = Capture(white_image(camera), camera, wavelength=WAVELENGTH)
    return capture, reconstruct(capture, 280.0, method="partial", interleave="auto").image


@pytest.mark.parametrize(
    ("step", "labels"),
    [
        ((1, 1, 0), lambda i, j: 0 * i),
        pytest.param((2, 2, 0), lambda i, j: i % 2 + 2 * (j % 2), marks=pytest.mark.slow),
        pytest.param((2, 1, 1), lambda i, j: (i - j) % 2, marks=pytest.mark.slow),
        ((5, 1, 2), lambda i, j: (i - 2 * j) % 5),
        pytest.param((7, 1, 4), lambda i, j: (i - 4 * j) % 7, marks=pytest.mark.slow),
    ],
)
def test_predicted_interference_is_that_of_white(step, labels, white):
    capture, limit = white
    j, i = np.indices(limit.shape)
    image = of_subsets(capture, labels(i, j), 280.0)
    # Bins that get the light of whole micro-images.
    found = interference(image, limit, (slice(7, -7),) * 2)
    (predicted,) = sublattice_interference(capture.camera, 280.0, WAVELENGTH, [step])
    assert found == pytest.approx(predicted, rel=0.45, abs=0.004)


@pytest.mark.slow
def test_the_best_sublattice_of_four_interferes_less_than_every_second_lens(white):
    capture, limit = white
    left = {
        name: interference(of_subsets(capture, labels, 280.0), limit, (slice(3, -3),) * 2)
        for name, labels in {
            "interleaved": interleaved(capture.camera, 2),
            "blocks": blocks(capture.camera, 2),
            "sublattice": sublattice(capture.camera, 280.0, 4, WAVELENGTH),
        }.items()
    }
    assert left["sublattice"] < 0.7 * left["interleaved"] < 0.3 * left["blocks"]
