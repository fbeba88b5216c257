"""Light of a field of small stars in wave captures of few and of many samples: no count of samples brightens it."""

import math

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_plenoptic import render_capture
from mitsuba_plenoptic.light.noise import Mended
from tools.bench.scenes.light_paths import facing, radiating, scene_of, sensor

LENSES, PIXELS, MARGIN, STARS = 12, 20, 3.5, 400
"""Lenses across the detector, pixels across a lens (one cell of the grid each), lenses beside the stars, and stars."""


@pytest.fixture(scope="module")
def sky():
    """Return a scene of stars of random places and sizes in focus, and its light, the sum of its capture's pixels.

    A micro-image of uniform radiance 1 has pi / 4 (D1 z / b)^2 of the detector's area, and stars their part of it.
    """
    mi.set_variant("llvm_ad_mono")
    random = np.random.default_rng(1)
    half = (LENSES / 2 - MARGIN) * 0.128
    places, sizes = random.uniform(-half, half, (STARS, 2)), random.uniform(0.002, 0.012, STARS)
    scene = scene_of(
        sensor(LENSES, PIXELS),
        **{
            f"star_{i}": facing(240.0, float(size), (float(x), float(y)), **radiating())
            for i, ((x, y), size) in enumerate(zip(places, sizes, strict=True))
        },
    )
    # Stars may overlap: their union, on a fine grid.
    step = 1e-4
    axis = np.arange(-half - 0.02, half + 0.02, step)
    covered = np.zeros((len(axis),) * 2, bool)
    for place, size in zip(places, sizes, strict=True):
        rows, columns = (slice(*np.searchsorted(axis, [p - size, p + size])) for p in place)
        covered[rows, columns] = True
    lenses = covered.sum() * (step / 0.128) ** 2
    return scene, lenses * math.pi / 4 * (10 * 0.512 / (120 * 0.064 / PIXELS)) ** 2


def light_of(sky, spp, seeds, noise):
    """Return the mean over seeds of a capture's light over that of the stars, and its standard error."""
    scene, light = sky
    images = [
        # Counts of samples share no seeds.
        render_capture(scene, model="wave", spp=spp, seed=10_000 * spp + seed, noise=noise).image
        for seed in range(seeds)
    ]
    assert min(image.min() for image in images) >= 0
    found = [image.sum(dtype=float) / light for image in images]
    return np.mean(found), np.std(found, ddof=1) / math.sqrt(seeds)


@pytest.mark.parametrize(("spp", "noise"), [(1, False), (8, True)])
def test_few_samples_have_the_light_of_stars(sky, spp, noise):
    mean, error = light_of(sky, spp, 5, noise)
    assert error < 0.025
    assert mean == pytest.approx(1, abs=3.5 * error)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seeds", "noise"),
    # Estimates of the noise need two samples.
    [({1: 160, 4: 100, 16: 60, 64: 20, 256: 20, 1024: 20}, False), ({2: 100, 16: 40, 128: 20, 1024: 20}, True)],
    ids=["without noise", "with noise"],
)
def test_no_count_of_samples_brightens_stars(sky, seeds, noise):
    counts = np.array(list(seeds))
    means, errors = np.array([light_of(sky, spp, count, noise) for spp, count in seeds.items()]).T
    assert errors.max() < 0.003
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
    mended = Mended(image).image
    assert mended.min() >= 0
    assert mended.sum() == pytest.approx(image.sum(), rel=1e-12)
    # No square of 4 x 4 pixels gains light, and those below zero become black.
    before, after = (each[:36, :48].reshape(9, 4, 12, 4).sum((1, 3)) for each in (image, mended))
    assert (after <= np.maximum(before, 0) + 1e-12).all()
    assert not Mended(-np.abs(image)).image.any()
