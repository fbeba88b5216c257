"""What every camera obeys: each relation on a fixed draw of random cameras; `make hunt` goes on with others."""

import pytest
from camera_draws import BASE, NOT_DRAWN, OPTIONS, Draw, scaled
from hunt import again
from relation import RELATIONS, draw_of, judged

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.camera import PARAMETERS
from mitsuba_plenoptic.camera.entry import Use

DRAWS = {Use.POINTS: 2}
"""Of relations of one use; of others one."""


def test_every_parameter_is_drawn():
    assert set(BASE) | set(OPTIONS) | set(NOT_DRAWN) == set(PARAMETERS)
    assert not set(NOT_DRAWN) & (set(BASE) | set(OPTIONS))


@pytest.mark.parametrize("name", OPTIONS)
def test_an_option_makes_a_camera_whose_unit_may_change(name):
    draw = Draw(7, [name])
    assert name in draw.parameters or "none" in draw.parameters.values()
    back = scaled(scaled(draw.parameters, 2.0), 0.5)
    assert PlenopticCamera(**back).to_dict() == draw.camera.to_dict()


@pytest.mark.parametrize("name", RELATIONS)
def test_a_relation_holds(name):
    """Cameras are those of a fixed draw."""
    relation = RELATIONS[name]
    first = 10 * list(RELATIONS).index(name)
    outcomes = [judged(relation, draw_of(relation, first + i)) for i in range(DRAWS.get(relation.use, 1))]
    failures = [f"{again(name, each.draw)}  {each.words}" for each in outcomes if each.verdict == "fails"]
    assert failures == []
