"""What point spreads, operators over points, their derivatives and coherent fields refuse."""

import functools

import mitsuba as mi
import numpy as np
import pytest
from cameras import HALF, WAVELENGTH, scattered, small_camera
from cases import PANES, THIN_FOG, facing, radiating, sensor

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.lenses.pupil_fit import ExitPupil
from mitsuba_plenoptic.light.optical_system import OpticalSystem
from mitsuba_plenoptic.prescription.lens_data import LensData

SMALL = small_camera()
POINT = [(0.0, 0.0, 240.0)]


def spread(**changes):
    return mp.point_spread_function(small_camera(16), **{"position": POINT[0], "wavelength": 633} | changes)


def operator(**changes):
    return mp.CaptureOperator(SMALL, **{"points": [(0, 0, 240), (1, 0, 240)], "wavelength": WAVELENGTH} | changes)


@functools.cache
def coloured():
    return mp.CaptureOperator(SMALL, scattered(2), spectrum=mp.Spectrum.lines(633, 532))


@functools.cache
def derived():
    return mp.CaptureOperator(small_camera(2), POINT, wavelength=WAVELENGTH)


HUGE = mp.PlenopticCamera(detector_width=24, resolution=(12000, 12000))
WEIGHTS = [np.ones(3), np.ones((2, 0)), np.ones((2, 1, 1)), [1.0, np.inf], "ab", np.ones((2, 3))]
SHAPES = [(8, 8), (256, 256), (256, 256, 3), (256 * 256 * 2,)]
NO_NUMBERS = [np.full(SMALL.shape, np.nan), "image", [[1.0], [1.0, 2.0]]]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: spread(position=(0, 0)), "^position"),
        (lambda: spread(position=(0, 0, 0)), "^position"),
        (lambda: spread(position=(0, 0, -240)), "^position"),
        (lambda: spread(position=(0, np.nan, 240)), "^position"),
        (lambda: spread(position=("a", 0, 240)), "^position"),
        (lambda: spread(wavelength=-1), "^wavelength"),
        (lambda: spread(wavelength=None), "^wavelength"),
        (lambda: spread(method="fast"), "^method"),
        (
            lambda: mp.point_spread_function(HUGE, POINT[0], wavelength=633, method="full_field"),
            "full field of position.*GiB",
        ),
        (lambda: operator(points=np.zeros((2, 2))), "^positions of shape"),
        (lambda: operator(points=[(0, 0, 240), (0, np.nan, 240)]), "^position"),
        (lambda: operator(points=[(0, 0, 240), (0, 0, 0)]), "^position.*g at least"),
        (lambda: operator(wavelength=0), "^wavelength"),
        (lambda: operator(wavelength=None), "^wavelength, spectrum: give one of the two"),
        (lambda: operator(spectrum=mp.Spectrum.lines(633)), "^wavelength, spectrum: give one of the two"),
        (lambda: operator(method="rays"), "^method"),
        (lambda: operator(accuracy="best"), "^accuracy"),
        (lambda: operator(accuracy=-0.1), "^accuracy.*from 0"),
        (lambda: operator(accuracy=1), "^accuracy.*below 1"),
        (
            lambda: operator(accuracy=0.02, method="full_field"),
            "^accuracy = 0.02: method = full_field takes none",
        ),
        (lambda: operator(pupil_weights=np.ones((2, 4, 5), bool)), "^pupil_weights of shape"),
        (lambda: operator(pupil_weights=np.ones((3, 4, 4), bool)), "^pupil_weights of shape"),
        (lambda: operator(pupil_weights=-np.ones((2, 4, 4))), "^pupil_weights"),
        (lambda: operator(pupil_weights=np.full((2, 4, 4), np.nan)), "^pupil_weights"),
        (lambda: operator(pupil_weights=np.full((2, 4, 4), "x")), "^pupil_weights"),
        *((lambda weights=weights: coloured().forward(weights), "^weights") for weights in WEIGHTS),
        *((lambda shape=shape: coloured().adjoint(np.ones(shape)), "^image of shape") for shape in SHAPES),
        *((lambda image=image: operator().adjoint(image), "^image") for image in NO_NUMBERS),
        (
            lambda: mp.CaptureOperator(
                mp.PlenopticCamera(),
                np.column_stack([np.random.default_rng(0).uniform(-2e5, 2e5, (100, 2)), np.full(100, 1e7)]),
                wavelength=WAVELENGTH,
            ).forward(np.ones(100)),
            # Their blur of 5 mm covers 2,500 pixels; a few are allowed.
            "^100 points by patches.*GiB",
        ),
        (lambda: derived().derivative([1.0], {"f_number": 1.0}), "f_number.*: it is none of the parameters"),
        (
            lambda: derived().derivative([1.0], {"mla_offset": 1.0}),
            "^mla_offset = 1.0: its change must be 2 numbers",
        ),
        (lambda: derived().derivative([1.0], {"focal_length": float("nan")}), "^focal_length"),
        (lambda: derived().derivative([1.0], [1.0]), "^changes = "),
        (
            lambda: operator(method="full_field").gradient([1.0, 1.0], np.zeros(SMALL.shape)),
            "^method = full_field: it has no derivatives",
        ),
    ],
)
def test_refused(call, words):
    with pytest.raises(mp.InputError, match=words):
        call()


@pytest.mark.parametrize("distance", [0.24, 10.0])
@pytest.mark.parametrize("method", ["patch", "full_field"])
def test_points_in_metres_are_recognised(distance, method):
    words = r"position = \(0, 0, .*\): its light would cover .* microlenses .* are the points in metres\?$"
    with pytest.raises(mp.InputError, match=words):
        mp.CaptureOperator(mp.PlenopticCamera(), [(0, 0, distance)], wavelength=WAVELENGTH, method=method).forward(
            [1.0]
        )


def test_more_memory_than_allowed_is_refused_with_the_estimate(monkeypatch):
    monkeypatch.setattr("mitsuba_plenoptic.runtime.limits.MEMORY_LIMIT", 2**20)
    operator = mp.CaptureOperator(SMALL, POINT, wavelength=WAVELENGTH)
    for work in (operator.estimate, lambda: operator.forward([1.0]), lambda: operator.adjoint(np.ones(SMALL.shape))):
        with pytest.raises(mp.InputError, match=r"1 points by patches.*GiB"):
            work()


AIR = mp.Objective(20, 0.5)
FOURIER = mp.Objective(20, 0.5, arrangement="fourier", fourier_focal_length=50)
IN_THE_STOP = mp.PlenopticCamera(main_lens=FOURIER, mla_pitch=0.5, mla_focal_length=20, resolution=(700, 700))
MICROSCOPE = mp.PlenopticCamera(
    main_lens=AIR, mla_pitch=0.15, mla_focal_length=3, detector_width=1.35, resolution=(135, 135)
)
TABLE = np.random.default_rng(3).uniform(0.2, 1.3, (6, 6))
BETWEEN = {"wavelength": None, "spectrum": mp.Spectrum.band(550, 40, 4).interpolated(2)}
FULL = {"method": "full_field"}
RAYS = "waves of points are followed through cameras without it only; use ray captures"


def waves(camera, points=POINT, **options):
    return mp.CaptureOperator(camera, points, **{"wavelength": WAVELENGTH} | options)


def forward(operator):
    return operator.forward([1.0])


def derivative(operator):
    return operator.derivative([1.0], {"mla_distance": 1.0})


def gradient(operator):
    return operator.gradient([1.0], np.ones(operator.camera.shape), ["focal_length"])


@pytest.mark.parametrize(
    ("changes", "options", "work", "words"),
    [
        ({"mla_jitter": (0.001, 0)}, {}, forward, f"mla_jitter = .*{RAYS}"),
        ({"mla_figure_error": (1e-5, 0.02)}, {}, forward, f"mla_figure_error = .*{RAYS}"),
        ({"pixel_response": (0, 1, 20, 0.5)}, {}, forward, RAYS),
        ({"pixel_response": (0, 1, 20, 0.5)}, FULL, forward, RAYS),
        ({"mla_absorption": 1.0}, {}, forward, "mla_absorption = 1.0: waves of points"),
        (
            {"mla_warp": (0.001,) * 14},
            {},
            derivative,
            "mla_warp = .*points have derivatives through cameras without it only",
        ),
        ({"mla_transmissions": TABLE}, {}, derivative, "mla_transmissions = .*leave it out"),
        ({"vignetting": {"radius": [0.8]}}, {}, gradient, "vignetting = .*leave it out"),
        (
            {"vignetting": {"radius": [0.8]}},
            FULL,
            lambda operator: operator.coherent_fields.at([1.0], "detector"),
            "vignetting = .*leave it out",
        ),
        (
            {"vignetting": {"radius": [0.8]}, "main_lens": "double_gauss", "focal_length": 80},
            {},
            forward,
            "vignetting = .*thin main lenses and objectives",
        ),
        ({"pupil_apodisation": (-0.6, 0.2)}, {}, gradient, "pupil_apodisation"),
        ({}, BETWEEN, derivative, r"spectrum: nodes = \(.*\): there are no derivatives between nodes"),
        (
            {"glass": {"index": 1.5, "abbe": 50}},
            {},
            gradient,
            "glass = abbe: there are no derivatives of cameras that disperse",
        ),
        (
            {"aperture_blades": 5},
            {"pupil_weights": np.ones((1, 2, 2))},
            forward,
            "^pupil_weights: points through apertures that are not round take none$",
        ),
    ],
)
def test_cameras_that_points_are_not_followed_through(changes, options, work, words):
    with pytest.raises(mp.InputError, match=words):
        work(waves(small_camera(**changes), **options))


GAUSS = mp.PlenopticCamera(main_lens="double_gauss", focal_length=80, aperture_radius=7)


class Unknown(LensData):
    """Data of no lens."""


def refracted(*points, **changes):
    """Follow points through a real lens."""
    return OpticalSystem(GAUSS.replace(**changes), WAVELENGTH).waves_of(np.array(points))


def pupil_of(point):
    return ExitPupil.of(mp.LensSystem.of(GAUSS, WAVELENGTH), point)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: refracted(POINT[0], mla_tilt=(1.0, 0.0)), "mla_tilt"),
        (lambda: refracted((0.0, 0.0, 10.0)), "g = 10: it must lie before the main_lens, beyond"),
        (
            lambda: refracted(POINT[0], (900.0, 0.0, 240.0)),
            r"position = \(900, 0, 240\): no light of it passes the main_lens",
        ),
        (lambda: pupil_of((0.0, 0.0, 40.0)), "g = 40: it must lie before the main_lens, beyond 56"),
        (lambda: pupil_of((600.0, 0.0, 240.0)), "no light of it passes the main_lens"),
        (lambda: main_lens(SMALL.replace(main_lens=Unknown())), "no function is marked"),
        (lambda: waves(IN_THE_STOP, [(0, 0, 0)]), "method = patch: light covers all of the stop's image"),
        (
            lambda: gradient(waves(MICROSCOPE, [(0, 0, 0)])),
            "derivatives of wave captures are found for thin main lenses",
        ),
        (
            lambda: waves(MICROSCOPE, [(0.0, 0.0, -10.0)]),
            r"position = \(0, 0, -10\): .* g more than -10: before the objective",
        ),
    ],
)
def test_main_lenses_that_do_not_see_points(call, words):
    with pytest.raises(mp.InputError, match=words):
        call()


NEAR = scattered(12, distances=(119.5, 120.5))
COHERENT = small_camera(4, **HALF)
WIDE = mp.PlenopticCamera(**HALF, resolution=(40000, 40000), detector_width=40)
TWO = mp.Spectrum([500, 600], [[1, 1]])
HALF_LIGHT = mp.Spectrum([500], [[0.5]])


def fields(points=NEAR, camera=COHERENT, **options):
    return waves(camera, points, **{"method": "full_field"} | options)


def collimated():
    return fields(camera=mp.PlenopticCamera.preset("shack_hartmann"), wavelength=500)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: fields().field([1.0]), r"amplitudes of shape \(1,\): it must be \(12,\)"),
        (lambda: fields().field(np.full(12, np.nan)), "amplitudes: all must be finite"),
        (lambda: fields().field(["a"] * 12), "amplitudes: they must be complex numbers"),
        (lambda: fields().field(np.ones(12), plane="mla"), "plane = 'mla'"),
        (lambda: fields().field_adjoint(np.ones((2, 2))), r"samples of shape \(2, 2\)"),
        (lambda: fields(np.empty((0, 3))).field_adjoint([[1]]), "points: coherent fields need at least one"),
        (
            lambda: fields(wavelength=None, spectrum=TWO).field(np.ones(12)),
            "spectrum of 2 wavelengths: a coherent field has one",
        ),
        (
            lambda: fields(wavelength=None, spectrum=HALF_LIGHT, method="patch").field(np.ones(12)),
            "spectrum: a coherent field has no channels and no response",
        ),
        (
            lambda: collimated().field(np.ones(12)),
            "main_lens = collimator: coherent fields need a thin main lens, whose pupil",
        ),
        (
            lambda: fields(method="patch", pupil_weights=np.ones((12, 4, 4))).field(np.ones(12)),
            "pupil_weights: coherent fields take none",
        ),
        (lambda: fields([(0, 0, 120.0)], WIDE).field([1]), "coherent field of 1 points: it would need"),
    ],
)
def test_coherent_fields(call, words):
    with pytest.raises(mp.InputError, match=words):
        call()


SPECIAL = {
    "sky": ({"sky": {"type": "constant"}}, "emitter .* is infinitely far"),
    "glass": (
        {"pane": {"type": "rectangle", "bsdf": {"type": "thindielectric"}}},
        "surface pane of type ThinDielectric is not",
    ),
    "mask": (
        {"pane": {"type": "rectangle", "bsdf": PANES["half-open mask"]}},
        "surface pane of type MaskBSDF is not matte",
    ),
    "gloss": (
        {"pane": {"type": "rectangle", "bsdf": {"type": "roughplastic"}}},
        "surface pane of type RoughPlastic is not matte",
    ),
    "medium": (
        {"fog": {"type": "cube", "interior": THIN_FOG, "bsdf": {"type": "diffuse"}}},
        "surface fog bounds a medium",
    ),
    "hidden emitters": ({"integrator": {"type": "path", "hide_emitters": True}}, "hide_emitters"),
    "fog": ({"camera": sensor(2, 8, medium=THIN_FOG)}, "the sensor is in a medium"),
    "motion": ({"camera": sensor(2, 8, shutter_open=0.0, shutter_close=1.0)}, "the shutter is open for 1"),
}


@pytest.mark.filterwarnings("ignore:a surface touches")
@pytest.mark.parametrize(("objects", "words"), SPECIAL.values(), ids=SPECIAL)
def test_scenes_that_are_no_matte_surfaces_are_refused_by_name(objects, words):
    wall = facing(240.0, 60.0, **radiating())
    described = {"type": "scene", "integrator": {"type": "path"}, "camera": sensor(2, 8), "wall": wall}
    with pytest.raises(mp.InputError, match=f"method = points: .*{words}"):
        mp.render_capture(mi.load_dict(described | objects), model="wave", method="points", spp=32)


def test_scenes_behind_objectives_are_refused():
    scene = mi.load_dict({"type": "scene", "camera": MICROSCOPE.to_sensor(), "integrator": {"type": "path"}})
    with pytest.raises(mp.InputError, match=r"main_lens = 20x/0\.5 objective"):
        mp.render_capture(scene, model="wave", method="points", wavelength=550)


CODE = np.pad(np.array([[1, 1, 0, 1, 0], [0, 1, 1, 0, 1], [1, 0, 0, 1, 1], [0.5, 1, 0, 0, 1], [1, 0, 1, 0.2, 0]]), 1)
LAMP = [(0.05, 0.02, 230.0)]


def capture_of_white(camera, **options):
    scene = {"type": "scene", "integrator": {"type": "path"}, "camera": camera.to_sensor(), "e": {"type": "constant"}}
    return mp.render_capture(mi.load_dict(scene), model="wave", **options)


def refocused(camera, method):
    return mp.reconstruct(np.zeros(camera.shape, np.float32), 230.0, camera=camera, method=method, wavelength=550.0)


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"aperture_blades": 6}, "aperture_blades = 6: "), ({"aperture_image": CODE}, "aperture_i")],
    ids=["blades", "image"],
)
@pytest.mark.parametrize(
    "call",
    [
        lambda camera: capture_of_white(camera, spp=1),
        lambda camera: capture_of_white(camera, method="points"),
        lambda camera: refocused(camera, "coherent"),
        lambda camera: refocused(camera, "partial"),
        lambda camera: waves(camera, LAMP).coherent_fields,
        lambda camera: waves(camera, LAMP).derivative([1.0], {"focal_length": 1.0}),
    ],
    ids=["waves", "points", "coherent", "partial", "fields", "derivative"],
)
def test_apertures_that_are_not_round_are_refused_by_name(call, changes, words):
    with pytest.raises(mp.InputError, match=f"^{words}.*leave it out$"):
        call(small_camera(4, **changes))


@pytest.mark.parametrize(
    ("changes", "also"), [({"mla_tilt": (0.1, 0)}, []), ({"distortion": (1e-4, 0, 0, 0, 0)}, ["partial"])]
)
def test_arrays_and_lenses_that_calibrations_find(changes, also):
    camera = small_camera(**changes)
    for work in (
        lambda: waves(camera),
        lambda: capture_of_white(camera, method="points"),
        *(lambda method=method: refocused(camera, method) for method in also),
    ):
        with pytest.raises(mp.InputError, match=rf"\A{next(iter(changes))} = .*through cameras without it only.*\Z"):
            work()
