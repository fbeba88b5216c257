"""The table of a camera's parameters, and what is made from it."""

import os
import pickle
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from refusals import refuses

import mitsuba_plenoptic
from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.camera.vector import CameraVector, parts_of

ROOT = Path(__file__).parents[2]
PACKAGE = Path(mitsuba_plenoptic.__file__).parent

WEAK = {"magnification": 10, "numerical_aperture": 0.3}
VECTORS = {
    "two pitches": ({"mla_pitch": (0.06, 0.07)}, ["mla_pitch.1", "mla_pitch.2"], [0.06, 0.07], [6e-4, 7e-4]),
    "offset and angle": (
        {"mla_offset": (0.01, 0.02), "mla_rotation": 3},
        ["mla_offset.1", "mla_offset.2", "mla_rotation"],
        [0.01, 0.02, 3],
        [0.064, 0.064, 1],
    ),
    "aberrations": ({"wavefront": (0, 0.1, 0.2)}, ["wavefront.2", "wavefront.3"], [0.1, 0.2], [1, 1]),
}

ROUTES = {
    "json": lambda camera: PlenopticCamera.from_json(camera.to_json()),
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
    for start in (thin, again(PlenopticCamera.preset("lfm"))):
        microscope = start.replace(main_lens=WEAK)
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
    assert thin.aperture_radius == (5 if route != "json" else pytest.approx(13.3349, abs=1e-4))
    given = ROUTES[route](PlenopticCamera()).replace(aperture_radius=5).replace(main_lens="double_gauss")
    assert given.aperture_radius == 5
    # Fits and derivatives change what they name alone.
    fully_open = PlenopticCamera(main_lens="double_gauss", focal_length=80)
    changed = CameraVector.by_names(fully_open, ["focal_length"]).at(np.array([80.0 + 1e-3]))
    assert (changed.focal_length, changed.aperture_radius) == (80.0 + 1e-3, fully_open.aperture_radius)
    refuses("focal_length = 70", PlenopticCamera(focal_length=70).replace, main_lens=WEAK)


@pytest.mark.parametrize(("parameters", "labels", "values", "scales"), VECTORS.values(), ids=VECTORS)
def test_a_camera_is_a_vector_and_back(parameters, labels, values, scales):
    camera = PlenopticCamera(**parameters)
    vector = CameraVector.by_names(camera, list(parameters))
    assert vector.labels == labels and vector.names == tuple(parameters)
    assert vector.values.tolist() == values
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
        slopes = vector.slopes({name: direction.get(name, np.zeros(36)) for name in parameters})
        assert slopes[number] == direction[name].sum()


TRIAL = """
import drjit as dr, mitsuba as mi, numpy as np
import mitsuba_plenoptic as mp

mi.set_variant("llvm_ad_mono")
Camera = mp.PlenopticCamera
small = dict(detector_width=0.256, resolution=(64, 64), crop_offset=(37, 21), crop_size=(6, 6), temperature=35)
camera = Camera(**small)
assert Camera.from_json(camera.to_json()) == camera != camera.replace(temperature=20)
old = camera.to_dict()
del old["temperature"]
assert Camera.from_dict(old).temperature == 20
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

u = np.linspace(0, 1, 64, dtype=np.float32)
waves = 1 + 0.5 * np.sin(40 * u[None]) * np.cos(30 * u[:, None])
texture = {"type": "bitmap", "bitmap": mi.Bitmap(waves[..., None].astype(np.float32)), "raw": True}
place = mi.ScalarTransform4f().translate([0, 0, 215]).rotate([0, 1, 0], 180)
card = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": texture}}
world = {"type": "scene", "integrator": {"type": "path"}, "camera": camera.to_sensor(), "card": card}

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


@pytest.mark.slow
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
    _, *factors = re.findall(r"```diff\n-(.*\n)((?:\+.*\n)+)```", page)
    after = '    "mla_distance": (),\n'
    changes = [("camera/parameters.py", _END, f"{entry}{_END}"), ("camera/support.py", after, f"{row}{after}")]
    changes += [("camera/geometry.py", old, re.sub(r"(?m)^\+", "", new)) for old, new in factors]
    by_rays, by_waves = run_changed(tmp_path, changes, STOP)
    assert abs(by_rays - 0.48) < 0.003 and abs(by_waves - 0.48) < 0.003
