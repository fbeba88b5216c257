"""Which plane is chosen from how views disagree, and how sure that is: ratios of variances written down."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mitsuba_plenoptic.lightfield.plane_choice import LENSES, VIEWS, Disagreement, choose, disagreement, indications

PLANES, SHAPE, TRUE = 41, (9, 11), 17.3
INVERSE = np.linspace(1 / 200, 1 / 300, PLANES)
SAMPLES = 6000.0


def found(deviation, contrast=0.3, inverse=INVERSE):
    """Views whose deviation on each plane, as a fraction of the one to be explained, is given; all bins alike."""
    ratio = np.tile(np.square(deviation)[:, None, None], (1, *SHAPE))
    return Disagreement(ratio, np.full(ratio.shape, SAMPLES), np.full(SHAPE, contrast), inverse)


def valley(least):
    """Deviations that rise from the true plane to either side."""
    return least + (1 - least) * (1 - np.exp(-np.abs(np.arange(PLANES) - TRUE) / 2))


@pytest.mark.parametrize("samples", [VIEWS, LENSES])
def test_the_plane_of_least_disagreement_is_chosen(samples):
    chosen = choose(found(valley(0.05)), samples, 0.01)
    assert np.abs(chosen.place - TRUE).max() < 0.5
    assert chosen.probability.min() > 0.85


@pytest.mark.parametrize("samples", [VIEWS, LENSES])
def test_what_no_plane_explains_is_less_sure(samples):
    # The same relative minimum, of views that are apart on every plane.
    explained, unexplained = (choose(found(valley(0.2), c), samples, 0.01).probability for c in (0.3, 1.2))
    # Wrong at least three times as often, however sure the first is.
    assert np.all(1 - unexplained > 3 * (1 - explained))


@pytest.mark.parametrize("samples", [VIEWS, LENSES])
def test_nothing_is_known_where_planes_do_not_differ(samples):
    assert choose(found(np.full(PLANES, 0.9)), samples, 0.01).probability.max() < 0.2
    dark = np.zeros((PLANES, *SHAPE))
    nothing = disagreement(np.ones_like(dark), dark, dark + SAMPLES, np.zeros(SHAPE), INVERSE)
    assert choose(nothing, samples, 0.01).probability.max() < 0.2


@pytest.mark.parametrize(("samples", "independent"), [(VIEWS, 6000.0), (LENSES, 100.0), (LENSES, 1500.0)])
def test_noise_alone_is_not_significant(samples, independent):
    # Ratios about 1 with the variance that the number of samples says, averaged over the bins of a window.
    noise = gaussian_filter(np.random.default_rng(0).normal(size=(PLANES, 60, 60)), (0, 1, 1), mode="wrap")
    ratio = 1 + noise / noise.std() / np.sqrt(independent)
    ones = np.ones_like(ratio)
    flat = Disagreement(ratio, independent * ones, 0.03 * ones[0], INVERSE)
    assert (choose(flat, samples, 0.01).probability >= 0.5).mean() < 0.01
    # The same noise over a valley that is eight times as deep as the deviation of an average, two of which are chance.
    depth = 8 / np.sqrt(5 * independent)
    ratio = ratio - depth * np.exp(-(((np.arange(PLANES) - TRUE) / 2) ** 2))[:, None, None]
    weak = indications(Disagreement(ratio, independent * ones, 0.03 * ones[0], INVERSE), samples, 0.01)[1][3]
    assert np.exp(np.median(weak)) == pytest.approx(6, abs=1.5)


@pytest.mark.parametrize("samples", [VIEWS, LENSES])
def test_a_valley_as_deep_elsewhere_makes_unsure(samples):
    def rivals(depth):
        aside, other = (np.abs(np.arange(PLANES) - plane) for plane in (TRUE, 31))
        return found(1 - 0.9 * np.exp(-((aside / 1.5) ** 2)) - depth * np.exp(-((other / 1.5) ** 2)))

    ambiguous, clear = (choose(rivals(depth), samples, 0.01).probability for depth in (0.88, 0.1))
    # Wrong at least twice as often.
    assert np.all(1 - ambiguous > 2 * (1 - clear))


@pytest.mark.parametrize("true", [-2.0, 0.3, PLANES - 1.2, PLANES + 3.0])
def test_what_is_best_at_an_end_is_unknown(true):
    deviation = 0.05 + 0.02 * np.abs(np.arange(PLANES) - true)
    assert choose(found(deviation), VIEWS, 0.01).probability.max() == 0
    # The same before a gap in which nothing can be compared.
    gap = np.concatenate([deviation, np.full(5, np.nan), deviation[::-1]])
    ends = choose(found(gap, inverse=np.linspace(1 / 200, 1 / 400, len(gap))), VIEWS, 0.01)
    assert ends.probability.max() == 0
