"""Data sets of dual pixels: pictures of both halves, what is in focus, depth and blur of each lens."""

import mitsuba as mi
import numpy as np
import pytest
from cases import facing, scene_of
from dataset_cases import small
from refusals import refused

from mitsuba_plenoptic import PlenopticCamera, dual_pixel, render_capture
from mitsuba_plenoptic.dataset import make_dataset, parse_recipe
from mitsuba_plenoptic.extensions.data.dual_samples import truth_of_lenses

CAMERA = {"preset": "phone_quad", "crop_offset": [4000, 2992], "crop_size": [64, 64]}


pytestmark = pytest.mark.usefixtures("coarse_figures")


def dual(**changes):
    scenes = [{"generator": "shapes", "objects": 3, "near": 600, "far": 1600}]
    return small(camera=CAMERA, scenes=scenes, photodiodes=[2, 1], truth=[], ray={"spp": 16}, **changes)


def test_a_sample_of_a_pair(tmp_path):
    sample = make_dataset(parse_recipe(dual(count=2)), tmp_path)[1]
    np.testing.assert_array_equal(sample.arrays["ray_left"], dual_pixel(sample.capture("ray"))[0, 0])
    exposed = dual_pixel(sample.capture("ray", exposed=True))[0, 1]
    np.testing.assert_array_equal(sample.arrays["ray_exposed_right"], exposed)
    assert {sample.arrays[name].shape for name in ("sharp", "lens_depth", "blur_radius", "ray_left")} == {(32, 32)}
    depth, camera = sample.arrays["lens_depth"], sample.camera
    assert ((depth > 500) & (depth < 2000)).all()
    defocus = 1 + camera.mla_distance / depth - camera.mla_distance / camera.focal_length
    expected = camera.aperture_radius * defocus / camera.mla_pitch
    assert sample.arrays["blur_radius"] == pytest.approx(expected, rel=1e-3, abs=1e-3)
    card = (tmp_path / "README.md").read_text()
    assert "| `ray_exposed_left` | 32 x 32 |" in card and "| `blur_radius` | 32 x 32 |" in card


def test_what_is_sharp_is_the_sum_in_focus():
    """A pattern in the plane in focus, at an edge of the field: registered to a fraction of a lens."""
    camera = PlenopticCamera.preset("phone_quad").replace(crop_offset=(7800, 5800), crop_size=(64, 64))
    texture = mi.Bitmap(np.random.default_rng(0).uniform(0.2, 1, (400, 400, 1)).astype(np.float32))
    x, y = (-camera.pixel_coordinates(axis).mean() * 1000 / camera.mla_distance for axis in (0, 1))
    light = {"type": "bitmap", "bitmap": texture, "raw": True}
    wall = facing(1000.0, 200.0, (x, y), light={"type": "area", "radiance": light})
    scene = scene_of(camera.to_sensor(), "direct", wall=wall)
    truth = truth_of_lenses(scene, 256, 0)
    total = dual_pixel(render_capture(scene, spp=1024)).sum(("v", "u")).values
    assert truth["lens_depth"] == pytest.approx(1000, rel=1e-4)
    assert np.abs(truth["blur_radius"]).max() < 1e-3
    assert truth["sharp"].mean() == pytest.approx(total.mean(), rel=0.01)
    assert np.corrcoef(truth["sharp"].ravel(), total.ravel())[0, 1] > 0.98


test_mistakes = refused(
    (lambda: parse_recipe(dual() | {"photodiodes": [3, 1]}), r"photodiodes: layout = \[3, 1\]"),
    (lambda: parse_recipe(small(photodiodes=[2, 1])), "2 x 2 pixels"),
)
