"""What every camera obeys: each relation on a fixed draw of random cameras; `make hunt` goes on with others."""

import zlib

import pytest
from camera_draws import BASE, NOT_DRAWN, OPTIONS, Draw, scaled
from hunt import again
from of_extensions import DRAWN
from of_extensions import NOT_DRAWN as EXTENSIONS_NOT_DRAWN
from relation import RELATIONS, draw_of, judged

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.camera import PARAMETERS
from mitsuba_plenoptic.extension import installed


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
    """The camera is one fixed draw."""
    relation = RELATIONS[name]
    outcome = judged(relation, draw_of(relation, zlib.crc32(name.encode()) % 1000))
    assert outcome.verdict != "fails", f"{again(name, outcome.draw)}  {outcome.words}"


def test_every_extension_is_drawn():
    """Or it says why not."""
    names = {package.rpartition(".")[2] for package in installed() if package.startswith("mitsuba_plenoptic.")}
    assert names == set(DRAWN) | set(EXTENSIONS_NOT_DRAWN)
    assert not set(DRAWN) & set(EXTENSIONS_NOT_DRAWN)
