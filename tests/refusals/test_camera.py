"""Cameras that cannot be."""

import json
import math
import re

import numpy as np
import pytest
from cameras import write_scene

from mitsuba_plenoptic import Objective, PlenopticCamera, load_scene
from refusals import refuses
from tools.bench.cases.arrays import SHAPES, X, Y, bumpy

AIR = Objective(20, 0.5)
FOURIER = Objective(20, 0.5, arrangement="fourier", fourier_focal_length=100)
HEXAGONAL = {"mla_lattice": "hexagonal"}

THIN = [
    ({"focus_distance": 80}, "focus_distance = 80: .*80"),
    ({"focus_distance": 240, "mla_distance": 120}, "give one of the two"),
    ({"resolution": (0, 5)}, "resolution = 0: "),
    ({"crop_offset": (4000, 0), "crop_size": (100, 100)}, "window"),
    ({"lens_model": "thick"}, "lens_model = 'thick': .*parabolic"),
    ({"mla_absorption": -1.0}, "mla_absorption = -1: "),
    ({"mla_figure_error": (1e-5, 0.0)}, "mla_figure_error.*0"),
    ({"mla_tilt": (6, 0)}, "mla_tilt"),
    ({"mla_tilt": (5, 0), "detector_distance": 0.1}, "mla_tilt.*touches"),
    ({"distortion": (-1, 0, 0, 0, 0)}, "distortion.*folds"),
    ({"distortion": (1, 2)}, "distortion = .*5"),
    ({"mla_lattice": "round"}, "mla_lattice = 'round': "),
    ({"mla_fill": 0.0}, "mla_fill = 0: "),
    ({"mla_offset": 3}, "mla_offset = 3: "),
    ({"mla_focal_length": (0.5, 0.6, 0.7)}, "mla_focal_length.*mla_lattice = hexagonal"),
    ({"mla_focal_length": (0.5, 0.6), **HEXAGONAL}, "mla_focal_length.* 3"),
    ({"mla_pitch": (0.06, 0.06, 0.06)}, "mla_pitch = .*two"),
    ({"mla_pitch": (0.06, 0.61)}, r"mla_pitch = \(0.06, 0.61\): .*10"),
    *(({"wavefront": value}, "^wavefront") for value in (0.5, [math.nan], [1.0] * 67, [1e4])),
    ({"aperture_blades": 2}, "^aperture_blades = 2: "),
    ({"aperture_blades": (6, 1, 2)}, r"^aperture_blades = \(6, 1, 2\): "),
    ({"aperture_image": np.zeros((4, 4))}, "^aperture_image: transmission: .*0"),
    ({"aperture_image": [[-0.5]]}, r"^aperture_image: transmission\[0, 0\] = -0.5: "),
    ({"aperture_image": np.ones((4, 5))}, r"^aperture_image: transmission of shape \(4, 5\): "),
    ({"aperture_image": np.ones((8, 8))}, "^aperture_image: transmission: 12 open cells"),
    ({"aperture_image": [[1]], "aperture_blades": 6}, "^aperture_blades, aperture_image: "),
    ({"aperture_blades": 6, "main_lens": "tessar", "mla_distance": 55.0}, "^aperture_blades = 6: a main_lens"),
    ({"pupil_apodisation": (0, 5)}, "pupil_apodisation = 5: "),
    (
        {"pupil_apodisation": (-0.2, 0), "main_lens": FOURIER, "mla_focal_length": 40, "mla_pitch": 1,
         "detector_width": 8},
        r"pupil_apodisation = \(-0.2, 0.0\): .*stop",
    ),
    ({"vignetting": {"radius": [1, 0]}}, "radius = .*6"),
    ({"vignetting": {"scale": 1}}, "radius is missing"),
    ({"mla_jitter": (0.01, 0)}, "mla_jitter = 0.01: "),
    ({"mla_jitter": (0, 0.2)}, "mla_jitter = 0.2: "),
    ({"pixel_response": (0, 1, 10)}, "pixel_response.*pairs"),
    ({"pixel_response": (5, 1, 10, 0.5)}, "pixel_response.*angles"),
    ({"mla_warp": [0.0] * 15}, "mla_warp.*14.* 36"),
    ({"mla_warp": [0, 0, 0, 0, 0, 0, 4e-4], "mla_pitch": 0.05}, "mla_warp.* 0.0275 mm"),
    ({"mla_transmissions": [[5.0]]}, "mla_transmissions: .*values.0, 0. = 5: "),
    ({"mla_transmissions": {"values": [[1]], "first": [0.5, 0]}}, "mla_transmissions: .*first = 0.5: "),
    ({"stray_light": 1.5}, "^stray_light = 1.5: "),
    ({"stray_light": [[0.1, 1.5]]}, r"^stray_light: values\[0, 1\] = 1.5: "),
    ({"stray_light": "absent.npy"}, "^stray_light: absent.npy: "),
    ({"glass": 1.0}, "glass: .* 1"),
    ({"glass": "window"}, "glass = 'window'"),
    ({"mla_glass": {"index": 1.5, "abbe": 0}}, "glass: abbe = 0"),
    ({"mla_glass": {"table": [[400, 1.5], [500, 1.4]]}}, "mla_glass: .*wavelength = 587.562 nm"),
    ({"glass": {"index": 1.5168, "abbe": 64.17}, "main_lens": "singlet"}, "glass = .*: a main_lens"),
]  # fmt: skip

SAMPLED = {"form": "sampled", "height": bumpy(X, Y).tolist(), "width": 0.05}
PHASES = {"form": "phase_map", "phase": X.tolist(), "width": 0.066, "wavelengths": [600, 500]}
MICROLENSES = [
    ({"mla_shape": {"form": "cone"}}, "mla_shape: form = 'cone'"),
    ({"mla_shape": {"form": "conic", "curvature_radius": 0.2, "conc": 1}}, "mla_shape.*conic"),
    ({"mla_shape": {"form": "conic", "curvature_radius": 0.2, "glass": 1.0}}, "mla_shape.*index.* 1"),
    ({"mla_shape": {"form": "sampled", "height": [[0, 1], [1, 0]], "width": 0.064}}, "mla_shape: height of shape"),
    ({"mla_shape": SAMPLED | {"height": (-bumpy(X, Y)).tolist(), "width": 0.066}}, "mla_shape.*focus"),
    ({"mla_shape": SAMPLED}, "mla_shape.*all over"),
    ({"mla_shape": PHASES}, "mla_shape.*rise"),
    ({"mla_shape": "lens.json"}, "mla_shape: lens.json"),
    ({"mla_shape": SHAPES["sphere"], "mla_focal_length": 0.4}, "mla_focal_length = .0.4.*mla_shape"),
    ({"mla_shape": SHAPES["sphere"], "mla_glass": 1.5}, "mla_glass: an mla_shape"),
]


def microscope(**changes):
    """Describe a camera behind an objective with some values changed."""
    return {"main_lens": AIR.to_plain() | changes}


def stopped(**changes):
    """Describe a camera in the Fourier arrangement, with four lenses around the axis, with some values changed."""
    lens = {"main_lens": FOURIER.to_plain() | changes}
    return lens | {"mla_pitch": 0.5, "mla_focal_length": 20, "detector_width": 4, "resolution": (1000, 1000)}


OBJECTIVES = [
    (microscope(numerical_aperture=1.0), "numerical_aperture = 1: .* 1"),
    (microscope(magnification=4), "magnification = 4: .*0.1"),
    (microscope(arrangement="fourier"), "fourier_focal_length: it is missing"),
    (microscope(fourier_focal_length=50), "fourier_focal_length = 50: "),
    (microscope(working_distance=2), "main_lens: working_distance: "),
    (
        {"main_lens": FOURIER, "mla_pitch": 0.01, "detector_width": 4, "resolution": (1000, 1000)},
        "mla_pitch = 0.01: .*three",
    ),
    (stopped(field_stop=0.0), "field_stop = 0: "),
    (stopped(field_stop=math.inf), "field_stop = inf: "),
    (stopped(field_stop=0.009), "field_stop = 0.009: .*0.01"),
    (stopped(field_stop_shape="round"), "field_stop_shape = 'round': "),
    (stopped(numerical_aperture=0.02) | {"mla_aperture": "circle", "mla_fill": 0.5}, "mla_pitch = 0.5: .*0.2 mm"),
    (stopped() | {"mla_tilt": (1, 0)}, r"mla_tilt = \(1.0, 0.0\): .*upright"),
    ({"main_lens": AIR, "focal_length": 12}, "focal_length = 12: .*main_lens .*10"),
    ({"main_lens": AIR, "focus_distance": 10}, "focus_distance = 10: "),
    ({"main_lens": AIR, "wavefront": (0, 0, 0, 0.1)}, "wavefront.*main_lens"),
]


def singlet(glass=1.5, radii=(50.0, -70.0), thickness=4.0, **changes):
    """Describe a camera behind one lens of two surfaces with some values changed."""
    first = {"radius": radii[0], "thickness": thickness, "glass": glass, "semi_aperture": 10, "stop": True}
    return {"main_lens": {"surfaces": [first | changes, {"radius": radii[1], "semi_aperture": 10}]}}


GAUSS = {"main_lens": "double_gauss", "focal_length": 80}

PRESCRIPTIONS = [
    ({"main_lens": {}}, "main_lens = {}: .*surfaces"),
    (singlet(radius=0), "main_lens: surface 1: radius = 0: "),
    (singlet(semi_aperture=60), "semi_aperture = 60: .*50"),
    (singlet(stop=False), "main_lens: 0 surfaces have stop"),
    (singlet(colour=1), "main_lens: surface 1: colour: "),
    (singlet({"abbe": 50}), "glass.*index and abbe"),
    (singlet({"sellmeier": [1, 2]}), r"glass: sellmeier = \(1.0, 2.0\): .*6"),
    (singlet({"table": [[600, 1.5], [700, 1.49]]}), "glass.*600 to 700 nm"),
    pytest.param(singlet("no such glass"), "main_lens: surface 1: glass = 'no such glass': ", marks=pytest.mark.slow),
    (singlet(thickness=0.01), "surfaces 1 and 2 cross 0.76"),
    (singlet(radii=(-50.0, 50.0)), "main_lens: .*focal length is -"),
    ({"main_lens": "triplet"}, "main_lens.*cooke_triplet"),
    (GAUSS | {"aperture_radius": 20}, "aperture_radius = 20: .*13.3"),
    (GAUSS | {"mla_distance": 20}, "mla_distance = 20: "),
    (GAUSS | {"distortion": (0.001, 0, 0, 0, 0)}, "distortion.*main_lens"),
]


@pytest.mark.parametrize(("parameters", "words"), [*THIN, *MICROLENSES, *OBJECTIVES, *PRESCRIPTIONS])
def test_impossible_cameras_are_refused_in_one_line(parameters, words):
    refuses(words, PlenopticCamera, **parameters)


SHEET = {
    "f_number": 2.8, "lenses": 100, "pixels_per_lens": 10, "pixel_size": 0.005, "focal_length": 50.0,
    "focus_distance": 320.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"f_number": None}, "^f_number: missing"),
        ({"lenses": None}, "^lenses, resolution or sensor_size: missing"),
        ({"pixels_per_lens": None}, "^pixels_per_lens or mla_pitch: missing"),
        ({"focus_distance": None}, "^focus_distance or mla_distance: missing"),
        ({"aperture_radius": 5}, "^aperture_radius = 5: "),
        ({"resolution": (8, 8)}, "^lenses, resolution: "),
        ({"lenses": None, "resolution": 64, "sensor_size": 1}, "^resolution, sensor_size, pixel_size: "),
        (
            {"lenses": None, "pixel_size": None, "resolution": (64, 48), "sensor_size": (0.64, 0.5)},
            r"^sensor_size = \(0.64, 0.5\): ",
        ),
        (
            {"lenses": None, "sensor_size": (0.001, 1), "pixel_size": 0.0055},
            r"^sensor_size = \(0.001, 1\) with pixel_size = 0.0055: ",
        ),
        ({"pixels_per_lens": None, "mla_pitch": 20}, "^mla_pitch = 20: .*17.86 mm"),
        ({"f_number": -1}, "^f_number = -1: "),
        ({"lenses": 200_000}, "^lenses = 200000: .*2000000"),
        ({"main_lens": "double_gauss"}, "^f_number = 2.8: aperture_radius = "),
    ],
)
def test_too_few_and_contradictory_numbers_of_a_data_sheet_are_named(changes, words):
    refuses(words, PlenopticCamera.matched, **SHEET | changes)


def test_a_misspelt_number_of_a_data_sheet_is_answered_with_the_one_that_it_resembles():
    sheet = {name: value for name, value in SHEET.items() if name != "f_number"}
    with pytest.raises(TypeError, match=r"f_numbr.*f_number"):
        PlenopticCamera.matched(**sheet, f_numbr=2.8)


def test_names_of_elsewhere_are_answered_with_the_parameter(tmp_path, complaint):
    words = "pixel_pitch.*; detector_width is pixel_pitch"
    given = {"pixel_pitch": 2}
    with pytest.raises(TypeError, match=words):
        PlenopticCamera(**given)
    refuses(words, PlenopticCamera.from_json, json.dumps(given))
    refuses(words, PlenopticCamera().replace, **given)
    refuses(words, load_scene, "letters", variant="llvm_ad_mono", parameters=given)
    refuses(words, load_scene, write_scene(tmp_path, sensor='<float name="pixel_pitch" value="2"/>'))
    assert re.search(words, complaint("info", "pixel_pitch=2"))


@pytest.mark.parametrize(
    ("place", "rule"),
    [("x", "4 x 4"), (np.diag([1, 1, math.nan, 1]), "finite"), (np.eye(4) + 0.1 * np.eye(4, k=1), "rotation")],
)
def test_places_of_a_camera_that_a_scene_would_refuse(place, rule):
    refuses(f"^to_world.*: .*{rule}", PlenopticCamera().to_xml, place)
