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


SEEDS = {
    "derivative": 415, "mirror_deconvolved": 12, "channels_deconvolved": 14, "channels_incoherent": 19, "reverse": 2,
    "units_incoherent": 1, "white_of_scenes": 4, "detector_by_waves": 1, "product_rule": 500, "wide_array": 208,
    "units_of_scenes_by_waves": 203, "channels_of_scenes_by_waves": 213, "refusals": 2, "depth_of_walls": 3015,
    "lamp_deconvolved": 202, "planes_deconvolved": 204, "function_deconvolved": 6, "white_capture": 201,
    "white_deconvolved": 507, "white_incoherent": 502, "quarter_turn": 501, "array_partial": 501, "blur": 601,
    "single_laser_point": 609, "part_ray": 602, "short_waves": 604, "seeds_of_scenes_by_waves": 610,
    "units_of_fourier_microscopes": 708, "light_of_fourier_microscopes": 703,
    "crop_of_fourier_microscopes": 817, "mirror_of_fourier_microscopes": 828,
}  # fmt: skip
"""Draws of three options or four that cost little; hunts draw the dear ones."""


@pytest.mark.parametrize(("name", "seed"), [*((name, SEEDS.get(name)) for name in RELATIONS), ("derivative", 425)])
def test_a_relation_holds(name, seed):
    """The camera is a fixed draw; of two, over fifty pairs of a parameter and an option have a derivative judged."""
    relation = RELATIONS[name]
    outcome = judged(relation, draw_of(relation, seed or zlib.crc32(name.encode()) % 1000))
    assert outcome.verdict == "computed", f"{again(name, outcome.draw)}  {outcome.verdict}: {outcome.words}"
    assert relation.first is None or set(relation.first(outcome.draw.seed)) & set(outcome.draw.options)
    assert name != "derivative" or len(outcome.draw.slopes) * len(outcome.draw.options) >= 24


def test_every_extension_is_drawn():
    names = {package.rpartition(".")[2] for package in installed() if package.startswith("mitsuba_plenoptic.")}
    assert names == set(DRAWN) | set(EXTENSIONS_NOT_DRAWN)
    assert not set(DRAWN) & set(EXTENSIONS_NOT_DRAWN)
