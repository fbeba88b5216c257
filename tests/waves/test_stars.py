"""Light of a field of small stars in wave captures of few and of many samples: no count of samples brightens it."""

import math

import mitsuba as mi
import numpy as np
import pytest
from cases import facing, radiating, scene_of, sensor

from mitsuba_plenoptic import render_capture
from mitsuba_plenoptic.detector.noise import NonNegative

STARS, STAR_LENSES, STAR_PIXELS, MARGIN = 400, 12, 20, 3.5


def sky():
    """Return a scene of stars of random places and sizes in focus, and its light, the sum of its capture's pixels.

    A micro-image of uniform radiance 1 has pi / 4 (D1 z / b)^2 of the detector's area, and stars their part of it.
    """
    random = np.random.default_rng(1)
    pitch, step = 0.128, 1e-4
    half = (STAR_LENSES / 2 - MARGIN) * pitch
    places, sizes = random.uniform(-half, half, (STARS, 2)), random.uniform(0.002, 0.012, STARS)
    scene = scene_of(
        sensor(STAR_LENSES, STAR_PIXELS),
        **{
            f"star_{i}": facing(240.0, float(size), (float(x), float(y)), **radiating())
            for i, ((x, y), size) in enumerate(zip(places, sizes, strict=True))
        },
    )
    # Stars may overlap: their union, on a fine grid.
    axis = np.arange(-half - 0.02, half + 0.02, step)
    covered = np.zeros((len(axis),) * 2, bool)
    for place, size in zip(places, sizes, strict=True):
        rows, columns = (slice(*np.searchsorted(axis, [p - size, p + size])) for p in place)
        covered[rows, columns] = True
    lenses = covered.sum() * (step / pitch) ** 2
    return scene, lenses * math.pi / 4 * (10 * 0.512 / (120 * 0.064 / STAR_PIXELS)) ** 2


def light_of_stars(scene, light, spp, seeds, noise):
    """Return the mean of captures' light over their stars' light, its standard error, and the least pixel."""
    images = [
        # Counts of samples share no seeds.
        render_capture(scene, model="wave", spp=spp, seed=10_000 * spp + seed, noise=noise).image
        for seed in range(seeds)
    ]
    found = [image.sum(dtype=float) / light for image in images]
    return float(np.mean(found)), float(np.std(found, ddof=1)) / math.sqrt(seeds), float(np.min(images))


@pytest.fixture(scope="module")
def stars():
    """Return a scene of stars and its light, the sum of its capture's pixels."""
    mi.set_variant("llvm_ad_mono")
    return sky()


@pytest.mark.slow
def test_few_samples_have_the_light_of_stars(stars):
    mean, error, least = light_of_stars(*stars, 8, 5, True)
    assert least >= 0
    assert error < 0.025
    assert mean == pytest.approx(1, abs=3.5 * error)


@pytest.mark.slow
def test_no_count_of_samples_brightens_stars(stars):
    seeds = {1: 80, 4: 50, 16: 30, 64: 10}
    counts = np.array(list(seeds))
    means, errors, _ = np.array([light_of_stars(*stars, spp, count, False) for spp, count in seeds.items()]).T
    assert errors.max() < 0.0042
    assert np.abs(means - 1).max() < 0.01
    assert (np.abs(means - 1) < 3.5 * errors).all()
    # The slope of the bias against the reciprocal of the count, by least squares with the errors as weights.
    weights = errors**-2
    aside = 1 / counts - np.average(1 / counts, weights=weights)
    slope = (weights * aside * means).sum() / (weights * aside**2).sum()
    assert abs(slope) < 3 / math.sqrt((weights * aside**2).sum())


def test_compensation_keeps_the_sum_and_moves_light_little():
    random = np.random.default_rng(0)
    image = random.standard_normal((37, 50)) + 0.2
    projection = NonNegative(image).image
    assert projection.min() >= 0
    assert projection.sum() == pytest.approx(image.sum(), rel=1e-12)
    # No square of 4 x 4 pixels gains light, and those below zero become black.
    before, after = (each[:36, :48].reshape(9, 4, 12, 4).sum((1, 3)) for each in (image, projection))
    assert (after <= np.maximum(before, 0) + 1e-12).all()
    assert not NonNegative(-np.abs(image)).image.any()
