"""Which plane is chosen from how views disagree, and how sure that is: variances written down."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_plenoptic.lightfield.plane_choice import LENSES, VIEWS, Disagreement, choose

PLANES, SHAPE, TRUE = 41, (9, 11), 17.3
INVERSE = np.linspace(1 / 200, 1 / 300, PLANES)


def disagreement(least: float, most: float) -> Disagreement:
    """Views whose deviation rises from the true plane to either side, of brightness 1."""
    aside = np.abs(np.arange(PLANES) - TRUE)
    deviation = least + (most - least) * (1 - np.exp(-aside / 2))
    return Disagreement(np.tile((deviation**2)[:, None, None], (1, *SHAPE)), np.ones(SHAPE), INVERSE)


@pytest.mark.parametrize("evidence", [VIEWS, LENSES])
def test_the_plane_of_least_disagreement_is_chosen(evidence):
    found = choose(disagreement(0.005, 0.5), evidence, 0.01)
    assert np.abs(found.place - TRUE).max() < 0.5
    assert found.probability.min() > 0.85


@pytest.mark.parametrize("evidence", [VIEWS, LENSES])
def test_what_no_plane_explains_is_less_sure(evidence):
    # The same relative minimum, of views that are apart on every plane.
    explained, unexplained = (choose(disagreement(0.06 * k, 0.3 * k), evidence, 0.01).probability for k in (1, 4))
    assert np.all(unexplained < explained - 0.02)


@pytest.mark.parametrize("evidence", [VIEWS, LENSES])
def test_nothing_is_known_where_planes_do_not_differ(evidence):
    assert choose(disagreement(0.2, 0.2), evidence, 0.01).probability.max() < 0.2
    dark = Disagreement(np.zeros((PLANES, *SHAPE)), np.zeros(SHAPE), INVERSE)
    assert choose(dark, evidence, 0.01).probability.max() < 0.2
