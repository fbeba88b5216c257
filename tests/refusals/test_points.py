"""What point spreads, operators over points, their derivatives and coherent fields refuse."""

import functools

import mitsuba as mi
import numpy as np
import pytest
from cameras import CODE, HALF, TABLE, WAVELENGTH, scattered, sky, small_camera
from cases import PANES, THIN_FOG, facing, radiating, sensor

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.lenses.pupil_fit import ExitPupil
from refusals import refused, refuses

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


def pane(bsdf):
    return {"type": "rectangle", "bsdf": bsdf}


def spread(**changes):
    return mp.point_spread_function(**{"camera": small_camera(16), "position": POINT[0], "wavelength": 633} | changes)


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


WEIGHTS = [-np.ones((2, 4, 4)), np.full((2, 4, 4), np.nan), np.full((2, 4, 4), "x"), np.ones((2, 4, 5), bool)]
test_refused = refused(
    *(
        (lambda place=place: spread(position=place), "^position")
        for place in ((0, 0, 0), (0, np.nan, 240), ("a", 0, 240))
    ),
    (lambda: spread(method="fast"), "^method"),
    (lambda: spread(camera=HUGE, method="full_field"), "full field of position.*GiB"),
    (lambda: operator(points=[(0, 0, 240), (0, 0, 0)]), "^position.*g at least"),
    (lambda: operator(wavelength=0), "^wavelength"),
    (lambda: operator(spectrum=mp.Spectrum.lines(633)), "^wavelength, spectrum"),
    (lambda: operator(system=OpticalSystem(small_camera(2), WAVELENGTH)), "another camera"),
    (lambda: operator(accuracy=-0.1), "^accuracy"),
    (lambda: operator(accuracy=0.02, method="full_field"), "^accuracy = 0.02: method = full_field"),
    *((lambda weights=weights: operator(pupil_weights=weights), "^pupil_weights") for weights in WEIGHTS),
    *(
        (lambda weights=weights: coloured().forward(weights), "^weights")
        for weights in (np.ones(3), np.ones((2, 0)), [1.0, np.inf], "ab", np.ones((2, 3)))
    ),
    *((lambda s=s: coloured().adjoint(np.ones(s)), "^image of shape") for s in ((8, 8), (256, 256), (256, 256, 3))),
    *(
        (lambda i=i: operator().adjoint(i), "^image")
        for i in (np.full(SMALL.shape, np.nan), "image", [[1.0], [1.0, 2.0]])
    ),
    (lambda: waves(mp.PlenopticCamera(), FAR).forward(np.ones(100)), "^100 points by patches.*GiB"),
    (lambda: derived().derivative([1.0], {"f_number": 1.0}), "f_number"),
    (lambda: derived().derivative([1.0], {"mla_offset": 1.0}), "^mla_offset = 1.0: .*2"),
    (lambda: derived().derivative([1.0], {"focal_length": float("nan")}), "^focal_length"),
    (lambda: derived().derivative([1.0], [1.0]), "^changes = "),
    (lambda: operator(method="full_field").gradient([1.0, 1.0], np.zeros(SMALL.shape)), "full_field"),
    # Main lenses that do not see the points
    (lambda: refracted((0.0, 0.0, 10.0)), "g = 10"),
    (lambda: refracted(POINT[0], (900.0, 0.0, 240.0)), r"position = \(900, 0, 240\): no light"),
    (lambda: pupil_of((0.0, 0.0, 40.0)), "g = 40: .*56"),
    (lambda: waves(IN_THE_STOP, [(0, 0, 0)]), "main_lens = .*patch refuse it"),
    (lambda: gradient(waves(MICROSCOPE, [(0, 0, 0)])), "main_lens = .*native plane"),
    (lambda: waves(MICROSCOPE, [(0.0, 0.0, -10.0)]), r"position = \(0, 0, -10\): .*-10"),
    # Coherent fields
    (lambda: field([1.0]), r"amplitudes of shape \(1,\)"),
    (lambda: field(np.full(12, np.nan)), "amplitudes: "),
    (lambda: field(plane="mla"), "plane = 'mla'"),
    (lambda: field(wavelength=None, spectrum=mp.Spectrum([500, 600], [[1, 1]])), "spectrum of 2 wavelengths"),
    (lambda: field(wavelength=None, spectrum=mp.Spectrum([500], [[0.5]])), "response"),
    (lambda: field(camera=mp.PlenopticCamera.preset("shack_hartmann")), "main_lens = collimator"),
    (lambda: field(method="patch", pupil_weights=np.ones((12, 4, 4))), "pupil_weights: "),
)


@pytest.mark.needs_extension("laser")
def test_coherent_fields_are_refused_with_what_is_missing():
    refuses(r"samples of shape \(2, 2\)", waves(SMALL, NEAR).field_adjoint, np.ones((2, 2)))
    refuses("points: ", waves(SMALL, np.empty((0, 3))).field_adjoint, [[1]])
    refuses("coherent field of 1 points: it would need", field, [1], [(0, 0, 120.0)], WIDE)


@pytest.mark.parametrize("method", ["patch", "full_field"])
def test_points_in_metres_are_recognised(method):
    points = lambda: waves(mp.PlenopticCamera(), [(0, 0, 0.24)], method=method).forward([1.0])  # noqa: E731
    refuses(r"position = \(0, 0, .*\): .* metres", points)


def test_more_memory_than_allowed_is_refused_with_the_estimate(monkeypatch):
    monkeypatch.setattr("mitsuba_plenoptic.runtime.limits.MEMORY_LIMIT", 2**20)
    operator = waves(SMALL)
    for work in (operator.estimate, lambda: operator.forward([1.0]), lambda: operator.adjoint(np.ones(SMALL.shape))):
        refuses("1 points by patches.*GiB", work)


def forward(operator):
    return operator.forward([1.0])


def derivative(operator):
    return operator.derivative([1.0], {"mla_distance": 1.0})


def gradient(operator):
    return operator.gradient([1.0], np.ones(operator.camera.shape), ["focal_length"])


def coherent(operator):
    return operator.coherent_fields.at([1.0], "detector")


BETWEEN = {"wavelength": None, "spectrum": mp.Spectrum.band(550, 40, 4).interpolated(2)}
PUPIL = {"pupil_weights": np.ones((1, 2, 2))}
VIGNETTED = {"vignetting": {"radius": [0.8]}}
REAL = {"main_lens": "double_gauss", "focal_length": 80}


@pytest.mark.parametrize(
    ("changes", "options", "work", "words"),
    [
        ({"mla_jitter": (0.001, 0)}, {}, forward, "mla_jitter = .*full_field"),
        ({"pixel_response": (0, 1, 20, 0.5)}, {}, derivative, "pixel_response = "),
        ({"mla_absorption": 1.0}, {}, gradient, "mla_absorption = 1.0: "),
        ({"mla_transmissions": TABLE}, {}, derivative, "mla_transmissions = "),
        (VIGNETTED, {"method": "full_field"}, coherent, "vignetting = "),
        (VIGNETTED | REAL, {}, forward, "vignetting = .*thin lenses"),
        ({}, BETWEEN, derivative, "spectrum: nodes = "),
        ({"glass": {"index": 1.5, "abbe": 50}}, {}, gradient, "glass = .*at_wavelength"),
        ({"aperture_blades": 5}, PUPIL, forward, "^pupil_weights: "),
    ],
)
def test_cameras_that_points_are_not_followed_through(changes, options, work, words):
    refuses(words, lambda: work(waves(small_camera(**changes), **options)))


@pytest.mark.filterwarnings("ignore:a surface touches")
@pytest.mark.parametrize(
    ("objects", "words"),
    [
        ({"sky": {"type": "constant"}}, "emitter .* infinitely far"),
        ({"pane": pane(PANES["half-open mask"])}, "pane of type MaskBSDF"),
        ({"pane": pane({"type": "roughplastic"})}, "pane of type RoughPlastic"),
        ({"fog": pane({"type": "diffuse"}) | {"type": "cube", "interior": THIN_FOG}}, "surface fog"),
        ({"integrator": {"type": "path", "hide_emitters": True}}, "hide_emitters"),
        ({"camera": sensor(2, 8, medium=THIN_FOG)}, "sensor is in a medium"),
        ({"camera": sensor(2, 8, shutter_open=0.0, shutter_close=1.0)}, "shutter is open for 1"),
        ({"camera": MICROSCOPE.to_sensor()}, r"main_lens = 20x/0\.5 objective"),
    ],
)
def test_scenes_that_are_no_matte_surfaces_are_refused_by_name(objects, words):
    wall = facing(240.0, 60.0, **radiating())
    described = {"type": "scene", "integrator": {"type": "path"}, "camera": sensor(2, 8), "wall": wall}
    refuses(words, mp.render_capture, mi.load_dict(described | objects), model="wave", method="points", spp=32)


def refocused(camera, method):
    return mp.reconstruct(np.zeros(camera.shape, np.float32), 230.0, camera=camera, method=method, wavelength=550.0)


USES = {
    "waves": lambda camera: sky(camera, 1, "wave"),
    "points": lambda camera: sky(camera, 1, "wave", method="points"),
    "patches": waves,
    "partial": lambda camera: refocused(camera, "partial"),
    "fields": lambda camera: waves(camera).coherent_fields,
    "derivative": lambda camera: derivative(waves(camera)),
}


@pytest.mark.parametrize(
    ("changes", "uses"),
    [
        ({"aperture_image": CODE}, "waves points partial fields derivative"),
        ({"mla_tilt": (0.1, 0)}, "patches points"),
        ({"distortion": (1e-4, 0, 0, 0, 0)}, "patches points partial"),
    ],
)
def test_apertures_arrays_and_lenses_are_refused_by_name(changes, uses):
    camera = small_camera(4, **changes)
    for use in uses.split():
        refuses(rf"\A{next(iter(changes))} = .*leave it out\Z", USES[use], camera)
