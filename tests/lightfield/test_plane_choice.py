"""Which plane is chosen from how views disagree, and how sure that is: variances written down."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_plenoptic.lightfield.plane_choice import LENSES, VIEWS, Disagreement, choose, indications

PLANES, SHAPE, TRUE = 41, (9, 11), 17.3
INVERSE = np.linspace(1 / 200, 1 / 300, PLANES)


def disagreement(least: float, most: float) -> Disagreement:
    """Views whose deviation rises from the true plane to either side, of brightness 1."""
    aside = np.abs(np.arange(PLANES) - TRUE)
    deviation = least + (most - least) * (1 - np.exp(-aside / 2))
    return Disagreement(np.tile((deviation**2)[:, None, None], (1, *SHAPE)), np.ones(SHAPE), INVERSE)


@pytest.mark.parametrize("samples", [VIEWS, LENSES])
def test_the_plane_of_least_disagreement_is_chosen(samples):
    found = choose(disagreement(0.005, 0.5), samples, 0.01)
    assert np.abs(found.place - TRUE).max() < 0.5
    assert found.probability.min() > 0.85


@pytest.mark.parametrize("samples", [VIEWS, LENSES])
def test_what_no_plane_explains_is_less_sure(samples):
    # The same relative minimum, of views that are apart on every plane.
    explained, unexplained = (choose(disagreement(0.06 * k, 0.3 * k), samples, 0.01).probability for k in (1, 4))
    # Wrong at least three times as often, however sure the first is.
    assert np.all(1 - unexplained > 3 * (1 - explained))


@pytest.mark.parametrize("samples", [VIEWS, LENSES])
def test_nothing_is_known_where_planes_do_not_differ(samples):
    assert choose(disagreement(0.2, 0.2), samples, 0.01).probability.max() < 0.2
    dark = Disagreement(np.zeros((PLANES, *SHAPE)), np.zeros(SHAPE), INVERSE)
    assert choose(dark, samples, 0.01).probability.max() < 0.2


def test_neighbours_that_see_another_plane_make_less_sure():
    # Half of the field shows one plane, half another, twelve planes apart.
    aside = np.abs(np.arange(PLANES)[:, None] - np.where(np.arange(40) < 20, 14.0, 26.0))
    deviation = 0.02 + 0.2 * (1 - np.exp(-aside / 2))
    found = Disagreement(np.tile(np.square(deviation)[:, None, :], (1, 9, 1)), np.ones((9, 40)), INVERSE)
    sure = choose(found, VIEWS, 0.01).probability[4]
    # The window reaches over the border at half of its weight.
    asked = indications(found, VIEWS, 0.01)[1][2, 4]
    assert asked[5] > 0.99
    assert 0.4 < asked[19] < 0.65
    assert sure[5] > 0.9


@pytest.mark.parametrize("samples", [VIEWS, LENSES])
def test_a_valley_as_deep_elsewhere_makes_unsure(samples):
    def rivals(depth):
        aside = np.abs(np.arange(PLANES) - TRUE)
        other = np.abs(np.arange(PLANES) - 31)
        deviation = 0.3 * (1 - 0.9 * np.exp(-((aside / 1.5) ** 2)) - depth * np.exp(-((other / 1.5) ** 2)))
        return Disagreement(np.tile((deviation**2)[:, None, None], (1, *SHAPE)), np.ones(SHAPE), INVERSE)

    ambiguous, clear = (choose(rivals(depth), samples, 0.01).probability for depth in (0.88, 0.1))
    # Wrong at least three times as often.
    assert np.all(1 - ambiguous > 3 * (1 - clear))


@pytest.mark.parametrize("true", [-2.0, 0.3, PLANES - 1.2, PLANES + 3.0])
def test_what_is_best_at_an_end_is_unknown(true):
    deviation = 0.05 + 0.02 * np.abs(np.arange(PLANES) - true)
    variance = np.tile((deviation**2)[:, None, None], (1, *SHAPE))
    assert choose(Disagreement(variance, np.ones(SHAPE), INVERSE), VIEWS, 0.01).probability.max() == 0
    # The same before a gap in which nothing can be compared.
    gap = np.concatenate([variance, np.full((5, *SHAPE), np.nan), variance[::-1]])
    inverse = np.linspace(1 / 200, 1 / 400, len(gap))
    ends = choose(Disagreement(gap, np.ones(SHAPE), inverse), VIEWS, 0.01)
    assert ends.probability.max() == 0
