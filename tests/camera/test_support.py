"""The table of support: each parameter in each use changes the result, or the table says why not, or refuses it."""

import functools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from camera_draws import BASE, OPTIONS, Draw
from of_captures import image_at, wall
from of_sensors import exposed

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.camera import PARAMETERS, Use
from mitsuba_plenoptic.camera.support import entries_at, refusal
from mitsuba_plenoptic.extension import installed
from mitsuba_plenoptic.points.point_spread import point_fields
from mitsuba_plenoptic.views import white_image

GREEN = 550.0
FEW = {"resolution": (24, 24), "detector_width": 3 / 8 * Draw(11, []).parameters["detector_width"]}
"""Three lenses across."""
PLAIN = Draw(11, []).parameters | FEW
DIODES = {"angles_x": [-5, -1, 1, 5], "angles_y": [-5, 0, 5]}
DIODES["responses"] = [[[[0.9, 0.8, 0.2, 0.1]] * 3, [[0.1, 0.2, 0.8, 0.9]] * 3]]
FOURIER = {"mla_pitch": 0.5, "mla_focal_length": 20.0, "detector_width": 2.0, "resolution": (48, 48)}
FOURIER["main_lens"] = mp.Objective(20, 0.5, arrangement="fourier", fourier_focal_length=50)
OTHERS = {
    "resolution": {"resolution": (20, 20)},
    "crop_size": {"crop_size": (16, 12)},
    "crop_offset": {"crop_offset": (3, 4)},
    "mla_jitter of places": {"mla_jitter": (3e-4, 0.0)},
    "mla_jitter of focal lengths": {"mla_jitter": (0.0, 0.02)},
    "stray_light of a table": {"stray_light": [[0.05, 0.0]]},
    "main_lens collimator": {"main_lens": {"collimator_focal_length": 160.0}, "mla_distance": None},
}

CHANGES = (
    {name: Draw(11, [name]).parameters | FEW for name in OPTIONS}
    | {f"{name} otherwise": Draw(9, [name]).parameters for name in ("main_lens", "mla_lattice")}
    | {name: PLAIN | {name: 0.97 * PLAIN[name]} for name in set(BASE) - set(OPTIONS) - {"resolution"}}
    | {name: PLAIN | changes for name, changes in OTHERS.items()}
    | {"main_lens fourier": FOURIER}
)
"""Parameters of cameras with one that is not at its default, by its name and a word where it has several values."""
if "photodiode_response" in PARAMETERS:
    PAIRS = {"resolution": (4, 4), "detector_width": 2 / 3 * PLAIN["detector_width"]}
    CHANGES["photodiode_response"] = PLAIN | PAIRS | {"photodiode_response": DIODES}

rows = pytest.mark.parametrize("row", sorted(CHANGES))


def point_of(camera):
    if camera.objective is not None:
        return 0.004, -0.003, 0.02
    return 0.02, -0.03, 0.98 * min(camera.focus_distance, 1000.0)


def image_of(camera):
    return (np.random.default_rng(9).random(camera.shape) * 0.5 + 0.5).astype(np.float32)


def captured(model, spp, **options):
    return lambda camera: mp.render_capture(wall(camera, point_of(camera)[2]), model=model, spp=spp, **options).image


def operator_of(camera, **options):
    return mp.CaptureOperator(camera, [point_of(camera)], wavelength=GREEN, **options)


def refocused(method):
    return lambda camera: image_at(camera, image_of(camera), point_of(camera)[2], method, GREEN)


def point_gradient(camera):
    names = ["mla_distance", "detector_distance" if camera.has_array else "detector_width"]
    found = operator_of(camera).gradient([1.0], image_of(camera), names)
    return np.concatenate([np.ravel(each) for each in found.values()])


def scene_gradient(camera):
    scene = wall(camera, point_of(camera)[2])
    params = mi.traverse(scene)
    keys = exposed(params, ("mla_distance", "mla_focal_length"))
    key = keys.get("mla_distance") or keys["mla_focal_length"]
    dr.enable_grad(params[key])
    params.update()
    integrator = mi.load_dict({"type": "plenoptic_wave", "wavelength": GREEN, "child": {"type": "path"}})
    image = mi.render(scene, params, integrator=integrator, spp=8, seed=1)
    dr.backward(dr.sum((image * mi.TensorXf(image_of(camera)[..., None])).array))
    return np.ravel(np.array(dr.grad(params[key])))


RESULTS = {
    Use.RAYS: captured("ray", 16),
    Use.SCENES: captured("wave", 8, wavelength=GREEN),
    Use.SCENE_POINTS: captured("wave", 2, method="points", wavelength=GREEN),
    Use.POINTS: lambda camera: operator_of(camera).forward([1.0]),
    Use.FULL_FIELDS: lambda camera: operator_of(camera, method="full_field").forward([1.0]),
    Use.POINT_FIELDS: lambda camera: point_fields(camera, point_of(camera), wavelength=GREEN).detector.samples,
    Use.COHERENT_POINTS: lambda camera: operator_of(camera, method="full_field").field([1.0]).samples,
    Use.RAY_SPREADS: lambda camera: mp.point_spread_function(camera, point_of(camera), model="ray"),
    Use.FIELDS: refocused("coherent"),
    Use.RAY_REFOCUSING: refocused("ray"),
    Use.DECODING: lambda camera: np.asarray(mp.decode(image_of(camera), camera=camera)),
    Use.WHITE_IMAGES: white_image,
    Use.SCENE_DERIVATIVES: scene_gradient,
    Use.POINT_DERIVATIVES: point_gradient,
}
if "mitsuba_plenoptic.extensions.deconvolution" in installed():
    RESULTS[Use.RESPONSES] = refocused("incoherent")
if "mitsuba_plenoptic.extensions.laser" not in installed():
    del RESULTS[Use.COHERENT_POINTS]
FAST = (Use.DECODING, Use.WHITE_IMAGES, Use.RAY_REFOCUSING)
"""Uses that are tried in the usual suite; the others take minutes."""


@functools.cache
def result_without(row, use):
    """Return the result of the camera that has another parameter at its default, and all else as in a row."""
    name = row.split()[0]
    others = {each: value for each, value in CHANGES[row].items() if each != name}
    return RESULTS[use](mp.PlenopticCamera(**PLAIN | others))


def reason_of(camera, use):
    """Return the sentence that refuses a camera, None if the table takes it."""
    found = (refusal(name, value, use, entry) for name, value, entry in entries_at(camera, use) if entry.is_refusal)
    return next(found, None)


def words_of(error):
    """Return the words of an error and of those that it comes from, which Mitsuba and Dr.Jit wrap."""
    words = []
    while error is not None:
        words.append(str(error))
        error = error.__cause__ or error.__context__
    return " ".join(words)


def test_every_parameter_is_tried():
    assert {row.split()[0] for row in CHANGES} == set(PARAMETERS)


@rows
def test_every_parameter_survives_files_and_scene_files(row):
    camera, parameter = mp.PlenopticCamera(**CHANGES[row]), row.split()[0]
    assert mp.PlenopticCamera.from_json(camera.to_json()) == camera != mp.PlenopticCamera(**PLAIN)
    if reason_of(camera, Use.RAYS) is not None:
        return
    sensor = mi.load_string(f'<scene version="3.0.0">{camera.to_xml()}</scene>').sensors()[0]
    assert mp.PlenopticCamera.from_sensor(sensor) == camera
    if camera.prescription is None and camera.objective is None and camera.has_array and "crop" not in row:
        assert (parameter in exposed(mi.traverse(sensor), PARAMETERS)) == bool(PARAMETERS[parameter].gradients)


@pytest.mark.filterwarnings("ignore::mitsuba_plenoptic.PhysicsWarning")
@pytest.mark.parametrize("tried", ["fast", pytest.param("slow", marks=pytest.mark.slow)])
@rows
def test_parameters_change_results_or_the_table_says_why_not(row, tried):
    camera = mp.PlenopticCamera(**CHANGES[row])
    for use in RESULTS:
        reason = reason_of(camera, use)
        # Derivatives of scenes are refused after their capture.
        fast = use in FAST if reason is None else use is not Use.SCENE_DERIVATIVES
        if fast != (tried == "fast"):
            continue
        if reason is None:
            changed, usual = RESULTS[use](camera), result_without(row, use)
            assert np.isfinite(changed).any(), use
            is_same = changed.shape == usual.shape and np.array_equal(changed, usual, equal_nan=True)
            verdicts = {entry.verdict for each, _, entry in entries_at(camera, use) if each == row.split()[0]}
            assert verdicts if is_same else "exact" not in verdicts, use
            continue
        with pytest.raises((mp.InputError, RuntimeError)) as told:
            RESULTS[use](camera)
        # Where another use comes first, as patches do before their derivatives, its words are told.
        reasons = {reason, *(reason_of(camera, other) for other in RESULTS)} - {None}
        assert any(each in words_of(told.value) for each in reasons), use
