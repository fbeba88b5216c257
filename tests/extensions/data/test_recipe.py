"""Recipes: what they draw, and what they refuse."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from dataset_cases import small
from foreign_files import LARGE, large
from refusals import refused, refuses
from scipy import stats

from mitsuba_plenoptic import PlenopticCamera, design
from mitsuba_plenoptic.dataset import DataSet, parse_recipe, read_recipe


def test_values_have_the_distributions_that_they_are_said_to_have():
    camera = small()["camera"] | {"mla_lattice": {"one_of": ["square", "hexagonal"]}}
    shapes, white = small()["scenes"]
    recipe = parse_recipe(small(count=500, camera=camera, scenes=[shapes | {"share": 3}, white]))
    plans = [recipe.plan(index) for index in range(500)]
    drawn = [plan.draws for plan in plans]
    linear, log = stats.uniform(230, 20), stats.loguniform(300, 3000)
    assert stats.kstest([each["camera"]["focus_distance"] for each in drawn], linear.cdf).pvalue > 0.01
    assert stats.kstest([each["noise"]["photons"] for each in drawn], log.cdf).pvalue > 0.01
    steps = [each["scene"]["objects"] for each in drawn if "objects" in each["scene"]]
    assert stats.chisquare(np.bincount(steps)[3:]).pvalue > 0.01
    assert set(steps) == {3, 4, 5, 6}
    assert stats.binomtest([each["camera"]["mla_lattice"] for each in drawn].count("hexagonal"), 500, 0.5).pvalue > 0.01
    assert stats.binomtest(sum(plan.source for plan in plans), 500, 0.25).pvalue > 0.01
    assert all(each["camera"]["resolution"] == [64, 64] for each in drawn)


def test_a_draw_depends_on_the_seed_the_sample_and_the_name_alone():
    recipe, other = (parse_recipe(small(count=count, light=light)) for count, light in ((5, {}), (9, {"lamp": 1})))
    for index in range(5):
        plan, again = recipe.plan(index), other.plan(index)
        assert (plan.camera, plan.photons, plan.draws["scene"]) == (again.camera, again.photons, again.draws["scene"])
    assert len({recipe.plan(index).camera for index in range(5)}) == 5
    assert parse_recipe(small(seed=4)).plan(0).camera != recipe.plan(0).camera


def test_shapes_stand_where_the_camera_resolves_them():
    camera = PlenopticCamera(detector_width=0.256, resolution=(64, 64))
    near, far = design.refocus_range(camera)
    plan = parse_recipe(small(scenes=[{"generator": "shapes", "objects": 200, "tilt": 0}])).plan(0)
    scene = plan.maker.scene(camera, plan.light, np.random.default_rng(0))
    places = [item["to_world"].matrix for name, item in scene.items() if name.startswith("object")]
    depths = np.array([matrix[2, 3] for matrix in places])
    assert near < depths.min() < depths.max() < far
    # Evenly in disparity, which goes with the inverse distance.
    assert stats.kstest((1 / depths - 1 / far) / (1 / near - 1 / far), "uniform").pvalue > 0.01
    # Rotations and one scale but for cylinders: no shear.
    for matrix in places:
        axes = np.array(matrix)[:3, :3].T @ np.array(matrix)[:3, :3]
        assert np.abs(axes - np.diag(np.diag(axes))).max() < 1e-5 * np.abs(axes).max()


@pytest.mark.parametrize(("changes", "message"), [
    ({"count": 0}, "count = 0: "),
    ({"cuont": 3}, "recipe: cuont: "),
    ({"camera": {"aperture_radius": {"from": 5, "to": 3}}}, "camera: aperture_radius: from = 5, to = 3: "),
    ({"camera": {"focal_length": {"from": 1, "to": 1e20, "step": 1}}}, "length: from = 1, to = 1e+20: "),
    ({"camera": {"aperture_radius": {"from": -1, "to": 3}}}, "sample 0: camera: aperture_radius = -"),
    ({"scenes": [{"generator": "shapes", "objects": 2.5}]}, "generator shapes: objects = 2.5: "),
    ({"scenes": [{"scene": "nowhere"}]}, "scenes: entry 1: scene = 'nowhere': "),
    ({"noise": {"read_noise": 3}}, "noise: photons is missing"),
    ({"light": {"sky": 0, "lamp": 0}}, "light: sky = 0 and lamp = 0: "),
    ({"models": ["ray", "wave"], "wave": {"metod": 1}}, "metod: "),
    ({"wave": {"spp": 1}}, "wave: models = ['ray'] "),
])  # fmt: skip
def test_what_is_wrong_with_a_recipe_is_told_in_one_line(changes, message, tmp_path):
    path = tmp_path / "recipe.yaml"
    path.write_text(yaml.safe_dump(small(**changes)))
    refuses(f"^{re.escape(str(path))}: .*{re.escape(message)}", read_recipe, path)


def test_recipes_are_yaml_or_json_and_nothing_else(tmp_path):
    path = tmp_path / "recipe.json"
    path.write_text(json.dumps(small()))
    assert read_recipe(path) == parse_recipe(small())
    for text, message in (("count: 1\ncount: 2\n", "count is given twice"), ("- 1\n", "a mapping")):
        path.write_text(text)
        refuses(message, read_recipe, path)


def test_the_recipe_in_the_documentation_is_one():
    text = (Path(__file__).parents[3] / "docs" / "guides" / "datasets.md").read_text()
    recipe = parse_recipe(yaml.safe_load(re.search(r"```yaml\n(.*?)```", text, re.DOTALL)[1]))
    assert recipe.count == 100
    assert {recipe.plan(index).source for index in range(20)} == {0, 1}


def test_a_recipe_draws_the_numbers_of_a_data_sheet(tmp_path):
    (tmp_path / "recipe.yaml").write_text(
        "count: 3\nscenes:\n  - generator: shapes\n"
        "camera:\n  f_number: {from: 2, to: 8}\n  lenses: [8, 6]\n  pixels_per_lens: 10\n  pixel_size: 0.005\n"
        "  focal_length: 50\n  focus_distance: 320\n"
    )
    recipe = read_recipe(tmp_path / "recipe.yaml")
    cameras = [recipe.plan(index).camera for index in range(3)]
    assert len({camera.f_number for camera in cameras}) == 3
    assert all(camera.micro_image_pitch == pytest.approx(0.05) for camera in cameras)


test_the_size_of_a_file_is_judged_before_it_is_read = refused(
    (lambda folder: read_recipe(large(folder / "recipe.yaml")), rf"recipe.yaml: {LARGE}"),
    (lambda folder: DataSet(large(folder / "dataset.json").parent), rf"dataset.json: {LARGE}"),
)
