"""Light of a field of small stars in wave captures of few and of many samples: no count of samples brightens it."""

import math

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_plenoptic.light.noise import Mended
from tools.bench.cases.lamps import light_of_stars, sky


@pytest.fixture(scope="module")
def stars():
    """Return a scene of stars and its light, the sum of its capture's pixels."""
    mi.set_variant("llvm_ad_mono")
    return sky()


@pytest.mark.parametrize(("spp", "noise"), [(1, False), (8, True)])
def test_few_samples_have_the_light_of_stars(stars, spp, noise):
    mean, error, least = light_of_stars(*stars, spp, 5, noise)
    assert least >= 0
    assert error < 0.025
    assert mean == pytest.approx(1, abs=3.5 * error)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seeds", "noise"),
    # Estimates of the noise need two samples.
    [({1: 160, 4: 100, 16: 60, 64: 20, 256: 20, 1024: 20}, False), ({2: 100, 16: 40, 128: 20, 1024: 20}, True)],
    ids=["without noise", "with noise"],
)
def test_no_count_of_samples_brightens_stars(stars, seeds, noise):
    counts = np.array(list(seeds))
    means, errors, _ = np.array([light_of_stars(*stars, spp, count, noise) for spp, count in seeds.items()]).T
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
