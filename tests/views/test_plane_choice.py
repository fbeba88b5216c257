"""Which plane is chosen from how views disagree, and how sure that is: ratios of variances written down."""

import numpy as np
import pytest
from scipy.special import ndtr

from mitsuba_plenoptic.views.plane_choice import LENSES, VIEWS, Disagreement, choose, indications

PLANES, SHAPE, TRUE = 41, (9, 11), 17.3
INVERSE = np.linspace(1 / 200, 1 / 300, PLANES)
SAMPLES = 6000.0


def found(deviation, contrast=0.3, inverse=INVERSE):
    """Views whose deviation on each plane, as a fraction of the one to be explained, is given; all bins alike."""
    ratio = np.tile(np.square(deviation)[:, None, None], (1, *SHAPE))
    samples = np.full(ratio.shape, SAMPLES)
    return Disagreement(ratio, samples, np.full(SHAPE, contrast), inverse, samples)


@pytest.mark.parametrize(("samples", "times"), [(VIEWS, 3), (LENSES, 2)])
def test_a_valley_as_deep_elsewhere_makes_unsure(samples, times):
    def rivals(depth):
        aside, other = (np.abs(np.arange(PLANES) - plane) for plane in (TRUE, 31))
        return found(1 - 0.9 * np.exp(-((aside / 1.5) ** 2)) - depth * np.exp(-((other / 1.5) ** 2)))

    ambiguous, clear = (choose(rivals(depth), samples, 0.01).probability for depth in (0.88, 0.1))
    # Wrong at least so many times as often.
    assert np.all(1 - ambiguous > times * (1 - clear))


def test_neighbours_beyond_an_edge_are_a_minority():
    # Half of the field shows one plane, half another, twelve planes apart.
    best = np.where(np.arange(40) < 20, 14.0, 26.0)
    ratio = np.square(1 - 0.95 * np.exp(-(((np.arange(PLANES)[:, None, None] - best) / 1.5) ** 2)))
    ratio = np.tile(ratio, (1, 20, 1))
    samples = np.full(ratio.shape, SAMPLES)
    edge = Disagreement(ratio, samples, np.full(ratio.shape[1:], 0.3), INVERSE, samples)
    agreeing = indications(edge, VIEWS, 0.01)[2]
    assert agreeing.min() > 0.5
    # Of a Gaussian window of 3 bins about the last bin before the edge, half a bin more than half is before it.
    assert agreeing[10, 19] == pytest.approx(ndtr(0.5 / 3), abs=0.02)
    probability = choose(edge, VIEWS, 0.01).probability
    assert probability.min() >= 0.5
    # A bin beside an edge may have the edge for all of its evidence.
    assert probability[:, 19:21].max() < 0.9 < probability[:, :10].min()


@pytest.mark.parametrize(("true", "known"), [(3.0, False), (12.0, True), (188.0, True), (197.0, False)])
def test_what_is_within_the_tolerance_of_an_end_is_unknown(true, known):
    # Planes are 0.17 to 0.25 % apart.
    inverse = np.linspace(1 / 200, 1 / 300, 201)
    deviation = 1 - 0.95 * np.exp(-(((np.arange(201) - true) / 1.5) ** 2))
    probability = choose(found(deviation, inverse=inverse), VIEWS, 0.01).probability
    assert np.all(probability > 0.9 if known else probability == 0)


@pytest.mark.parametrize("rise", [0.1, 0.03])
def test_a_valley_before_planes_that_cannot_be_compared_is_closed_by_less(rise):
    # Down to plane 14, then up by a fraction of the depth to plane 17; beyond that, a gap or planes like the last.
    planes = np.arange(PLANES)
    logarithm = np.where(planes < 14, -3 + 0.3 * (14 - planes), np.minimum(-3 + rise * (planes - 14), -3 + 3 * rise))
    logarithm = np.minimum(np.where(planes > 24, 0, logarithm), 0)
    logarithm[17:25] = np.nan
    before_gap = choose(found(np.exp(logarithm)), VIEWS, 0.01).probability
    at_the_end = choose(found(np.exp(logarithm[:17]), inverse=INVERSE[:17]), VIEWS, 0.01).probability
    assert np.all(before_gap > 0.5 if rise == 0.1 else before_gap == 0)
    assert np.all(at_the_end == 0)
