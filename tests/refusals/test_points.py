"""What point spreads, operators over points, their derivatives and coherent fields refuse."""

import functools

import mitsuba as mi
import numpy as np
import pytest
from cameras import CODE, HALF, TABLE, WAVELENGTH, scattered, sky, small_camera
from cases import PANES, THIN_FOG, facing, radiating, sensor

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.lenses.pupil_fit import ExitPupil
from mitsuba_plenoptic.prescription.lens_data import LensData

SMALL = small_camera()
POINT = [(0.0, 0.0, 240.0)]
AIR = mp.Objective(20, 0.5)
FOURIER = mp.Objective(20, 0.5, arrangement="fourier", fourier_focal_length=50)
IN_THE_STOP = mp.PlenopticCamera(main_lens=FOURIER, mla_pitch=0.5, mla_focal_length=20, resolution=(700, 700))
MICROSCOPE = mp.PlenopticCamera(
    main_lens=AIR, mla_pitch=0.15, mla_focal_length=3, detector_width=1.35, resolution=(135, 135)
)
GAUSS = mp.PlenopticCamera(main_lens="double_gauss", focal_length=80, aperture_radius=7)
HUGE = mp.PlenopticCamera(detector_width=24, resolution=(12000, 12000))
WIDE = mp.PlenopticCamera(**HALF, resolution=(40000, 40000), detector_width=40)
NEAR = scattered(12, distances=(119.5, 120.5))
FAR = np.column_stack([np.random.default_rng(0).uniform(-2e5, 2e5, (100, 2)), np.full(100, 1e7)])
"""Their blur of 5 mm covers 2,500 pixels; a few are allowed."""


NEEDS_LASER = pytest.mark.needs_extension("laser")


def pane(bsdf):
    return {"type": "rectangle", "bsdf": bsdf}


class Unknown(LensData):
    """Data of no lens."""


def spread(**changes):
    return mp.point_spread_function(small_camera(16), **{"position": POINT[0], "wavelength": 633} | changes)


def waves(camera, points=POINT, **options):
    return mp.CaptureOperator(camera, points, **{"wavelength": WAVELENGTH} | options)


def operator(**changes):
    return waves(SMALL, **{"points": [(0, 0, 240), (1, 0, 240)]} | changes)


@functools.cache
def coloured():
    return mp.CaptureOperator(SMALL, scattered(2), spectrum=mp.Spectrum.lines(633, 532))


@functools.cache
def derived():
    return waves(small_camera(2))


def refracted(*points, **changes):
    """Follow points through a real lens."""
    return OpticalSystem(GAUSS.replace(**changes), WAVELENGTH).waves_of(np.array(points))


def pupil_of(point):
    return ExitPupil.of(mp.LensSystem.of(GAUSS, WAVELENGTH), point)


def field(amplitudes=(1,) * 12, points=NEAR, camera=None, plane="detector", **options):
    """Return the coherent field of near points."""
    camera = camera or small_camera(4, **HALF)
    return waves(camera, points, **{"method": "full_field"} | options).field(list(amplitudes), plane=plane)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        *(
            (lambda place=place: spread(position=place), "^position")
            for place in ((0, 0), (0, 0, 0), (0, 0, -240), (0, np.nan, 240), ("a", 0, 240))
        ),
        (lambda: spread(wavelength=-1), "^wavelength"),
        (lambda: spread(method="fast"), "^method"),
        (
            lambda: mp.point_spread_function(HUGE, POINT[0], wavelength=633, method="full_field"),
            "full field of position.*GiB",
        ),
        (lambda: operator(points=[(0, 0, 240), (0, np.nan, 240)]), "^position"),
        (lambda: operator(points=[(0, 0, 240), (0, 0, 0)]), "^position.*g at least"),
        (lambda: operator(wavelength=0), "^wavelength"),
        (lambda: operator(spectrum=mp.Spectrum.lines(633)), "^wavelength, spectrum: give one of the two"),
        *(
            (lambda bound=bound: operator(system=OpticalSystem(*bound)), "bound to another camera")
            for bound in ((small_camera(2), WAVELENGTH), (SMALL, 550.0))
        ),
        (lambda: operator(method="rays"), "^method"),
        (lambda: operator(accuracy=-0.1), "^accuracy.*from 0"),
        (lambda: operator(accuracy=0.02, method="full_field"), "^accuracy = 0.02: method = full_field takes none"),
        *(
            (lambda weights=weights: operator(pupil_weights=weights), "^pupil_weights")
            for weights in (-np.ones((2, 4, 4)), np.full((2, 4, 4), np.nan), np.full((2, 4, 4), "x"))
        ),
        (lambda: operator(pupil_weights=np.ones((2, 4, 5), bool)), "^pupil_weights of shape"),
        *(
            (lambda weights=weights: coloured().forward(weights), "^weights")
            for weights in (np.ones(3), np.ones((2, 0)), np.ones((2, 1, 1)), [1.0, np.inf], "ab", np.ones((2, 3)))
        ),
        *(
            (lambda shape=shape: coloured().adjoint(np.ones(shape)), "^image of shape")
            for shape in ((8, 8), (256, 256), (256, 256, 3), (256 * 256 * 2,))
        ),
        *(
            (lambda image=image: operator().adjoint(image), "^image")
            for image in (np.full(SMALL.shape, np.nan), "image", [[1.0], [1.0, 2.0]])
        ),
        (lambda: waves(mp.PlenopticCamera(), FAR).forward(np.ones(100)), "^100 points by patches.*GiB"),
        (lambda: derived().derivative([1.0], {"f_number": 1.0}), "f_number.*: it is none of the parameters"),
        (lambda: derived().derivative([1.0], {"mla_offset": 1.0}), "^mla_offset = 1.0: its change must be 2 numbers"),
        (lambda: derived().derivative([1.0], {"focal_length": float("nan")}), "^focal_length"),
        (lambda: derived().derivative([1.0], [1.0]), "^changes = "),
        (lambda: operator(method="full_field").gradient([1.0, 1.0], np.zeros(SMALL.shape)), "full_field: it has no"),
        # Main lenses that do not see the points
        (lambda: refracted((0.0, 0.0, 10.0)), "g = 10: it must lie before the main_lens, beyond"),
        (lambda: refracted(POINT[0], (900.0, 0.0, 240.0)), r"position = \(900, 0, 240\): no light of it passes the"),
        (lambda: pupil_of((0.0, 0.0, 40.0)), "g = 40: it must lie before the main_lens, beyond 56"),
        (lambda: pupil_of((600.0, 0.0, 240.0)), "no light of it passes the main_lens"),
        (lambda: main_lens(SMALL.replace(main_lens=Unknown())), "no function is marked"),
        (
            lambda: waves(IN_THE_STOP, [(0, 0, 0)]),
            "main_lens = .*method patch refuse it: light covers all of the stop's image",
        ),
        (
            lambda: gradient(waves(MICROSCOPE, [(0, 0, 0)])),
            "main_lens = .*derivatives of captures of points refuse it: .*native plane",
        ),
        (lambda: waves(MICROSCOPE, [(0.0, 0.0, -10.0)]), r"position = \(0, 0, -10\): .* g more than -10: before the"),
        # Coherent fields
        (lambda: field([1.0]), r"amplitudes of shape \(1,\): it must be \(12,\)"),
        (lambda: field(np.full(12, np.nan)), "amplitudes: all must be finite"),
        (lambda: field(["a"] * 12), "amplitudes: they must be complex numbers"),
        (lambda: field(plane="mla"), "plane = 'mla'"),
        pytest.param(
            lambda: waves(SMALL, NEAR).field_adjoint(np.ones((2, 2))), r"samples of shape \(2, 2\)", marks=NEEDS_LASER
        ),
        pytest.param(
            lambda: waves(SMALL, np.empty((0, 3))).field_adjoint([[1]]),
            "points: coherent fields need at least one",
            marks=NEEDS_LASER,
        ),
        (lambda: field(wavelength=None, spectrum=mp.Spectrum([500, 600], [[1, 1]])), "spectrum of 2 wavelengths"),
        (lambda: field(wavelength=None, spectrum=mp.Spectrum([500], [[0.5]])), "no channels and no response"),
        (lambda: field(camera=mp.PlenopticCamera.preset("shack_hartmann")), "main_lens = collimator: coherent fields"),
        (lambda: field(method="patch", pupil_weights=np.ones((12, 4, 4))), "pupil_weights: coherent fields take none"),
        pytest.param(
            lambda: field([1], [(0, 0, 120.0)], WIDE), "coherent field of 1 points: it would need", marks=NEEDS_LASER
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
        waves(mp.PlenopticCamera(), [(0, 0, distance)], method=method).forward([1.0])


def test_more_memory_than_allowed_is_refused_with_the_estimate(monkeypatch):
    monkeypatch.setattr("mitsuba_plenoptic.runtime.limits.MEMORY_LIMIT", 2**20)
    operator = waves(SMALL)
    for work in (operator.estimate, lambda: operator.forward([1.0]), lambda: operator.adjoint(np.ones(SMALL.shape))):
        with pytest.raises(mp.InputError, match=r"1 points by patches.*GiB"):
            work()


def forward(operator):
    return operator.forward([1.0])


def derivative(operator):
    return operator.derivative([1.0], {"mla_distance": 1.0})


def gradient(operator):
    return operator.gradient([1.0], np.ones(operator.camera.shape), ["focal_length"])


def coherent(operator):
    return operator.coherent_fields.at([1.0], "detector")


PERIODIC = "patches treat the array as periodic; use CaptureOperator with method full_field"
BETWEEN = {"wavelength": None, "spectrum": mp.Spectrum.band(550, 40, 4).interpolated(2)}
FULL = {"method": "full_field"}
VIGNETTED = {"vignetting": {"radius": [0.8]}}


@pytest.mark.parametrize(
    ("changes", "options", "work", "words"),
    [
        ({"mla_jitter": (0.001, 0)}, {}, forward, f"mla_jitter = .*{PERIODIC}"),
        ({"mla_figure_error": (1e-5, 0.02)}, {}, forward, f"mla_figure_error = .*{PERIODIC}"),
        ({"pixel_response": (0, 1, 20, 0.5)}, {}, derivative, "pixel_response = .*all directions alike"),
        ({"mla_absorption": 1.0}, {}, gradient, "mla_absorption = 1.0: derivatives of captures of points"),
        ({"mla_warp": (0.001,) * 14}, {}, derivative, "mla_warp = .*derivatives of captures of points refuse it"),
        ({"mla_transmissions": TABLE}, {}, derivative, "mla_transmissions = .*leave it out"),
        (VIGNETTED, {}, gradient, "vignetting = .*leave it out"),
        (VIGNETTED, FULL, coherent, "vignetting = .*leave it out"),
        (
            VIGNETTED | {"main_lens": "double_gauss", "focal_length": 80},
            {},
            forward,
            "vignetting = .*thin lenses and objectives alone",
        ),
        ({"pupil_apodisation": (-0.6, 0.2)}, {}, gradient, "pupil_apodisation"),
        ({}, BETWEEN, derivative, r"spectrum: nodes = \(.*\): there are no derivatives between nodes"),
        (
            {"glass": {"index": 1.5, "abbe": 50}},
            {},
            gradient,
            "glass = .*fixed focal lengths; use the camera's at_wavelength",
        ),
        ({"aperture_blades": 5}, {"pupil_weights": np.ones((1, 2, 2))}, forward, "^pupil_weights: points through"),
    ],
)
def test_cameras_that_points_are_not_followed_through(changes, options, work, words):
    with pytest.raises(mp.InputError, match=words):
        work(waves(small_camera(**changes), **options))


@pytest.mark.filterwarnings("ignore:a surface touches")
@pytest.mark.parametrize(
    ("objects", "words"),
    [
        ({"sky": {"type": "constant"}}, "emitter .* is infinitely far"),
        ({"pane": pane(PANES["thindielectric"])}, "surface pane of type ThinDielectric is not matte"),
        ({"pane": pane(PANES["half-open mask"])}, "surface pane of type MaskBSDF is not matte"),
        ({"pane": pane({"type": "roughplastic"})}, "surface pane of type RoughPlastic is not matte"),
        ({"fog": pane({"type": "diffuse"}) | {"type": "cube", "interior": THIN_FOG}}, "surface fog bounds a medium"),
        ({"integrator": {"type": "path", "hide_emitters": True}}, "hide_emitters"),
        ({"camera": sensor(2, 8, medium=THIN_FOG)}, "the sensor is in a medium"),
        ({"camera": sensor(2, 8, shutter_open=0.0, shutter_close=1.0)}, "the shutter is open for 1"),
        ({"camera": MICROSCOPE.to_sensor()}, r"main_lens = 20x/0\.5 objective"),
    ],
)
def test_scenes_that_are_no_matte_surfaces_are_refused_by_name(objects, words):
    wall = facing(240.0, 60.0, **radiating())
    described = {"type": "scene", "integrator": {"type": "path"}, "camera": sensor(2, 8), "wall": wall}
    with pytest.raises(mp.InputError, match=words):
        mp.render_capture(mi.load_dict(described | objects), model="wave", method="points", spp=32)


LAMP = [(0.05, 0.02, 230.0)]


def refocused(camera, method):
    return mp.reconstruct(np.zeros(camera.shape, np.float32), 230.0, camera=camera, method=method, wavelength=550.0)


@pytest.mark.parametrize("changes", [{"aperture_blades": 6}, {"aperture_image": CODE}], ids=["blades", "image"])
@pytest.mark.parametrize(
    "call",
    [
        lambda camera: sky(camera, 1, "wave"),
        lambda camera: sky(camera, 1, "wave", method="points"),
        lambda camera: refocused(camera, "coherent"),
        lambda camera: refocused(camera, "partial"),
        lambda camera: waves(camera, LAMP).coherent_fields,
        lambda camera: waves(camera, LAMP).derivative([1.0], {"focal_length": 1.0}),
    ],
    ids=["waves", "points", "coherent", "partial", "fields", "derivative"],
)
def test_apertures_that_are_not_round_are_refused_by_name(call, changes):
    with pytest.raises(mp.InputError, match=f"^{next(iter(changes))} = .*leave it out$"):
        call(small_camera(4, **changes))


@pytest.mark.parametrize(
    ("changes", "also"), [({"mla_tilt": (0.1, 0)}, []), ({"distortion": (1e-4, 0, 0, 0, 0)}, ["partial"])]
)
def test_arrays_and_lenses_that_calibrations_find(changes, also):
    camera = small_camera(**changes)
    for work in (
        lambda: waves(camera),
        lambda: sky(camera, 1, "wave", method="points"),
        *(lambda method=method: refocused(camera, method) for method in also),
    ):
        with pytest.raises(mp.InputError, match=rf"\A{next(iter(changes))} = .* refuse it: .*leave it out\Z"):
            work()
