"""Scenes seen by another camera than their own."""

import numpy as np
import pytest
from scene_cases import SMALL_SENSOR, write_scene

from mitsuba_plenoptic import InputError, PlenopticCamera, load_scene, render_capture, with_camera


@pytest.mark.parametrize("name", ["still_life", "vitrine"])
def test_its_own_camera_sees_the_same_bits(name):
    scene = load_scene(name, parameters={"resolution": "64", "detector_width": "1.024"})
    again = with_camera(scene, PlenopticCamera.from_sensor(scene.sensors()[0]))
    assert np.array_equal(*(render_capture(each, spp=2).image for each in (scene, again)))


def test_objects_without_names_and_the_film_of_colours_are_kept(tmp_path):
    text = '<emitter type="constant"/><shape type="sphere"/><shape type="cube"/>'
    scene = load_scene(write_scene(tmp_path, text, sensor=SMALL_SENSOR, pixel_format="rgb"), variant="llvm_ad_rgb")
    made = with_camera(scene, PlenopticCamera(detector_width=0.128, resolution=(32, 32)))
    assert len(made.shapes()) == 2
    assert render_capture(made, spp=1).image.shape == (32, 32, 3)


def test_a_scene_without_a_camera_is_seen_from_the_origin(tmp_path):
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><integrator type="path"/><shape type="sphere"/></scene>'
    )
    camera = PlenopticCamera.preset("lytro").replace(mla_tilt=(0.1, -0.2), distortion=(1e-4, -1e-6, 1e-8, 1e-5, -2e-5))
    sensor = with_camera(load_scene(tmp_path / "scene.xml"), camera).sensors()[0]
    assert PlenopticCamera.from_sensor(sensor) == camera
    assert np.array_equal(np.ravel(sensor.world_transform().translation()), [0, 0, 0])


def test_a_sensor_that_scales_is_refused(tmp_path):
    scaled = '<transform name="to_world"><scale value="2"/></transform>'
    path = write_scene(tmp_path, sensor=scaled)
    path.write_text(path.read_text().replace("plenoptic", "orthographic"))
    with pytest.raises(InputError, match="plenoptic: to_world: it must not scale"):
        with_camera(load_scene(path), PlenopticCamera())
