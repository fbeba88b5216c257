"""What points, their operators, derivatives and coherent fields, free space and spectra refuse."""

import functools

import mitsuba as mi
import numpy as np
import pytest
from cameras import CAMERAS, HALF, WAVELENGTH, scattered, small_camera
from cases import PANES, THIN_FOG, facing, radiating, sensor

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import PlenopticCamera, Spectrum
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.lenses.pupil_fit import ExitPupil
from mitsuba_plenoptic.optics.waves import propagate
from refusals import refused, refuses

SMALL = small_camera()
POINT = [(0.0, 0.0, 240.0)]
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


BETWEEN = {"wavelength": None, "spectrum": mp.Spectrum.band(550, 40, 4).interpolated(2)}
VIGNETTED = {"vignetting": {"radius": [0.8]}, "main_lens": "double_gauss", "focal_length": 80}
WEIGHTS = [-np.ones((2, 4, 4)), np.full((2, 4, 4), np.nan), np.full((2, 4, 4), "x"), np.ones((2, 4, 5), bool)]
test_refused = refused(
    *((lambda place=place: spread(position=place), "^position") for place in ((0, np.nan, 240), ("a", 0, 240))),
    (lambda: waves(mp.PlenopticCamera(), [(0, 0, 0.24)]), r"position = \(0, 0, .*\): .* metres"),
    (lambda: spread(method="fast"), "^method"),
    (lambda: spread(camera=HUGE, method="full_field"), "full field of position.*GiB"),
    (lambda: operator().jacobian([1.0, 1.0], []), "^directions: "),
    (lambda: operator(points=[(0, 0, 240), (0, 0, 0)]), "^position.*g at least"),
    (lambda: operator(wavelength=0), "^wavelength"),
    (lambda: operator(spectrum=mp.Spectrum.lines(633)), "^wavelength, spectrum"),
    (lambda: operator(system=OpticalSystem(small_camera(2), WAVELENGTH)), "another camera"),
    (lambda: operator(accuracy=-0.1), "^accuracy"),
    (lambda: operator(accuracy=0.02, method="full_field"), "^accuracy = 0.02: method = full_field"),
    *((lambda weights=weights: operator(pupil_weights=weights), "^pupil_weights") for weights in WEIGHTS),
    *(
        (lambda weights=weights: coloured().forward(weights), "^weights")
        for weights in (np.ones(3), np.ones((2, 0)), [1.0, np.inf], "ab")
    ),
    *((lambda s=s: coloured().adjoint(np.ones(s)), "^image of shape") for s in ((8, 8), (256, 256))),
    (lambda: operator().adjoint([[1.0], [1.0, 2.0]]), "^image"),
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
    (lambda: waves(CAMERAS["microscope"], [(0.0, 0.0, -10.0)]), r"position = \(0, 0, -10\): .*-10"),
    (lambda: waves(small_camera(**VIGNETTED)).forward([1.0]), "vignetting = .*thin lenses"),
    (lambda: waves(SMALL, **BETWEEN).derivative([1.0], {"mla_distance": 1.0}), "spectrum: nodes = "),
    (lambda: waves(small_camera(aperture_blades=5), pupil_weights=np.ones((1, 2, 2))).forward([1.0]), "^pupil_weights"),
    # Coherent fields
    (lambda: field([1.0]), r"amplitudes of shape \(1,\)"),
    (lambda: field(np.full(12, np.nan)), r"amplitudes\[0\] = nan.*: "),
    pytest.param(lambda: field(plane="mla"), "plane = 'mla'", marks=pytest.mark.needs_extension("laser")),
    (lambda: field(wavelength=None, spectrum=mp.Spectrum([500, 600], [[1, 1]])), "spectrum of 2 wavelengths"),
    (lambda: field(wavelength=None, spectrum=mp.Spectrum([500], [[0.5]])), "response"),
    (lambda: field(method="patch", pupil_weights=np.ones((12, 4, 4))), "pupil_weights: "),
)


@pytest.mark.needs_extension("laser")
def test_coherent_fields_are_refused_with_what_is_missing():
    refuses(r"samples of shape \(2, 2\)", waves(SMALL, NEAR).field_adjoint, np.ones((2, 2)))
    refuses("points: ", waves(SMALL, np.empty((0, 3))).field_adjoint, [[1]])
    refuses("coherent field of 1 points: it would need", field, [1], [(0, 0, 120.0)], WIDE)


def test_more_memory_than_allowed_is_refused_with_the_estimate(monkeypatch):
    monkeypatch.setattr("mitsuba_plenoptic.runtime.limits.MEMORY_LIMIT", 2**20)
    operator = waves(SMALL)
    for work in (operator.estimate, lambda: operator.forward([1.0]), lambda: operator.adjoint(np.ones(SMALL.shape))):
        refuses("1 points by patches.*GiB", work)


@pytest.mark.filterwarnings("ignore:a surface touches")
@pytest.mark.parametrize(("objects", "words"), [
    ({"sky": {"type": "constant"}}, "emitter .* infinitely far"),
    ({"pane": pane(PANES["half-open mask"])}, "pane of type MaskBSDF"),
    ({"fog": pane({"type": "diffuse"}) | {"type": "cube", "interior": THIN_FOG}}, "surface fog"),
    ({"integrator": {"type": "path", "hide_emitters": True}}, "hide_emitters"),
    ({"camera": sensor(2, 8, medium=THIN_FOG)}, "sensor is in a medium"),
    ({"camera": sensor(2, 8, shutter_open=0.0, shutter_close=1.0)}, "shutter is open for 1"),
])  # fmt: skip
def test_scenes_that_are_no_matte_surfaces_are_refused_by_name(objects, words):
    wall = facing(240.0, 60.0, **radiating())
    described = {"type": "scene", "integrator": {"type": "path"}, "camera": sensor(2, 8), "wall": wall}
    refuses(words, mp.render_capture, mi.load_dict(described | objects), model="wave", method="points", spp=32)


TABLE = np.arange(400.0, 700, 0.2), np.random.default_rng(0).random(1500)


def propagated(**changes):
    return propagate(**{"field": np.ones((4, 4)), "pitch": 1e-3, "distance": 1.0, "wavelength": 633.0} | changes)


def bell(places):
    """Responses of two channels."""
    return np.stack([np.exp(-(((places - middle) / 40) ** 2)) for middle in (540, 610)])


test_spectra_are_refused = refused(
    (lambda: propagated(field=np.zeros(5)), "^field"),
    (lambda: propagated(pitch=0.0), "^pitch"),
    (lambda: Spectrum((), ()), "^spectrum: it must have a wavelength"),
    (lambda: Spectrum((633.0, 532.0), ((1.0,),)), r"^spectrum: responses of shape \(1, 1\)"),
    (lambda: PlenopticCamera().lenslet(0, [1, 2]), r"^j = \[1, 2\]: "),
    (lambda: Spectrum.smooth(bell, 400, 700, 31, [TABLE]), "1024 wavelengths"),
)


@pytest.mark.parametrize(("given", "words"), [
    (5320, "wavelength = 5320: .*angstroms, 532 nm"),
    (0.633, "wavelength = 0.633: .*micrometres, 633 nm"),
    (633e-9, "wavelength = 6.33e-07: .*metres, 633 nm"),
    (150, "wavelength = 150: .*200 to 2500 nm"),
    ("633", "wavelength = '633'"),
])  # fmt: skip
def test_wavelengths_in_other_units(given, words):
    refuses(words, Spectrum, (given,), ((1.0,),))
    refuses(words, spread, wavelength=given)
