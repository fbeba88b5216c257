"""Cameras that cannot be."""

import json
import math
import re

import numpy as np
import pytest

from mitsuba_plenoptic import InputError, Objective, PlenopticCamera, load_scene
from refusals import refuses
from tools.bench.cases.arrays import SHAPES, X, Y, bumpy

AIR = Objective(20, 0.5)
FOURIER = Objective(20, 0.5, arrangement="fourier", fourier_focal_length=100)

NUMBERS = [
    ({"focal_length": -1}, "focal_length = -1: it must be greater than 0"),
    ({"focal_length": math.nan}, "focal_length = nan: it must be finite"),
    ({"mla_pitch": "wide"}, "mla_pitch = 'wide': it must be a number"),
    ({"detector_width": True}, "detector_width = True: it must be a number"),
    ({"mla_distance": math.inf}, "mla_distance = inf: it must be finite"),
    ({"mla_distance": 0}, "mla_distance = 0: it must be greater than 0"),
    ({"focus_distance": 80}, "focus_distance = 80: it must be greater than the focal length 80"),
    ({"resolution": (0, 5)}, "resolution = 0: it must be at least 1"),
    ({"resolution": 4096}, "resolution = 4096: it must be a pair"),
    ({"resolution": (10.5, 3)}, "resolution = 10.5: it must be a whole number"),
    ({"crop_offset": (4000, 0), "crop_size": (100, 100)}, "the window must lie within"),
    ({"lens_model": "thick"}, "lens_model = 'thick': it must be one of ideal, parabolic"),
    ({"mla_absorption": -1.0}, "mla_absorption = -1"),
    ({"mla_figure_error": (1e-5, 0.0)}, "correlation length must be greater than 0"),
    ({"mla_tilt": (6, 0)}, "mla_tilt"),
    ({"mla_tilt": (5, 0), "detector_distance": 0.1}, "touches"),
    ({"mla_tilt": 1}, "2 numbers"),
    ({"distortion": (-1, 0, 0, 0, 0)}, "folds"),
    ({"distortion": (1, 2)}, "5 numbers"),
]

LATTICES = [
    ({"mla_lattice": "round"}, "mla_lattice = 'round': it must be one of hexagonal, square"),
    ({"mla_aperture": 3}, "mla_aperture = 3: it must be one of cell, circle"),
    ({"mla_fill": 1.5}, "mla_fill = 1.5: it must be at most 1"),
    ({"mla_fill": 0.0}, "mla_fill = 0: it must be greater than 0"),
    ({"mla_rotation": math.inf}, "mla_rotation = inf: it must be finite"),
    ({"mla_offset": 3}, r"mla_offset = 3: it must be a pair \(x, y\)"),
    ({"mla_offset": (1, math.nan)}, "mla_offset = nan: it must be finite"),
    ({"mla_focal_length": (0.5, 0.6, 0.7)}, "several need mla_lattice = hexagonal"),
    ({"mla_focal_length": (0.5, 0.6), "mla_lattice": "hexagonal"}, "it must be one number or 3"),
    ({"mla_focal_length": (0.5, 0.6, -1), "mla_lattice": "hexagonal"}, "mla_focal_length = -1"),
    ({"mla_focal_length": "wide"}, "mla_focal_length = 'wide': it must be a number"),
    ({"mla_pitch": (0.06, -1)}, "mla_pitch = -1: it must be greater than 0"),
    ({"mla_pitch": (0.06, 0.06, 0.06)}, "it must be one number, or two, along the rows and across them"),
    ({"mla_pitch": (0.06, 0.61)}, r"mla_pitch = \(0.06, 0.61\): neither may be more than 10 times the other"),
]

PUPILS = [
    *(({"wavefront": value}, "^wavefront") for value in (0.5, [math.nan], [1.0] * 67, [1e4])),
    ({"aperture_blades": 2}, "^aperture_blades = 2: it must be at least 3"),
    ({"aperture_blades": 65}, "^aperture_blades = 65: it must be at most 64"),
    ({"aperture_blades": 6.5}, "^aperture_blades = 6.5: it must be a whole number"),
    ({"aperture_blades": (6, 1, 2)}, r"^aperture_blades = \(6, 1, 2\): it must be a number of blades"),
    ({"aperture_image": []}, r"^aperture_image: transmission of shape \(0,\): it must be rows"),
    ({"aperture_image": np.zeros((4, 4))}, "^aperture_image: transmission: it is 0 everywhere"),
    ({"aperture_image": [[-0.5]]}, r"^aperture_image: transmission\[0, 0\] = -0.5: it must be from 0 to 1"),
    ({"aperture_image": np.ones((4, 5))}, r"^aperture_image: transmission of shape \(4, 5\): it must"),
    ({"aperture_image": np.ones((8, 8))}, "^aperture_image: transmission: 12 open cells are beyond a"),
    ({"aperture_image": "nowhere.png"}, "^aperture_image: nowhere.png: there is no such file"),
    ({"aperture_image": [[1]], "aperture_blades": 6}, "^aperture_blades, aperture_image: give one of them"),
    ({"aperture_blades": 6, "main_lens": "tessar", "mla_distance": 55.0}, "^aperture_blades = 6: a main_lens has a"),
    ({"pupil_apodisation": (0, 5)}, "pupil_apodisation = 5: it must be at most 4"),
    ({"pupil_apodisation": (-0.2, 0), "aperture_blades": 5}, "aperture_blades, pupil_apodisation: give one of them"),
    (
        {"pupil_apodisation": (-0.2, 0), "main_lens": FOURIER, "mla_focal_length": 40, "mla_pitch": 1,
         "detector_width": 8},
        r"pupil_apodisation = \(-0.2, 0.0\): .* image of the stop",
    ),
    ({"vignetting": {"radius": [1, 0]}}, "radius = .*: it has 1, 3, 6, 10, 15 coefficients"),
    ({"vignetting": {"radius": [1], "slope_x": [np.nan]}}, "slope_x"),
    ({"vignetting": {"radius": [1], "scale": 0}}, "scale"),
    ({"vignetting": {"radius": [1], "slope": [0]}}, "slope"),
    ({"vignetting": {"scale": 1}}, "radius is missing"),
    ({"vignetting": 3}, "vignetting: 3: it must be a dictionary or a JSON file"),
]  # fmt: skip

IRREGULAR = [
    ({"mla_jitter": (0.01, 0)}, "mla_jitter = 0.01"),
    ({"mla_jitter": (0, 0.2)}, "mla_jitter = 0.2"),
    ({"mla_jitter": (-0.001, 0)}, "mla_jitter = -0.001"),
    ({"mla_jitter": 0.1}, "mla_jitter = 0.1: it must be 2 numbers"),
    ({"mla_seed": -1}, "mla_seed = -1"),
    ({"pixel_response": (0, 1, 10)}, "two or more pairs"),
    ({"pixel_response": (5, 1, 10, 0.5)}, "its angles must rise from 0"),
    ({"pixel_response": (0, 1, 10, 1.5)}, "its responses must be from 0 to 1"),
    ({"mla_warp": 3.0}, "mla_warp = 3.0: it must be at most 14 numbers"),
    ({"mla_warp": [0.0] * 15}, "it must be at most 14 numbers, or 36"),
    ({"mla_warp": [math.nan]}, "mla_warp = nan: it must be finite"),
    ({"mla_warp": ["a"]}, "mla_warp = 'a': it must be a number"),
    (
        {"mla_warp": [2e-3]},
        "displacement is up to 0.0336 mm over the detector: it must be less than half a pitch",
    ),
    ({"mla_warp": [0, 0, 0, 0, 0, 0, 4e-4], "mla_pitch": 0.05}, "displacement is up to 0.0275 mm"),
    ({"mla_transmissions": [[5.0]]}, "mla_transmissions: .*values.0, 0. = 5: it must be from 0 to 4"),
    ({"stray_light": 1.5}, "^stray_light = 1.5: it must be at most 1"),
    ({"stray_light": None}, "^stray_light = None: it must be a number"),
    ({"stray_light": [[0.1, 1.5]]}, r"^stray_light: values\[0, 1\] = 1.5: it must be from 0 to 1"),
    ({"stray_light": [[0.1, True]]}, "^stray_light: values = True: it must be a number"),
    ({"stray_light": [[0.1], [0.1, 0.2]]}, "^stray_light: values: it must be rows of numbers"),
    ({"stray_light": [0.1, 0.2]}, r"^stray_light: values of shape \(2,\): it must be rows of as many columns"),
    ({"stray_light": [[0.1] * 300]}, r"^stray_light: values of shape \(1, 300\): it must have 1 to 256 rows"),
    ({"stray_light": "absent.npy"}, "^stray_light: absent.npy: there is no such file"),
    ({"mla_transmissions": [1.0, 1.0]}, r"mla_transmissions: .*values of shape \(2,\)"),
    ({"mla_transmissions": {"values": [[1]], "last": [0, 0]}}, "mla_transmissions: .*last"),
    ({"mla_transmissions": {"first": [0, 0]}}, "mla_transmissions: .*values is missing"),
    (
        {"mla_transmissions": {"values": [[1]], "first": [0.5, 0]}},
        "mla_transmissions: .*first = 0.5: it must",
    ),
    ({"mla_transmissions": [[1.0]], "mla_lattice": "none"}, "no microlens array"),
]

GLASSES = [
    ({"glass": 1.0}, "glass: glass index: its index is 1"),
    ({"glass": "window"}, "glass = 'window'"),
    ({"mla_glass": {"index": 1.5, "abbe": 0}}, "glass: abbe = 0"),
    ({"mla_glass": {"table": [[400, 1.5], [500, 1.4]]}}, "mla_glass: glass table: wavelength = 587.562 nm"),
    ({"glass": {"index": 1.5168, "abbe": 64.17}, "main_lens": "singlet"}, "glass = .*: a main_lens brings its own"),
]

MICROLENSES = [
    ({"mla_shape": {"form": "cone"}}, "mla_shape: form = 'cone'"),
    ({"mla_shape": {"form": "conic"}}, "mla_shape: form conic: curvature_radius is missing"),
    ({"mla_shape": {"form": "conic", "curvature_radius": 0.2, "conc": 1}}, "did you mean conic"),
    ({"mla_shape": {"form": "conic", "curvature_radius": -0.2}}, "mla_shape: curvature_radius = -0.2"),
    ({"mla_shape": {"form": "conic", "curvature_radius": 0.03}}, "mla_shape: it must be defined all over a lens's"),
    ({"mla_shape": {"form": "conic", "curvature_radius": 0.2, "glass": 1.0}}, "its index must be greater than 1"),
    ({"mla_shape": {"form": "sampled", "height": [[0, 1], [1, 0]], "width": 0.064}}, "mla_shape: height of shape"),
    ({"mla_shape": {"form": "sampled", "height": (-bumpy(X, Y)).tolist(), "width": 0.066}}, "it must focus light"),
    ({"mla_shape": {"form": "sampled", "height": bumpy(X, Y).tolist(), "width": 0.05}}, "all over a lens's aperture"),
    ({"mla_shape": {"form": "phase_map", "phase": "lens.txt", "width": 0.066}}, "mla_shape: lens.txt"),
    (
        {"mla_shape": {"form": "phase_map", "phase": X.tolist(), "width": 0.066, "wavelengths": [600, 500]}},
        "they must rise",
    ),
    ({"mla_shape": "lens.json"}, "mla_shape: lens.json"),
    ({"mla_shape": 3}, "mla_shape: 3: it must be a shape"),
    ({"mla_shape": SHAPES["sphere"], "mla_focal_length": 0.4}, "mla_focal_length = .0.4.*with this mla_shape it is"),
    ({"mla_shape": SHAPES["sphere"], "mla_glass": 1.5}, "mla_glass: an mla_shape brings its own"),
]  # fmt: skip


def microscope(**changes):
    """Describe a camera behind an objective with some values changed."""
    return {"main_lens": AIR.to_plain() | changes}


OBJECTIVES = [
    (microscope(numerical_aperture=1.0), "numerical_aperture = 1: it must be less than the index of the immersion, 1"),
    (microscope(magnification=-20), "magnification = -20: it must be greater than 0"),
    (microscope(magnification=4), "magnification = 4: their quotient must be at most 0.1"),
    (microscope(immersion=0.9), "immersion = 0.9: it must be at least 1"),
    (microscope(arrangement="Fourier"), "arrangement = 'Fourier': it must be one of image, fourier"),
    (microscope(arrangement="fourier"), "fourier_focal_length: it is missing"),
    (microscope(fourier_focal_length=50), "fourier_focal_length = 50: it is for arrangement = fourier"),
    (microscope(tube_focal_length="long"), "tube_focal_length = 'long': it must be a number"),
    (microscope(working_distance=2), "main_lens: working_distance: it is not one of magnification"),
    ({"main_lens": AIR, "focal_length": 12}, "focal_length = 12: with this main_lens it is 10"),
    ({"main_lens": AIR, "aperture_radius": 4}, "aperture_radius = 4: with this main_lens it is 5"),
    ({"main_lens": AIR, "mla_distance": 190}, "mla_distance = 190: with this main_lens it is 200"),
    ({"main_lens": AIR, "focus_distance": 10}, "focus_distance = 10: an objective is focused on its native object"),
    ({"main_lens": AIR, "wavefront": (0, 0, 0, 0.1)}, "a main_lens brings its own"),
]


def singlet(glass=1.5, radii=(50.0, -70.0), thickness=4.0, **changes):
    """Describe a camera behind one lens of two surfaces with some values changed."""
    first = {"radius": radii[0], "thickness": thickness, "glass": glass, "semi_aperture": 10, "stop": True}
    return {"main_lens": {"surfaces": [first | changes, {"radius": radii[1], "semi_aperture": 10}]}}


GAUSS = {"main_lens": "double_gauss", "focal_length": 80}

PRESCRIPTIONS = [
    ({"main_lens": {}}, "main_lens = {}: it must have surfaces, and may have name, source, wavelength"),
    ({"main_lens": {"surfaces": []}}, r"main_lens: surfaces = \[\]: it must be a list of 1 to 100"),
    (singlet(radius=0), "main_lens: surface 1: radius = 0: it must not be 0; a plane has no radius"),
    (singlet(semi_aperture=60), "semi_aperture = 60: the surface of radius 50 ends before that"),
    (singlet(semi_aperture=-1), "main_lens: surface 1: semi_aperture = -1: it must be at least 1e-09"),
    (singlet(thickness=-1), "main_lens: surface 1: thickness = -1: it must be at least 0"),
    (singlet(stop=False), "main_lens: 0 surfaces have stop: true: it must be just one of them"),
    (singlet(colour=1), "main_lens: surface 1: colour: it is not one of"),
    (singlet(0.5), "main_lens: surface 1: glass = 0.5: it must be at least 1"),
    (singlet({"abbe": 50}), "it must have index, index and abbe, sellmeier, schott or table"),
    (singlet({"sellmeier": [1, 2]}), r"glass: sellmeier = \(1.0, 2.0\): it must be 6 numbers"),
    (singlet({"table": [[600, 1.5], [700, 1.49]]}), "its table goes from 600 to 700 nm"),
    pytest.param(singlet("no such glass"), "main_lens: surface 1: glass = 'no such glass': ", marks=pytest.mark.slow),
    (singlet(thickness=0.01), "surfaces 1 and 2 cross 0.76"),
    (singlet(thickness=0), "main_lens: surfaces 1 and 2 cross 0 mm from the axis: they must"),
    (singlet(radii=(-50.0, 50.0)), "main_lens: its focal length is -"),
    ({"main_lens": "triplet"}, "there is no such file, and the bundled lenses are cooke_triplet, double_gauss"),
    (GAUSS | {"aperture_radius": 20}, "aperture_radius = 20: the main_lens opens to 13.3"),
    (GAUSS | {"mla_distance": 20}, "mla_distance = 20: the array would stand within the main_lens or its exit pupil"),
    (GAUSS | {"wavefront": (0, 0, 0, 0.1)}, "a main_lens brings its own; leave it out"),
    (GAUSS | {"distortion": (0.001, 0, 0, 0, 0)}, "a main_lens brings its own; leave it out"),
]


@pytest.mark.parametrize(
    ("parameters", "words"),
    [*NUMBERS, *LATTICES, *PUPILS, *IRREGULAR, *GLASSES, *MICROLENSES, *OBJECTIVES, *PRESCRIPTIONS],
)
def test_impossible_cameras_are_refused_in_one_line(parameters, words):
    with pytest.raises(InputError, match=words) as caught:
        PlenopticCamera(**parameters)
    assert "\n" not in str(caught.value)


def test_a_camera_with_a_missing_name_is_refused():
    values = PlenopticCamera().to_dict()
    del values["mla_pitch"]
    with pytest.raises(InputError, match="mla_pitch: it is missing"):
        PlenopticCamera.from_dict(values)
    with pytest.raises(InputError, match="detector_blur = 2: it must be at most 1"):
        PlenopticCamera.from_json(json.dumps({"detector_blur": 2}))


SHEET = {
    "f_number": 2.8, "lenses": 100, "pixels_per_lens": 10, "pixel_size": 0.005, "focal_length": 50.0,
    "focus_distance": 320.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        *(({name: None}, f"^{name}: missing") for name in ("f_number", "pixel_size", "focal_length")),
        ({"lenses": None}, "^lenses, resolution or sensor_size: missing"),
        ({"pixels_per_lens": None}, "^pixels_per_lens or mla_pitch: missing"),
        ({"focus_distance": None}, "^focus_distance or mla_distance: missing"),
        ({"mla_distance": 60}, "give one of the two"),
        ({"aperture_radius": 5}, "^aperture_radius = 5: it follows from f_number and focal_length; leave it out"),
        ({"resolution": (8, 8)}, "^lenses, resolution: one of them follows from the others; leave it out"),
        ({"mla_pitch": 0.05}, "^pixels_per_lens, mla_pitch: one of them follows"),
        ({"lenses": None, "resolution": 64, "sensor_size": 1}, "^resolution, sensor_size, pixel_size: one of them"),
        (
            {"lenses": None, "pixel_size": None, "resolution": (64, 48), "sensor_size": (0.64, 0.5)},
            r"^sensor_size = \(0.64, 0.5\): .*they must be square",
        ),
        (
            {"lenses": None, "sensor_size": (0.001, 1), "pixel_size": 0.0055},
            r"^sensor_size = \(0.001, 1\) with pixel_size = 0.0055: a side rounds to no pixel$",
        ),
        ({"pixels_per_lens": None, "mla_pitch": 20}, "^mla_pitch = 20: it must be less than the pupil's 17.86 mm"),
        ({"detector_width": 5}, "^detector_width = 5: it follows"),
        ({"detector_distance": 0.2}, "^detector_distance = 0.2: it follows"),
        ({"mla_focal_length": 0.2}, "^mla_focal_length = 0.2: it follows"),
        ({"f_number": "2.8"}, "^f_number = '2.8': it must be a number"),
        ({"f_number": -1}, "^f_number = -1: it must be at least"),
        ({"lenses": 2.5}, "^lenses = 2.5: it must be a whole number"),
        ({"lenses": 200_000}, "^lenses = 200000: with pixels of 0.005 mm the detector has 2000000"),
        ({"lenses": (1, 2, 3)}, r"^lenses = \(1, 2, 3\): it must be a pair"),
        ({"pixels_per_lens": 0.5}, "^pixels_per_lens = 0.5: it must be at least 1"),
        ({"main_lens": "double_gauss"}, "^f_number = 2.8: aperture_radius = .* opens to"),
        (
            {"main_lens": {"magnification": 20, "numerical_aperture": 0.5}, "focus_distance": None, "mla_distance": 10},
            "main_lens|mla_distance",
        ),
    ],
)
def test_too_few_and_contradictory_numbers_of_a_data_sheet_are_named(changes, words):
    with pytest.raises(InputError, match=words):
        PlenopticCamera.matched(**SHEET | changes)


def test_a_misspelt_number_of_a_data_sheet_is_answered_with_the_one_that_it_resembles():
    sheet = {name: value for name, value in SHEET.items() if name != "f_number"}
    words = r"matched\(\) got an unexpected keyword argument 'f_numbr'; did you mean f_number"
    with pytest.raises(TypeError, match=words):
        PlenopticCamera.matched(**sheet, f_numbr=2.8)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("f_number", r"aperture_radius is focal_length / \(2 f_number\); PlenopticCamera.matched"),
        ("lenses", r"detector_width is lenses \* pixels_per_lens \* pixel_size"),
        ("pixels_per_lens", r"mla_pitch is pixels_per_lens \* pixel_size / \(1 \+ detector_distance / mla_distance\)"),
        ("lattice", "mla_lattice is square or hexagonal"),
        ("pitch", "mla_pitch is the distance"),
        ("aperture", "aperture_radius is half the diameter"),
        ("detector_size", "detector_width is its first number"),
        ("sensor_size", "detector_width is its first number"),
        ("pixel_pitch", r"detector_width is pixel_pitch \* columns of resolution"),
    ],
)
def test_names_of_elsewhere_are_answered_with_the_parameter(name, words, tmp_path, complaint):
    words = f"{name}.*; {words}"
    path = tmp_path / "scene.xml"
    sensor = PlenopticCamera().to_xml().replace("<film", f'<float name="{name}" value="2"/><film')
    path.write_text(f'<scene version="3.0.0">{sensor}</scene>')
    with pytest.raises(TypeError, match=words):
        PlenopticCamera(**{name: 2})
    for attempt in (
        lambda: PlenopticCamera.from_json(json.dumps({name: 2})),
        lambda: PlenopticCamera().replace(**{name: 2}),
        lambda: load_scene("letters", variant="llvm_ad_mono", parameters={name: "2"}),
        lambda: load_scene(path),
    ):
        with pytest.raises(InputError, match=words):
            attempt()
    assert re.search(words, complaint("info", f"{name}=2"))


@pytest.mark.parametrize(
    ("place", "rule"),
    [
        ("x", "it must be a transform, 4 x 4 numbers"),
        ([[1, 2], [3]], "it must be a transform, 4 x 4 numbers"),
        ([1, 2, 3], "it must be a transform, 4 x 4"),
        (np.diag([1, 1, math.nan, 1]), "its numbers must be finite"),
        (np.diag([1, 1, 1e39, 1]), "its numbers must be finite"),
        (2 * np.eye(4), "it must be a rotation and a translation, without scale"),
        (np.diag([2, 2, 2, 1]), "it must be a rotation and a translation, without scale"),
        (np.diag([1, 1, 1, 2]), "it must be a rotation and a translation, without scale"),
        (np.eye(4) + 0.1 * np.eye(4, k=1), "it must be a rotation and a translation, without scale"),
        (np.zeros((4, 4)), "it must be a rotation and a translation, without scale"),
    ],
)
def test_places_of_a_camera_that_a_scene_would_refuse(place, rule):
    refuses(f"^to_world.*: {rule}", PlenopticCamera().to_xml, place)
