"""What the plugins refuse: parameters in scenes, films, and scenes that they do not capture."""

import mitsuba as mi
import pytest
from cameras import disk
from cases import film

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.views.white import white_image
from refusals import refuses


@pytest.mark.parametrize(("plugin", "parameters", "words"), [
    ("plenoptic", {"focal_length": "eighty"}, "plenoptic: focal_length = 'eighty'"),
    ("plenoptic", {"near_clip": 1.0}, "plenoptic: near_clip = 1"),
    ("plenoptic", {"glass": "{1.5"}, "glass: .*JSON"),
    ("plenoptic", {"mla_offset": [1.0, 2.0, 3.0]}, r"plenoptic: mla_offset = \(1.0, 2.0, 3.0\)"),
    ("plenoptic", {"film": {"rfilter": {"type": "gaussian"}}}, 'GaussianFilter .*<rfilter type="box"/>'),
    ("plenoptic_wave", {"wavelength": "600, 500, 400"}, "llvm_ad_mono has 1 channel"),
    ("plenoptic_wave", {"wavelenght": 3.0}, "plenoptic_wave: wavelenght: .*wavelength"),
    ("plenoptic_wave", {"method": "magic"}, "method = 'magic'"),
    ("plenoptic_wave", {"child": {"type": "ptracer"}}, "radiance along a ray"),
    ("plenoptic_wave", {"child": {"type": "aov", "aovs": "d:depth"}}, "nested AOVIntegrator"),
])  # fmt: skip
def test_parameters_of_plugins(camera_dict, plugin, parameters, words):
    sensor = camera_dict(**(parameters if plugin == "plenoptic" else {}))
    with pytest.raises(RuntimeError, match=words):
        mi.load_dict({"type": "scene", "sensor": sensor} if plugin == "plenoptic" else {"type": plugin, **parameters})


def test_a_sensor_needs_a_film_a_variant_and_a_lens_that_can_be_read(camera_dict, tmp_path):
    with pytest.raises(RuntimeError, match=r'film.* <film type="hdrfilm">'):
        mi.load_dict({"type": "plenoptic"})
    (tmp_path / "bad.yaml").write_text("surfaces: [{radius: 5, semi_aperture: 9, stop: true}]")
    with pytest.raises(RuntimeError, match="semi_aperture = 9"):
        mi.load_dict(camera_dict(main_lens=str(tmp_path / "bad.yaml")))
    mi.set_variant("llvm_ad_spectral")
    with pytest.raises(RuntimeError, match=r"SpecFilm: .*detector_blur"):
        mi.load_dict(camera_dict(detector_blur=0.01) | {"film": BANDS})
    mi.set_variant("scalar_rgb")
    with pytest.raises(RuntimeError, match="llvm_ad_"):
        mi.load_dict(camera_dict())


BAND = {"type": "regular", "wavelength_min": 500.0, "wavelength_max": 600.0, "values": "1, 1"}
BANDS = film(8, 8) | {"type": "specfilm", "a": BAND, "b": dict(BAND), "c": dict(BAND)}
del BANDS["pixel_format"]


@pytest.mark.parametrize(
    ("variant", "plate", "model", "words"),
    [
        ("llvm_ad_rgb", {"pixel_format": "rgba"}, "ray", "film: it has 4 channels"),
        ("llvm_ad_rgb", {"pixel_format": "xyz"}, "ray", "film: pixel_format = xyz"),
        ("llvm_ad_spectral", BANDS, "wave", "plenoptic_wave: film of type SpecFilm"),
    ],
)
def test_films_whose_channels_are_not_those_of_a_capture_are_refused(camera_dict, variant, plate, model, words):
    """Also by `mi.render`: colours would be taken for others, or Mitsuba would find them too few."""
    mi.set_variant(variant)
    sensor = camera_dict(resolution=16, detector_width=0.128)
    sensor["film"] = plate if "a" in plate else sensor["film"] | plate
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sensor": sensor})
    refuses(f"^{words}", mp.render_capture, scene, model=model, spp=1)
    if model == "wave":
        refuses(f"^{words}", mi.load_dict({"type": "plenoptic_wave"}).render, scene, spp=1)


def scene_before(sensor, **objects):
    return mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "camera": sensor} | objects)


MICROMETRES = {"focal_length": 80e3, "aperture_radius": 5e3, "mla_distance": 120e3, "mla_focal_length": 512.0}
"""Lengths of the paper's camera, as a scene in micrometres has them."""


@pytest.mark.filterwarnings("ignore:a pixel is")
def test_scenes_that_are_not_captured(camera_dict):
    depths = {"type": "aov", "aovs": "d:depth", "of": {"type": "path"}}
    for model in ("ray", "wave"):
        scene = scene_before(camera_dict(resolution=64), integrator=depths)
        refuses(r"d\.T; .*ground_truth", mp.render_capture, scene, model=model)
    sensor = camera_dict(resolution=16, detector_width=128, mla_pitch=64.0, **MICROMETRES)
    scene = scene_before(sensor, lamp=disk((0.0, 0.0, 240e3), 2e3))
    refuses("^detector_width = 128: pixels of 8 mm", mp.render_capture, scene, model="wave", spp=1)
    with pytest.raises(ValueError, match="plenoptic"):
        mi.load_dict({"type": "plenoptic_wave"}).render(scene_before({"type": "perspective"}), 0)


MOMENT = {"type": "moment", "p": {"type": "path"}}
MEDIUM = {"medium": {"type": "homogeneous"}}


@pytest.mark.parametrize(("integrator", "camera", "words"), [
    ({"type": "ptracer"}, {}, "^plenoptic: light tracing"),
    ({"type": "prbvolpath"}, MEDIUM, "prbvolpath ignores the medium"),
    (MOMENT, {"detector_blur": 0.01}, "^plenoptic: output m2_p.Z: .*detector_blur"),
    ({"type": "plenoptic_wave"}, {"film": {"pixel_format": "luminance_alpha"}}, "^film: it has 2 channels"),
    ({"type": "moment", "wave": {"type": "plenoptic_wave"}}, {}, "plenoptic_wave: .*nested"),
])  # fmt: skip
def test_scenes_are_loaded_only_if_their_integrator_can_render_their_camera(integrator, camera, words, camera_dict):
    """Once it renders, the last line of an error is Mitsuba's."""
    described = {"type": "scene", "integrator": integrator, "camera": camera_dict(resolution=16, **camera)}
    refuses(words, mp.load_scene, described)
    mp.load_scene(described | {"integrator": {"type": "path"}})
    mp.load_scene(described | {"camera": {"type": "perspective"}, "integrator": {"type": "ptracer"}})


@pytest.mark.parametrize(
    ("variant", "camera", "integrator", "words"),
    [
        ("llvm_ad_rgb", {"glass": '{"index": 1.5, "abbe": 50}'}, MOMENT, "output m2_p.Z: .*dispersion"),
        ("llvm_ad_mono", {}, MOMENT | {"samples_per_pass": 2}, "samples_per_pass"),
    ],
)
def test_outputs_that_blocked_rays_would_dilute_are_refused(variant, camera, integrator, words, camera_dict):
    mi.set_variant(variant)
    scene = scene_before(camera_dict(resolution=16, detector_width=0.128, **camera), sky={"type": "constant"})
    refuses(f"plenoptic: {words}", mi.load_dict(integrator).render, scene, scene.sensors()[0], spp=4)


def test_a_sensor_that_scales_is_refused():
    scene = scene_before({"type": "orthographic", "to_world": mi.ScalarTransform4f().scale(2)})
    refuses("plenoptic: to_world", mp.with_camera, scene, mp.PlenopticCamera())


def test_an_integrator_that_ignores_the_medium_around_an_ordinary_camera_is_refused():
    camera = mp.PlenopticCamera(mla_lattice="none", resolution=(24, 18), detector_width=2.4)
    sensor = camera.to_sensor() | {"medium": {"type": "homogeneous", "sigma_t": 1e-3}}
    for model in ("ray", "wave"):
        scene = scene_before(sensor, integrator={"type": "prbvolpath"})
        refuses("prbvolpath ignores the medium", mp.render_capture, scene, model=model)


def test_white_images_need_a_stop_that_bounds_micro_images():
    camera = mp.PlenopticCamera.preset("shack_hartmann")
    refuses("main_lens = .*image of the pupil", white_image, camera)
    with pytest.raises(RuntimeError, match="no stop bounds its micro-images"):
        mi.load_dict(camera.to_sensor())
