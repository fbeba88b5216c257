"""Data sets that version 1.0 made, whose waves were parabolic, and the version that data sets state now."""

import shutil
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.dataset import DataSet, make_dataset, parse_recipe

OLD = Path(__file__).parents[2] / "files_of_1_0"
VERSION = version("mitsuba-plenoptic")


def test_a_data_set_is_read_and_not_mixed_with_this_version(tmp_path, caplog):
    caplog.set_level("INFO", "mitsuba_plenoptic")
    folder = tmp_path / "data"
    shutil.copytree(OLD / "data", folder)
    made = DataSet(folder)
    assert [record.getMessage().partition(": ")[::2] for record in caplog.records] == [
        (
            str(folder),
            "a data set of version 1.0 or earlier: the lens_model of its wave captures is read as parabolic, unless "
            "they have a main_lens or lenses of fewer than 20 wavelengths",
        )
    ]
    assert made[0].camera == made[0].capture("ray").camera and made[0].camera.lens_model == "ideal"
    assert made[0].capture("wave").camera == made[0].camera.replace(lens_model="parabolic")
    recipe = parse_recipe(made.manifest["recipe"] | {"count": 2})
    with pytest.raises(mp.InputError, match=f"it holds other samples: version = nothing there, {VERSION} here"):
        make_dataset(recipe, folder)


def test_a_data_set_states_the_version(tmp_path):
    made = make_dataset(parse_recipe(yaml.safe_load((OLD / "recipe.yaml").read_text())), tmp_path / "data")
    assert made.manifest["version"] == made[0].facts["version"] == VERSION
