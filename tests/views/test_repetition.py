"""Where texture repeats within micro-images: stripes, edges and random patterns written into them."""

import dataclasses
import functools

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.views import micro_images
from mitsuba_plenoptic.views.agreement import finer_stripes
from mitsuba_plenoptic.views.repetition import wrong_by_repetition

FOCUSED = {"mla_focal_length": 0.384, "mla_distance": 121.536, "aperture_radius": 4.9}
SLOPES = np.concatenate([-1 / np.linspace(2, 9, 30), 1 / np.linspace(2, 9, 30)])


@functools.cache
def blank(lattice="square"):
    camera = mp.PlenopticCamera(detector_width=1.024, resolution=(256, 256), mla_lattice=lattice).replace(**FOCUSED)
    return micro_images(np.ones(camera.shape), camera=camera)


def showing(pattern, lattice="square"):
    """Micro-images that show a function of v, u and a random number of each lens."""
    images = blank(lattice)
    v, u = np.indices(images.weight.shape[2:], dtype=float)
    phase = np.random.default_rng(0).random((*images.weight.shape[:2], 1, 1))
    values = (pattern(v, u, phase) * np.ones(images.weight.shape)).astype(np.float32)
    return dataclasses.replace(images, values=(values * (images.weight > 0))[..., None])


def stripes(period, noise=0.0, level=False):
    random = np.random.default_rng(1)

    def pattern(v, u, phase):
        values = 0.5 + 0.1 * np.sin(2 * np.pi * ((v if level else u) / period + phase))
        return values + noise * random.normal(size=values.shape)

    return pattern


@pytest.mark.parametrize("lattice", ["square", "hexagonal"])
@pytest.mark.parametrize("level", [False, True])
def test_stripes_are_doubted_the_more_the_finer_they_are(lattice, level):
    wrong = [wrong_by_repetition(showing(stripes(period, level=level), lattice), SLOPES) for period in (3, 4, 6)]
    assert wrong[0].shape == blank(lattice).bins.shape
    # Of periods of 3, 4, and 5 or more pixels 12, 55 and 84 % of the depths were right.
    for found, least, most in zip(wrong, (0.74, 0.49, 0.12), (0.76, 0.51, 0.17), strict=True):
        assert least < found.min() <= found.max() < most


@pytest.mark.parametrize("width", [0.0, 1.0, 2.0])
def test_random_texture_and_edges_do_not_repeat(width):
    random = np.random.default_rng(2)

    def texture(v, u, phase):
        values = random.normal(size=(*phase.shape[:2], *v.shape))
        return 0.5 + 0.1 * (gaussian_filter(values, (0, 0, width, width)) if width else values)

    assert np.median(wrong_by_repetition(showing(texture), SLOPES)) < 0.05
    assert wrong_by_repetition(showing(lambda v, u, phase: u > 3 + 5 * phase), SLOPES).max() < 0.05
    assert wrong_by_repetition(showing(lambda v, u, phase: 0.5 + 0 * u), SLOPES).max() == 0


def test_what_interpolation_between_lenses_adds_to_fine_stripes_is_doubted_where_views_were_moved():
    # Upright stripes on a hexagonal array, as of 1.3 lenses: two frequencies of rows, and a change of contrast.
    t, s = np.indices((48, 48))
    image = 0.5 + (0.02 + 0.01 * np.sin(s / 5)) * np.cos(2 * np.pi * 0.23 * s) * np.cos(2 * np.pi * 0.42 * t)
    image += 0.006 * np.random.default_rng(0).normal(size=image.shape)
    moved = np.ones(image.shape, dtype=bool)
    assert np.median(finer_stripes(image, moved)) > 0.45
    # Where no view was moved, random texture may be as fine.
    fine = 0.5 + 0.05 * np.random.default_rng(0).normal(size=image.shape)
    assert np.median(finer_stripes(fine, ~moved)) < 0.3
    assert np.median(finer_stripes(gaussian_filter(fine, 1), moved)) < 0.1
