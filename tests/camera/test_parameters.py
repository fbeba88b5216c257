"""The table of a camera's parameters, and what is made from it."""

import inspect
import json
import os
import pickle
import re
import shutil
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from xml.sax.saxutils import quoteattr

import mitsuba as mi
import numpy as np
import pytest
from refusals import refuses

import mitsuba_plenoptic
from mitsuba_plenoptic import InputError, PlenopticCamera
from mitsuba_plenoptic.camera.parameters import PARAMETERS
from mitsuba_plenoptic.camera.vector import CameraVector, parts_of

ROOT = Path(__file__).parents[2]
PACKAGE = Path(mitsuba_plenoptic.__file__).parent

REQUIRED = {
    "focal_length": 80.0,
    "aperture_radius": 5.0,
    "mla_distance": 120.0,
    "mla_focal_length": 0.512,
    "mla_pitch": 0.064,
    "detector_distance": 0.512,
    "detector_width": 8.192,
    "resolution": [4096, 4096],
    "crop_offset": [0, 0],
    "crop_size": [4096, 4096],
    "lens_model": "ideal",
}
"""What each record of a camera must state."""


def test_records_of_cameras_must_state_the_required_parameters():
    assert PlenopticCamera.from_dict(REQUIRED) == PlenopticCamera()
    for name in REQUIRED:
        with pytest.raises(InputError, match=f"^{name}: it is missing from the camera parameters"):
            PlenopticCamera.from_dict({other: value for other, value in REQUIRED.items() if other != name})


def test_the_record_its_signature_and_its_documentation_have_all_entries():
    arguments = inspect.signature(PlenopticCamera).parameters
    assert list(arguments) == list(PARAMETERS)
    assert {each.name for each in fields(PlenopticCamera)} == {entry.attribute for entry in PARAMETERS.values()}
    assert all(argument.default == PARAMETERS[name].default for name, argument in arguments.items())
    for name, entry in PARAMETERS.items():
        assert re.search(rf"^    {name} : ", PlenopticCamera.__doc__, re.MULTILINE)
        assert entry.words.endswith(".")
        known = {*PARAMETERS, "read_prescription", "PhotodiodeResponse", "Prescription", "Objective", "at_wavelength"}
        known |= {"PhaseScreen", "Collimator", "Aperture", "LensTransmissions", "StrayLight", "Vignetting"}
        assert set(re.findall(r"(?<![`:])`(\w+)`(?!`)", entry.words)) <= known


OTHER = {
    "focal_length": 70.3,
    "aperture_radius": 4.1,
    "aperture_blades": (6, 15.5),
    "aperture_image": {"transmission": [[0.0, 0.25], [1.0, 0.3333]]},
    "pupil_apodisation": (-0.19, 0.05),
    "vignetting": {"scale": 4.0, "radius": [0.95, 0.01, 0.0], "slope_x": [0.1]},
    "mla_distance": 130.7,
    "focus_distance": 300.9,
    "mla_focal_length": 0.5123,
    "mla_pitch": (0.0641, 0.0652),
    "mla_lattice": "hexagonal",
    "mla_rotation": -1.1,
    "mla_offset": (0.011, -0.023),
    "mla_tilt": (0.1, -0.2),
    "mla_aperture": "circle",
    "mla_fill": 0.83,
    "mla_transmissions": {"values": [[0.5, 1.0, 1.2], [1.0, 0.97531, 1.0]], "first": (-1, 3)},
    "mla_medium": 1.5,
    "mla_absorption": 0.3,
    "mla_shape": {"form": "conic", "curvature_radius": 0.25, "conic": -0.5, "coefficients": [3.0], "glass": 1.6},
    "mla_figure_error": (1e-5, 0.02),
    "detector_distance": 0.49,
    "detector_width": 8.3,
    "resolution": (4000, 3000),
    "crop_offset": (5, 7),
    "crop_size": (100, 90),
    "lens_model": "parabolic",
    "distortion": (1e-4, -1e-6, 1e-9, 2e-5, -3e-5),
    "wavefront": (0.0, 0.1, -0.2),
    "phase_screen": {"waves": np.outer(range(5), range(6)).tolist(), "width": 12.5},
    "mla_jitter": (0.0011, 0.023),
    "mla_seed": 4294967295,
    "mla_warp": (1e-5, 0.0, -2e-5, 0.0, 0.0, 0.0, 1e-6, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1e-6),
    "mla_cra": (0.0, 0.0, 2.0, 10.0, 4.0, 25.0),
    "detector_blur": 0.0021,
    "pixel_crosstalk": 0.02,
    "stray_light": {"values": [[0.03, 0.1, 0.12345], [0.0, 0.05, 1.0]]},
    "stray_width": 0.5,
    "pixel_response": (0.0, 1.0, 20.0, 0.3),
    "photodiode_response": {"angles_x": [-20, 20], "angles_y": [-9, 9], "responses": [[[[1, 0], [1, 0.5]]]]},
    "main_lens": "tessar",
    "glass": {"index": 1.5168, "abbe": 64.2},
    "mla_glass": 1.4585,
}
"""A value of each parameter that is not its default."""

NEEDS = {"photodiode_response": {"mla_pitch": 0.004}}
"""What a camera needs besides, if it is to have a parameter."""


@pytest.mark.parametrize("name", PARAMETERS)
def test_every_parameter_survives_files_and_scene_files(name):
    needed = NEEDS.get(name, {})
    camera = PlenopticCamera(**{name: OTHER[name]}, **needed)
    assert camera != PlenopticCamera(**needed)
    assert PlenopticCamera.from_json(camera.to_json()) == camera
    assert PlenopticCamera.from_json(json.dumps({name: OTHER[name]} | needed)) == camera
    written = mi.load_string(f'<scene version="3.0.0">{camera.to_xml()}</scene>')
    assert PlenopticCamera.from_sensor(written.sensors()[0]) == camera
    if name not in ("resolution", "crop_offset", "crop_size"):
        entry, value = PARAMETERS[name], OTHER[name]
        text = json.dumps(value) if isinstance(value, dict) else ", ".join(map(str, np.ravel(value).tolist()))
        kind = {int: "integer", float: "float"}.get(type(value), "string")
        film = '<film type="hdrfilm"><integer name="width" value="4096"/><integer name="height" value="4096"/>'
        given = f"<{kind} name={quoteattr(name)} value={quoteattr(text)}/>"
        given += "".join(f'<float name="{other}" value="{value}"/>' for other, value in needed.items())
        sensor = f'<sensor type="plenoptic">{given}{film}<rfilter type="box"/></film></sensor>'
        found = mi.load_string(f'<scene version="3.0.0">{sensor}</scene>').sensors()[0]
        assert PlenopticCamera.from_sensor(found) == camera
        exposed = {key.rsplit(".", 1)[-1] for key in mi.traverse(found).keys()}  # noqa: SIM118
        assert (name in exposed) == bool(entry.gradients)


@pytest.mark.parametrize("lens", [None, "tessar", {"magnification": 20, "numerical_aperture": 0.5}])
def test_arguments_make_the_same_camera(lens):
    camera = PlenopticCamera(main_lens=lens, mla_pitch=(0.06, 0.07), mla_jitter=(0.001, 0.02), mla_seed=3)
    assert PlenopticCamera(**camera.arguments()) == camera == camera.replace(mla_seed=4).replace(mla_seed=3)


def test_a_focus_distance_is_what_the_other_distances_make_it():
    camera = PlenopticCamera(focus_distance=300.0)
    assert "focus_distance" not in camera.to_dict()
    assert camera.replace(mla_distance=120).focus_distance == PlenopticCamera().focus_distance
    assert camera.replace(focal_length=60).mla_distance == camera.mla_distance


VECTORS = {
    "square": ({}, ["mla_pitch"], ["mla_pitch"], [0.064], [0.00064]),
    "two pitches": ({"mla_pitch": (0.06, 0.07)}, ["mla_pitch"], ["mla_pitch.1", "mla_pitch.2"], [0.06, 0.07], None),
    "three types": (
        {"mla_focal_length": (0.5, 0.6, 0.7), "mla_lattice": "hexagonal"},
        ["mla_focal_length"],
        ["mla_focal_length.1", "mla_focal_length.2", "mla_focal_length.3"],
        [0.5, 0.6, 0.7],
        [0.005, 0.006, 0.007],
    ),
    "offset and angle": (
        {"mla_offset": (0.01, 0.02), "mla_rotation": 3},
        ["mla_offset", "mla_rotation"],
        ["mla_offset.1", "mla_offset.2", "mla_rotation"],
        [0.01, 0.02, 3],
        [0.064, 0.064, 1],
    ),
    "aberrations": ({"wavefront": (0, 0.1, 0.2)}, ["wavefront"], ["wavefront.2", "wavefront.3"], [0.1, 0.2], [1, 1]),
}


ROUTES = {
    "as made": lambda camera: camera,
    "json": lambda camera: PlenopticCamera.from_json(camera.to_json()),
    "dict": lambda camera: PlenopticCamera.from_dict(camera.to_dict()),
    "pickle": lambda camera: pickle.loads(pickle.dumps(camera)),
    "replaced": lambda camera: camera.replace(mla_pitch=0.06).replace(mla_pitch=camera.mla_pitch),
}


@pytest.mark.parametrize("route", ROUTES)
def test_what_nobody_gave_follows_from_another_lens(route):
    """The right value is that of the camera made with the lens at once."""
    again, open_ = ROUTES[route], {"main_lens": "double_gauss", "focal_length": 80, "focus_distance": 1000}
    camera = again(PlenopticCamera(**open_))
    longer, shorter = again(camera.replace(focal_length=100)), again(camera.replace(focal_length=79))
    assert longer.aperture_radius == PlenopticCamera(main_lens="double_gauss", focal_length=100).aperture_radius
    assert shorter.aperture_radius == PlenopticCamera(main_lens="double_gauss", focal_length=79).aperture_radius
    tessar = PlenopticCamera(main_lens="tessar", focal_length=100)
    assert again(longer.replace(main_lens="tessar")).aperture_radius == tessar.aperture_radius
    thin = again(PlenopticCamera())
    assert thin.replace(main_lens="double_gauss").aperture_radius == camera.aperture_radius
    # Objectives and collimators set more.
    weak = {"magnification": 10, "numerical_aperture": 0.3}
    for start in (thin, again(PlenopticCamera.preset("lfm"))):
        microscope = start.replace(main_lens=weak)
        assert (microscope.focal_length, microscope.aperture_radius, microscope.mla_distance) == (20, 6, 200)
    telescope = again(PlenopticCamera.preset("shack_hartmann")).replace(focal_length=400)
    assert telescope.mla_distance == pytest.approx(400 + 160 + 160 * (1 + 160 / 400))


@pytest.mark.parametrize("route", ROUTES)
def test_what_somebody_gave_stays_with_another_lens(route):
    camera = ROUTES[route](PlenopticCamera(main_lens="double_gauss", focal_length=80, aperture_radius=5))
    for other in (camera.replace(focal_length=100), camera.replace(main_lens="tessar").replace(focal_length=79)):
        assert other.aperture_radius == 5
    # A file of a thin lens cannot tell 5 mm that were given from the default.
    thin = ROUTES[route](PlenopticCamera(aperture_radius=5)).replace(main_lens="double_gauss")
    assert thin.aperture_radius == (5 if route not in ("json", "dict") else pytest.approx(13.3349, abs=1e-4))
    given = ROUTES[route](PlenopticCamera()).replace(aperture_radius=5).replace(main_lens="double_gauss")
    assert given.aperture_radius == 5
    # Fits and derivatives change what they name alone.
    fully_open = PlenopticCamera(main_lens="double_gauss", focal_length=80)
    changed = CameraVector.by_names(fully_open, ["focal_length"]).at(np.array([80.0 + 1e-3]))
    assert (changed.focal_length, changed.aperture_radius) == (80.0 + 1e-3, fully_open.aperture_radius)
    refuses(
        "focal_length = 70: with this main_lens it is 20",
        PlenopticCamera(focal_length=70).replace,
        main_lens={"magnification": 10, "numerical_aperture": 0.3},
    )


@pytest.mark.parametrize(("parameters", "names", "labels", "values", "scales"), VECTORS.values(), ids=VECTORS)
def test_a_camera_is_a_vector_and_back(parameters, names, labels, values, scales):
    camera = PlenopticCamera(**parameters)
    vector = CameraVector.by_names(camera, names)
    assert vector.labels == labels and vector.names == tuple(names)
    assert vector.values.tolist() == values
    if scales is not None:
        np.testing.assert_allclose(vector.scales, scales, rtol=1e-12)
    assert vector.at(vector.values) == camera
    moved = vector.values * 1.01
    assert vector.of(vector.at(moved)).values == pytest.approx(moved, rel=1e-15)
    # A direction is the change of all parts of a parameter with one number; a gradient by all parts goes back by it.
    for number, direction in enumerate(vector.directions()):
        ((name, change),) = direction.items()
        step = np.eye(len(values))[number] * 1e-3
        change = change[: len(parts_of(camera, name))] * 1e-3
        assert parts_of(vector.at(vector.values + step), name) == pytest.approx(parts_of(camera, name) + change)
        slopes = vector.slopes({name: direction.get(name, np.zeros(36)) for name in names})
        assert slopes[number] == direction[name].sum()


def test_bounds_are_by_number_or_by_parameter():
    vector = CameraVector.by_names(PlenopticCamera(mla_pitch=(0.06, 0.07)), ["mla_pitch", "mla_fill"])
    low, high = vector.limits(None)
    np.testing.assert_allclose([low, high], [[0.03, 0.035, 0.5], [0.09, 0.105, 1]])
    low, high = vector.limits({"mla_pitch": (0.05, 0.08), "mla_fill": (0.9, 1)})
    assert (low.tolist(), high.tolist()) == ([0.05, 0.05, 0.9], [0.08, 0.08, 1])
    assert vector.limits({"mla_pitch.2": (0.05, 0.08)})[0].tolist() == [0.03, 0.05, 0.5]


TRIAL = """
import drjit as dr, mitsuba as mi, numpy as np
import mitsuba_plenoptic as mp

mi.set_variant("llvm_ad_mono")
Camera = mp.PlenopticCamera
small = dict(detector_width=0.256, resolution=(64, 64), crop_offset=(37, 21), crop_size=(6, 6), temperature=35)
camera = Camera(**small)
assert camera.temperature == 35 and camera != camera.replace(temperature=20)
assert Camera.from_json(camera.to_json()) == camera
old = camera.to_dict()
del old["temperature"]
assert Camera.from_dict(old).temperature == 20
try:
    Camera(temperature=200)
except mp.InputError as error:
    assert str(error) == "temperature = 200: it must be at most 100"
dark = {"type": "scene", "integrator": {"type": "path"}}
for work in (
    lambda: mp.CaptureOperator(camera, [(0, 0, 240)], wavelength=550),
    lambda: mp.render_capture(mp.load_scene(dark | {"camera": camera.to_sensor()}), model="wave", spp=4),
):
    try:
        work()
    except mp.InputError as error:
        assert "temperature = 35.0: " in str(error) and "ray captures alone are known to follow it" in str(error), error
    else:
        raise AssertionError
assert "temperature : float" in Camera.__doc__

u = np.linspace(0, 1, 64, dtype=np.float32)
waves = 1 + 0.5 * np.sin(40 * u[None]) * np.cos(30 * u[:, None])
texture = {"type": "bitmap", "bitmap": mi.Bitmap(waves[..., None].astype(np.float32)), "raw": True}
place = mi.ScalarTransform4f().translate([0, 0, 215]).rotate([0, 1, 0], 180)
card = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": texture}}
world = {"type": "scene", "integrator": {"type": "path"}, "camera": camera.to_sensor(), "card": card}
written = mi.load_string('<scene version="3.0.0">' + camera.to_xml() + "</scene>")
assert Camera.from_sensor(written.sensors()[0]) == camera

def captured(value, gradient=False):
    scene = mi.load_dict(world, optimize=False)
    params = mi.traverse(scene)
    (key,) = [key for key in params.keys() if key.endswith("temperature")]
    dr.enable_grad(params[key])
    dr.set_grad(params[key], 1.0)
    params[key] = value + (params[key] - dr.detach(params[key]))
    params.update()
    assert Camera.from_sensor(scene.sensors()[0]) == camera.replace(temperature=value)
    # Gradients are estimated with random numbers of their own, which are those of the captures that are compared.
    image = mi.render(scene, params, spp=64, seed=1 if gradient else 2, seed_grad=2 if gradient else 1)
    return (dr.forward_to(image) if gradient else image).numpy()[..., 0]

slope, more, less = captured(35.0, gradient=True), captured(37.0), captured(33.0)
step = (more - less) / 4
print(np.abs(more / less - 1).max(), np.linalg.norm(slope - step) / np.linalg.norm(step))
"""


_END = "\n\nif TYPE_CHECKING:\n\n    class ShippedParameters"
"""What follows the table."""


def run_changed(tmp_path, changes, trial):
    """Run a script with a copy of the package in which each line of `changes` (file, old, new) is changed."""
    copy = tmp_path / PACKAGE.name
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    for path, old, new in changes:
        text = (copy / path).read_text()
        assert text.count(old) == 1
        (copy / path).write_text(text.replace(old, new))
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-c", trial]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    return [float(number) for number in done.stdout.split()]


def test_a_parameter_is_one_entry_and_a_formula(tmp_path):
    """As the developer page says: a copy of the package with the page's entry and the page's line."""
    page = (ROOT / "docs" / "reference" / "develop" / "extending.md").read_text()
    entry = re.search(r"```py\n(    temperature.*?)```", page, re.DOTALL)[1]
    before, after = re.search(r"```diff\n-(.*\n)\+(.*\n)```", page).groups()
    changes = ("camera/parameters.py", _END, f"{entry}{_END}"), ("rays/sensor_rays.py", before, after)
    change, error = run_changed(tmp_path, changes, TRIAL)
    assert change > 1e-3 and error < 0.02


STOP = """
import mitsuba as mi
import mitsuba_plenoptic as mp

mi.set_variant("llvm_ad_mono")
camera = mp.PlenopticCamera(resolution=(64, 64), detector_width=0.256)
stopped = mp.PlenopticCamera.from_json(camera.replace(second_stop=(0.6, 0.8)).to_json())
sky = {"type": "scene", "integrator": {"type": "direct"}, "sky": {"type": "constant", "radiance": 1.0}}
scenes = [mp.load_scene(sky | {"camera": each.to_sensor()}) for each in (camera, stopped)]
for model in "ray", "wave":
    whole, capture = (mp.render_capture(scene, model=model, spp=256) for scene in scenes)
    print(capture.image.mean() / whole.image.mean())
try:
    mp.reconstruct(capture, 240, method="coherent")
except mp.InputError as error:
    assert "second_stop = (0.6, 0.8)" in str(error)
else:
    raise AssertionError
"""


@pytest.mark.slow
def test_a_layer_of_the_pupil_is_an_entry_a_row_and_a_factor(tmp_path):
    """As the developer page says: an elliptic stop passes the product of its half-axes by rays and by waves."""
    page = (ROOT / "docs" / "reference" / "develop" / "extending.md").read_text()
    entry = re.search(r"```py\n(    second_stop.*?)```", page, re.DOTALL)[1]
    row = re.search(r"```py\n(    \"second_stop.*?)```", page, re.DOTALL)[1]
    _, *factors = re.findall(r"```diff\n-(.*\n)\+(.*\n)```", page)
    after = '    "mla_distance": (),\n'
    changes = [("camera/parameters.py", _END, f"{entry}{_END}"), ("camera/support.py", after, f"{row}{after}")]
    changes += [("camera/geometry.py", old, new) for old, new in factors[:2]]
    by_rays, by_waves = run_changed(tmp_path, changes, STOP)
    assert abs(by_rays - 0.48) < 0.003 and abs(by_waves - 0.48) < 0.003
