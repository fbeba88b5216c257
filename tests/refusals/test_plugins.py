"""What the plugins refuse: parameters in scenes, films, and scenes that they do not capture."""

import mitsuba as mi
import pytest
from cameras import disk, film, write_scene

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.views.white import white_image


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"focal_length": -80.0}, "plenoptic: focal_length = -80: it must be greater than 0"),
        ({"focal_length": "eighty"}, "plenoptic: focal_length = 'eighty': it must be a number"),
        ({"aperture_radius": True}, "plenoptic: aperture_radius = True: it must be a number"),
        ({"focus_distance": 240.0, "mla_distance": 120.0}, "give one of the two"),
        ({"near_clip": 1.0}, "plenoptic: near_clip = 1: this camera has no clipping planes"),
        ({"glass": "{1.5"}, "glass: it must be a JSON object"),
        ({"mla_pich": 3.0}, r"plenoptic: mla_pich: it has no such parameter; did you mean mla_pitch\?"),
        ({"mla_offset": "a, b"}, "plenoptic: mla_offset = 'a, b': it must be a number, or several with commas"),
        ({"mla_offset": [1.0, 2.0, 3.0]}, r"plenoptic: mla_offset = \(1.0, 2.0, 3.0\): it must be a pair"),
        ({"mla_focal_length": "0.5, 0.6, 0.7"}, "several need mla_lattice = hexagonal"),
        ({"mla_focal_length": "0.5;0.6"}, "plenoptic: mla_focal_length = '0.5;0.6': it must be a number, or several"),
        ({"film": {"rfilter": {"type": "gaussian"}}}, 'GaussianFilter smears .*; add the line <rfilter type="box"/>'),
    ],
)
def test_parameters_of_the_sensor(camera_dict, parameters, words):
    with pytest.raises(RuntimeError, match=words):
        mi.load_dict(camera_dict(**parameters))
    with pytest.raises(RuntimeError, match=words):
        mi.load_dict({"type": "scene", "sensor": camera_dict(**parameters)})


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"wavelength": -633.0}, "plenoptic_wave: wavelength = -633: it must be greater than 0"),
        ({"wavelength": "600, 500, 400"}, "variant llvm_ad_mono has 1 channel"),
        ({"wavelenght": 3.0}, r"plenoptic_wave: wavelenght: it has no such parameter; did you mean wavelength\?"),
        ({"method": "magic"}, "method = 'magic': it must be one of signed_rays, points"),
        ({"accuracy": -0.01}, "accuracy = -0.01: it must be from 0"),
        ({"child": {"type": "ptracer"}}, "it cannot tell the radiance along a ray"),
        (
            {"child": {"type": "aov", "aovs": "d:depth"}},
            "nested AOVIntegrator: .* also tells what a capture would lose",
        ),
    ],
)
def test_parameters_of_the_integrator(parameters, words):
    with pytest.raises(RuntimeError, match=words):
        mi.load_dict({"type": "plenoptic_wave", **parameters})
    with pytest.raises(RuntimeError, match=words):
        mi.load_dict({"type": "scene", "integrator": {"type": "plenoptic_wave", **parameters}})


def test_a_sensor_needs_a_film_a_variant_and_a_lens_that_can_be_read(camera_dict, tmp_path):
    with pytest.raises(RuntimeError, match='it has no film; add the line <film type="hdrfilm"> <rfilter type="box"/>'):
        mi.load_dict({"type": "plenoptic"})
    (tmp_path / "bad.yaml").write_text("surfaces: [{radius: 5, semi_aperture: 9, stop: true}]")
    with pytest.raises(RuntimeError, match="semi_aperture = 9: the surface of radius 5 ends before that"):
        mi.load_dict(camera_dict(main_lens=str(tmp_path / "bad.yaml")))
    mi.set_variant("llvm_ad_spectral")
    with pytest.raises(RuntimeError, match="film of type SpecFilm: it must be an hdrfilm behind detector_blur"):
        mi.load_dict(camera_dict(detector_blur=0.01) | {"film": BANDS})
    mi.set_variant("scalar_rgb")
    with pytest.raises(RuntimeError, match="this plugin needs an llvm_ad_"):
        mi.load_dict(camera_dict())


BAND = {"type": "regular", "wavelength_min": 500.0, "wavelength_max": 600.0, "values": "1, 1"}
BANDS = film(8, 8) | {"type": "specfilm", "a": BAND, "b": dict(BAND), "c": dict(BAND)}
del BANDS["pixel_format"]


@pytest.mark.parametrize(
    ("variant", "plate", "model", "words"),
    [
        ("llvm_ad_mono", {"pixel_format": "luminance_alpha"}, "wave", "film: it has 2 channels; a capture needs"),
        ("llvm_ad_rgb", {"pixel_format": "rgba"}, "wave", "film: it has 4 channels"),
        ("llvm_ad_rgb", {"pixel_format": "rgba"}, "ray", "film: it has 4 channels"),
        ("llvm_ad_rgb", {"pixel_format": "xyz"}, "ray", "film: pixel_format = xyz: a capture needs"),
        ("llvm_ad_spectral", BANDS, "wave", "plenoptic_wave: film of type SpecFilm: it must be an hdrfilm"),
    ],
)
def test_films_whose_channels_are_not_those_of_a_capture_are_refused(camera_dict, variant, plate, model, words):
    """Also by `mi.render`: colours would be taken for others, or Mitsuba would find them too few."""
    mi.set_variant(variant)
    sensor = camera_dict(resolution=8)
    sensor["film"] = plate if "a" in plate else sensor["film"] | plate
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sensor": sensor})
    with pytest.raises(mp.InputError, match=f"^{words}"):
        mp.render_capture(scene, model=model, spp=1)
    if model == "wave":
        with pytest.raises(mp.InputError, match=f"^{words}"):
            mi.load_dict({"type": "plenoptic_wave"}).render(scene, spp=1)


def scene_before(sensor, **objects):
    return mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "camera": sensor} | objects)


MICROMETRES = {"focal_length": 80e3, "aperture_radius": 5e3, "mla_distance": 120e3, "mla_focal_length": 512.0}
"""Lengths of the paper's camera, as a scene in micrometres has them."""


def test_scenes_that_are_not_captured(camera_dict):
    depths = {"type": "aov", "aovs": "d:depth", "of": {"type": "path"}}
    for model in ("ray", "wave"):
        with pytest.raises(mp.InputError, match=r"the extra outputs .*d\.T; .* ground_truth\(scene\) returns depth"):
            mp.render_capture(scene_before(camera_dict(resolution=64), integrator=depths), model=model)
    sensor = camera_dict(resolution=16, detector_width=128, mla_pitch=64.0, **MICROMETRES)
    with pytest.raises(mp.InputError, match=r"^detector_width = 128: pixels of 8 mm.*kernels of .* samples: it would"):
        mp.render_capture(scene_before(sensor, lamp=disk((0.0, 0.0, 240e3), 2e3)), model="wave", spp=1)
    with pytest.raises(ValueError, match="needs a sensor of type 'plenoptic'"):
        mi.load_dict({"type": "plenoptic_wave"}).render(scene_before({"type": "perspective"}), 0)


MOMENT = {"type": "moment", "p": {"type": "path"}}


@pytest.mark.parametrize(
    ("integrator", "camera", "words"),
    [
        ({"type": "ptracer"}, {}, "^plenoptic: light tracing .* use path or direct"),
        (
            {"type": "prbvolpath"},
            {"medium": {"type": "homogeneous"}},
            "prbvolpath ignores the medium around the camera",
        ),
        (MOMENT, {"detector_blur": 0.01}, "^plenoptic: output m2_p.Z: .* without detector_blur"),
        ({"type": "plenoptic_wave"}, {"film": {"pixel_format": "luminance_alpha"}}, "^film: it has 2 channels"),
        ({"type": "moment", "wave": {"type": "plenoptic_wave"}}, {}, "plenoptic_wave: it is no nested integrator"),
    ],
)
def test_scenes_are_loaded_only_if_their_integrator_can_render_their_camera(integrator, camera, words, camera_dict):
    """Once it renders, the last line of an error is Mitsuba's."""
    described = {"type": "scene", "integrator": integrator, "camera": camera_dict(resolution=16, **camera)}
    with pytest.raises(mp.InputError, match=words):
        mp.load_scene(described)
    mp.load_scene(described | {"integrator": {"type": "path"}})
    mp.load_scene(described | {"camera": {"type": "perspective"}, "integrator": {"type": "ptracer"}})


@pytest.mark.parametrize(
    ("variant", "camera", "integrator", "words"),
    [
        ("llvm_ad_mono", {"detector_blur": 0.01}, MOMENT, r"plenoptic: output m2_p.Z: .* without detector_blur"),
        (
            "llvm_ad_rgb",
            {"glass": '{"index": 1.5, "abbe": 50}'},
            MOMENT,
            "plenoptic: output m2_p.Z: .* without dispersion",
        ),
        ("llvm_ad_mono", {}, MOMENT | {"samples_per_pass": 2}, "plenoptic: samples_per_pass: .* in one pass"),
    ],
)
def test_outputs_that_blocked_rays_would_dilute_are_refused(variant, camera, integrator, words, camera_dict):
    mi.set_variant(variant)
    scene = scene_before(camera_dict(resolution=16, detector_width=0.128, **camera), sky={"type": "constant"})
    with pytest.raises(mp.InputError, match=words):
        mi.load_dict(integrator).render(scene, scene.sensors()[0], spp=4)


def test_a_sensor_that_scales_is_refused(tmp_path):
    scaled = '<transform name="to_world"><scale value="2"/></transform>'
    path = write_scene(tmp_path, sensor=scaled)
    path.write_text(path.read_text().replace("plenoptic", "orthographic"))
    with pytest.raises(mp.InputError, match="plenoptic: to_world: it must not scale"):
        mp.with_camera(mp.load_scene(path), mp.PlenopticCamera())


def test_an_integrator_that_ignores_the_medium_around_the_camera_is_refused():
    camera = mp.PlenopticCamera(
        mla_lattice="none", focal_length=50, aperture_radius=5, focus_distance=400, resolution=(24, 18),
        detector_width=24,
    )  # fmt: skip
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "prbvolpath"},
            "fog": {"type": "homogeneous", "sigma_t": 1e-3},
            "camera": camera.to_sensor() | {"medium": {"type": "ref", "id": "fog"}},
        }
    )
    for model in ("ray", "wave"):
        for capture in (mp.render_capture, mp.estimate_capture):
            with pytest.raises(mp.InputError, match="prbvolpath ignores the medium around the camera; use volpath"):
                capture(scene, model=model)


FOURIER = mp.Objective(20, 0.5, arrangement="fourier", fourier_focal_length=50)


@pytest.mark.parametrize(
    "camera",
    [
        mp.PlenopticCamera.preset("shack_hartmann"),
        mp.PlenopticCamera(main_lens=FOURIER, mla_pitch=0.5, mla_focal_length=20),
    ],
    ids=["shack_hartmann", "fourier"],
)
def test_white_images_need_a_stop_that_bounds_micro_images(camera):
    with pytest.raises(
        mp.InputError, match=r"\Amain_lens = .*the array is in the image of the stop.*full_field, or leave it out\Z"
    ):
        white_image(camera)
    if camera.main_lens == FOURIER:
        with pytest.raises(RuntimeError, match="no stop bounds its micro-images"):
            mi.load_dict(camera.to_sensor())
