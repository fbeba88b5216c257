"""The table of support: each parameter in each use changes the result, or the table says why not, or refuses it."""

import functools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.camera import PARAMETERS, Use, require_support
from mitsuba_plenoptic.camera.support import entries_at, refusal
from mitsuba_plenoptic.extension import installed
from mitsuba_plenoptic.points.point_spread import point_fields
from mitsuba_plenoptic.views import white_image

PIXELS = 48
GREEN = 550.0


def _code():
    picture = np.ones((32, 32))
    picture[:, :12] = 0.3
    place = (np.arange(32) - 15.5) / 16
    picture[np.hypot(*np.meshgrid(place, place)) > 0.9] = 0
    return picture


def _screen():
    x, y = np.meshgrid(*2 * [np.linspace(-6, 6, 64)])
    return mp.PhaseScreen(0.02 * (x**2 - y**2), width=12)


JITTER = {"mla_jitter": (0.003, 0.02)}
THREE = {"mla_lattice": "hexagonal", "mla_focal_length": (0.5, 0.512, 0.52), "detector_distance": 0.512}
PAIRS = {"detector_width": PIXELS * 0.032}
DIODES = {"angles_x": [-5, -1, 1, 5], "angles_y": [-5, 0, 5]}
DIODES["responses"] = [[[[0.9, 0.8, 0.2, 0.1]] * 3, [[0.1, 0.2, 0.8, 0.9]] * 3]]
MICROSCOPE = {"mla_focal_length": 3.0, "mla_pitch": 0.15, "detector_width": 0.6}
FOURIER = {"mla_focal_length": 20, "mla_pitch": 0.5, "detector_width": 2.0}
CONIC = {"form": "conic", "curvature_radius": 0.256, "glass": 1.5}

CHANGES = {
    "focal_length": {"focal_length": 79.5},
    "aperture_radius": {"aperture_radius": 4.0},
    "aperture_blades": {"aperture_blades": 6},
    "aperture_image": {"aperture_image": _code()},
    "pupil_apodisation": {"pupil_apodisation": (-0.5, 0.0)},
    "mla_distance": {"mla_distance": 119.0},
    "focus_distance": {"focus_distance": 238.0},
    "mla_focal_length": {"mla_focal_length": 0.5, "detector_distance": 0.512},
    "mla_focal_length of three": THREE,
    "mla_pitch": {"mla_pitch": 0.063},
    "mla_pitch of two": {"mla_pitch": (0.064, 0.06)},
    "mla_lattice hexagonal": {"mla_lattice": "hexagonal"},
    "mla_lattice none": {"mla_lattice": "none"},
    "mla_rotation": {"mla_rotation": 5.0},
    "mla_offset": {"mla_offset": (0.01, 0.005)},
    "mla_tilt": {"mla_tilt": (3.0, 0.0)},
    "mla_aperture": {"mla_aperture": "circle"},
    "mla_fill": {"mla_fill": 0.8},
    "mla_transmissions": {"mla_transmissions": [[0.5, 1.0], [1.0, 0.7]]},
    "vignetting": {"vignetting": {"radius": [0.7], "scale": 0.6, "apodisation_2": [-0.3]}},
    "mla_medium": {"mla_medium": 1.5, "mla_focal_length": 0.6, "detector_distance": 0.6},
    "mla_absorption": {"mla_absorption": 2.0},
    "mla_shape": {"mla_shape": CONIC},
    "detector_distance": {"detector_distance": 0.505},
    "detector_width": {"detector_width": 0.19},
    "resolution": {"resolution": (40, 40)},
    "crop_offset": {"crop_offset": (8, 8)},
    "crop_size": {"crop_size": (40, 32)},
    "lens_model": {"lens_model": "parabolic"},
    "distortion": {"distortion": (0.8, 0, 0, 0, 0)},
    "wavefront": {"wavefront": (0, 0, 0, 0.3, 0, 0.2)},
    "phase_screen": {"phase_screen": _screen()},
    "mla_jitter": JITTER,
    "mla_jitter of places": {"mla_jitter": (0.003, 0.0)},
    "mla_jitter of focal lengths": {"mla_jitter": (0.0, 0.02)},
    "mla_seed": JITTER | {"mla_seed": 3},
    "mla_warp": {"mla_warp": (0.2, 0, 0.1, 0, 0, 0, 0, 0, 0, 0.15, 0, 0, 0, 0)},
    "mla_figure_error": {"mla_figure_error": (5e-5, 0.03)},
    "mla_cra": {"mla_cra": (0, 0, 0.1, 0.2, 0.2, 2.0)},
    "detector_blur": {"detector_blur": 0.004},
    "pixel_crosstalk": {"pixel_crosstalk": 0.05},
    "stray_light": {"stray_light": 0.05},
    "stray_light of a table": {"stray_light": [[0.05, 0.0]]},
    "stray_width": {"stray_light": 0.05, "stray_width": 0.04},
    "pixel_response": {"pixel_response": (0, 1, 3, 0.3)},
    "main_lens": {"main_lens": "cooke_triplet", "focal_length": 80, "aperture_radius": 5, "mla_distance": 120},
    "main_lens objective": {"main_lens": mp.Objective(20, 0.5)} | MICROSCOPE,
    "main_lens fourier": {"main_lens": mp.Objective(20, 0.5, arrangement="fourier", fourier_focal_length=50)} | FOURIER,
    "main_lens collimator": {"main_lens": {"collimator_focal_length": 160.0}},
    "glass": {"glass": {"index": 1.5168, "abbe": 64.2}},
    "mla_glass": {"mla_glass": {"index": 1.5168, "abbe": 64.2}},
    "photodiode_response": PAIRS | {"photodiode_response": DIODES},
}
"""A change of each parameter from its default, by its name and a word where it has several."""

WITHOUT = {
    "mla_focal_length of three": {"mla_lattice": "hexagonal"},
    "mla_seed": JITTER,
    "stray_width": {"stray_light": 0.05},
    "photodiode_response": PAIRS,
}
"""The camera with which a changed one is compared, where it is not the default."""


def camera_of(changes):
    return mp.PlenopticCamera(**{"detector_width": 0.192, "resolution": (PIXELS, PIXELS)} | changes)


def is_near(camera):
    """Whether distances count from an objective's native plane."""
    return camera.objective is not None


def scene_of(camera):
    """A textured card behind the plane in focus."""
    texture = (np.random.default_rng(5).random((24, 24, 1)) * 0.8 + 0.2).astype(np.float32)
    size, distance = (0.06, 0.02) if is_near(camera) else (0.8 * max(1.0, camera.detector_width / 0.256), 236.0)
    place = mi.ScalarTransform4f().translate([0, 0, distance]).rotate([0, 1, 0], 180).scale(size)
    radiance = {"type": "bitmap", "bitmap": mi.Bitmap(texture), "raw": True, "filter_type": "bilinear"}
    card = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": radiance}}
    card["bsdf"] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    path = {"type": "path", "max_depth": 2}
    return mi.load_dict({"type": "scene", "integrator": path, "camera": camera.to_sensor(), "card": card})


def points_of(camera):
    generator = np.random.default_rng(3)
    if is_near(camera):
        return generator.uniform(-0.005, 0.005, (3, 3))
    distance = generator.uniform(236, 244, 3)
    return np.column_stack([generator.uniform(-0.08, 0.08, (3, 2)) * -distance[:, None] / 120, distance])


def image_of(camera):
    return (np.random.default_rng(9).random(camera.shape) * 0.5 + 0.5).astype(np.float32)


def captured(model, spp, **options):
    return lambda camera: mp.render_capture(scene_of(camera), model=model, spp=spp, **options).image


def operator_of(camera, **options):
    return mp.CaptureOperator(camera, points_of(camera), wavelength=GREEN, **options)


def refocused(method, **options):
    def image(camera):
        distance = 0.02 if is_near(camera) else 238.0
        return mp.reconstruct(image_of(camera), distance, camera=camera, method=method, **options).image

    return image


def point_gradient(camera):
    weights = np.random.default_rng(1).normal(size=camera.shape).astype(np.float32)
    names = ["mla_distance", "detector_distance" if camera.has_array else "detector_width"]
    found = operator_of(camera).gradient(np.arange(1.0, 4), weights, names)
    return np.concatenate([np.ravel(each) for each in found.values()])


def scene_gradient(camera):
    scene = scene_of(camera)
    params = mi.traverse(scene)
    key = next(key for key in ("camera.mla_distance", "camera.mla_focal_length") if key in params)
    dr.enable_grad(params[key])
    params.update()
    integrator = mi.load_dict({"type": "plenoptic_wave", "wavelength": GREEN, "child": {"type": "path"}})
    image = mi.render(scene, params, integrator=integrator, spp=8, seed=1)
    weights = np.random.default_rng(1).normal(size=image.shape).astype(np.float32)
    dr.backward(dr.sum((image * mi.TensorXf(weights)).array))
    return np.ravel(np.array(dr.grad(params[key])))


NEEDS_LASER = pytest.mark.needs_extension("laser")

RESULTS = {
    Use.RAYS: captured("ray", 16),
    Use.SCENES: captured("wave", 8, wavelength=GREEN),
    Use.SCENE_POINTS: captured("wave", 2, method="points", wavelength=GREEN),
    Use.POINTS: lambda camera: operator_of(camera).forward(np.arange(1.0, 4)),
    Use.FULL_FIELDS: lambda camera: operator_of(camera, method="full_field").forward(np.arange(1.0, 4)),
    Use.POINT_FIELDS: lambda camera: point_fields(camera, points_of(camera)[0], wavelength=GREEN).detector.samples,
    Use.COHERENT_POINTS: lambda camera: operator_of(camera, method="full_field").field([1.0] * 3).samples,
    Use.RAY_SPREADS: lambda camera: mp.point_spread_function(camera, points_of(camera)[0], model="ray"),
    Use.FIELDS: refocused("coherent", wavelength=GREEN),
    Use.RAY_REFOCUSING: refocused("ray"),
    Use.DECODING: lambda camera: np.asarray(mp.decode(image_of(camera), camera=camera)),
    Use.WHITE_IMAGES: white_image,
    Use.SCENE_DERIVATIVES: scene_gradient,
    Use.POINT_DERIVATIVES: point_gradient,
}
if "mitsuba_plenoptic.extensions.deconvolution" in installed():
    RESULTS[Use.RESPONSES] = refocused("incoherent", wavelength=GREEN)
FAST = (Use.DECODING, Use.WHITE_IMAGES, Use.RAY_REFOCUSING)
"""Uses that are tried in the usual suite; the others take minutes."""

ROWS = [name for name in CHANGES if name != "photodiode_response" or name in PARAMETERS]


@functools.cache
def result_without(name, use):
    return RESULTS[use](camera_of(WITHOUT.get(name, {})))


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
    assert {name.split()[0] for name in CHANGES} >= set(PARAMETERS)


@pytest.mark.parametrize("name", ROWS)
def test_every_parameter_survives_files_and_scene_files(name):
    camera, parameter = camera_of(CHANGES[name]), name.split()[0]
    assert camera != camera_of({}) and mp.PlenopticCamera.from_json(camera.to_json()) == camera
    if reason_of(camera, Use.RAYS) is not None:
        return
    sensor = mi.load_string(f'<scene version="3.0.0">{camera.to_xml()}</scene>').sensors()[0]
    assert mp.PlenopticCamera.from_sensor(sensor) == camera
    exposed = {key.rsplit(".", 1)[-1] for key in mi.traverse(sensor).keys()}  # noqa: SIM118
    if camera.prescription is None and camera.objective is None and camera.has_array and "crop" not in name:
        assert (parameter in exposed) == bool(PARAMETERS[parameter].gradients)


@pytest.mark.parametrize(
    "uses",
    [
        pytest.param([use for use in RESULTS if use is not Use.SCENE_DERIVATIVES], id="early"),
        # Only after the capture.
        pytest.param([Use.SCENE_DERIVATIVES], marks=pytest.mark.slow, id="scene derivatives"),
    ],
)
@pytest.mark.parametrize("name", ROWS)
def test_refused_uses_say_what_the_table_says(name, uses):
    camera = camera_of(CHANGES[name])
    for use in uses:
        reason = reason_of(camera, use)
        if reason is None:
            require_support(camera, use)
            continue
        with pytest.raises((mp.InputError, RuntimeError)) as told:
            RESULTS[use](camera)
        # Where another use comes first, as patches do before their derivatives, its words are told.
        reasons = {reason, *(reason_of(camera, other) for other in RESULTS)} - {None}
        assert any(each in words_of(told.value) for each in reasons), use


@pytest.mark.filterwarnings("ignore::mitsuba_plenoptic.PhysicsWarning")
@pytest.mark.parametrize(
    "use",
    [
        pytest.param(
            use,
            marks=[
                *([] if use in FAST else [pytest.mark.slow]),
                *([NEEDS_LASER] if use is Use.COHERENT_POINTS else []),
            ],
            id=use.name,
        )
        for use in RESULTS
    ],
)
@pytest.mark.parametrize("name", ROWS)
def test_parameters_change_results_or_the_table_says_why_not(name, use):
    camera = camera_of(CHANGES[name])
    if reason_of(camera, use) is not None:
        return
    changed, usual = RESULTS[use](camera), result_without(name, use)
    assert np.isfinite(changed).any()
    is_same = changed.shape == usual.shape and np.array_equal(changed, usual, equal_nan=True)
    parameter = name.split()[0]
    verdicts = {entry.verdict for each, _, entry in entries_at(camera, use) if each == parameter}
    if not is_same:
        assert "exact" not in verdicts
    else:
        assert verdicts, "the result is unchanged, and the table does not say so"
