"""The camera's numbers against the paper's and against closed forms."""

import copy
import dataclasses
import math
import pickle

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_plenoptic import InputError, PlenopticCamera
from mitsuba_plenoptic.design.quantities import crosstalk_lenses, micro_image_distance


def test_the_default_is_the_papers_camera():
    camera = PlenopticCamera()
    assert camera.focus_distance == pytest.approx(240)
    assert PlenopticCamera(focus_distance=240).mla_distance == pytest.approx(120)
    assert PlenopticCamera(focus_distance=math.inf).mla_distance == pytest.approx(80)
    assert PlenopticCamera(mla_distance=80).focus_distance == math.inf
    assert camera.bin_size(240) == pytest.approx(0.128)
    assert camera.blur_diameter(240) == pytest.approx(0, abs=1e-12)
    assert camera.blur_diameter(210) == pytest.approx(0.714, abs=5e-4)
    assert crosstalk_lenses(camera) == 1
    assert crosstalk_lenses(camera.replace(aperture_radius=10)) == 5


def test_scene_files_and_sensors_have_its_place_and_its_colours():
    """With numbers that are none of single precision."""
    camera = PlenopticCamera(focus_distance=300.3, mla_offset=(1 / 7, -2 / 3), resolution=(64, 48), crop_size=(30, 20))
    assert eval(repr(camera)) == camera
    place = mi.ScalarTransform4f().look_at([1, 2, 3], [0, 0, 0], [0, 1, 0])
    text = camera.to_xml(to_world=place, pixel_format="rgb")
    assert '"pixel_format" value="rgb"' in text
    sensor = mi.load_string(f'<scene version="3.0.0">{text}</scene>').sensors()[0]
    assert np.allclose(np.array(sensor.world_transform().matrix).reshape(4, 4), place.matrix, atol=1e-6)
    assert PlenopticCamera.from_sensor(sensor) == camera
    with pytest.raises(InputError, match="pixel_format = 'cmyk'"):
        camera.to_xml(pixel_format="cmyk")
    for variant, channels in (("llvm_ad_mono", 1), ("llvm_ad_rgb", 3), ("llvm_ad_spectral", 3)):
        mi.set_variant(variant)
        film = mi.load_dict(camera.to_sensor()).film()
        assert film.base_channels_count() == channels and tuple(film.crop_size()) == camera.shape[::-1]
        assert ('"pixel_format" value="rgb"' in camera.to_xml()) == (channels == 3)


def test_a_camera_is_a_value():
    camera = PlenopticCamera(main_lens="tessar", mla_glass=1.5)
    for name in ("focal_length", "focal_lenght"):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(camera, name, 50)
    for same in (pickle.loads(pickle.dumps(camera)), copy.deepcopy(camera), camera.replace()):
        assert same == camera and hash(same) == hash(camera)
    assert camera != camera.replace(mla_glass=1.6)


def test_json_may_leave_parameters_out():
    expected = PlenopticCamera(focus_distance=300, mla_pitch=(0.064, 0.06))
    assert PlenopticCamera.from_json('{"focus_distance": 300, "mla_pitch": [0.064, 0.06]}') == expected
    wrong = {"[" * 100_000: "JSON", "[1]": "by name", '{"zoom": 2}': "zoom", '{"mla_fill": NaN}': "nan"}
    for text, words in wrong.items():
        with pytest.raises(InputError, match=words):
            PlenopticCamera.from_json(text)


def test_one_pitch_is_two_that_are_equal():
    camera = PlenopticCamera(mla_pitch=(0.06, 0.06))
    assert camera == PlenopticCamera(mla_pitch=[0.06]) == PlenopticCamera(mla_pitch=0.06)
    assert camera.to_dict()["mla_pitch"] == 0.06
    stretched = PlenopticCamera(mla_pitch=(0.064, 0.06))
    assert (stretched.row_pitch, stretched.bin_count, stretched.lens_count) == (0.064, (128, 128), (128, 137))
    for each in (camera, stretched, PlenopticCamera(mla_lattice="hexagonal", mla_focal_length=(0.5, 0.6, 0.7))):
        assert each.replace(mla_pitch=each.mla_pitch, mla_focal_length=each.mla_focal_length) == each
    assert stretched.pixels_per_lens == pytest.approx(30)
    assert micro_image_distance(stretched) == pytest.approx(0.06 * 120.512 / 120)
