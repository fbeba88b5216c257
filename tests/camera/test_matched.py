"""Cameras from data sheets: their micro-images in closed form and in a capture, and what is said about other names."""

import itertools
import json
import math
import re

import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.camera.camera_files import camera_and_record
from mitsuba_plenoptic.design import design_warnings, mended

SHEET = {"f_number": 2.8, "lenses": 100, "pixels_per_lens": 10, "pixel_size": 0.005, "focal_length": 50.0}
FOCUSED = SHEET | {"focus_distance": 320.0}
LATTICES = pytest.mark.parametrize("lattice", ["square", "hexagonal"])


def centres(camera: PlenopticCamera, *lenses: tuple[int, int]) -> np.ndarray:
    """Project centres of lenses through the main lens's centre onto the detector, in pixels."""
    b, z = camera.mla_distance, camera.detector_distance
    return np.array([camera.lattice.centre(*lens) for lens in lenses]) * (b + z) / b / camera.pixel_size


@LATTICES
def test_micro_images_are_as_wide_as_they_are_apart(lattice, count=(60, 41)):
    numbers = itertools.product((1.8, 2.8, 10.0), (6.84, 50.0, 135.0), (0.0014, 0.009), (2.5, 10, 16))
    for (f_number, focal_length, pixel, pixels), far in itertools.product(numbers, (6, math.inf)):
        given = {"f_number": f_number, "pixels_per_lens": pixels, "pixel_size": pixel, "focal_length": focal_length}
        given |= {"lenses": count, "focus_distance": far * focal_length, "mla_lattice": lattice}
        camera = PlenopticCamera.matched(**given)
        assert (camera.f_number, camera.pixel_size) == pytest.approx((f_number, pixel), rel=1e-12)
        here, right, up = centres(camera, (0, 0), (1, 0), (0, 1))
        assert [np.hypot(*(each - here)) for each in (right, up)] == pytest.approx([pixels] * 2, rel=1e-9)
        # The pupil's edges through the centre of a lens.
        wide = camera.aperture_diameter * camera.detector_distance / camera.mla_distance / pixel
        assert wide == pytest.approx(pixels, rel=1e-9)
        columns, rows = count
        step = 1 if lattice == "square" else math.sqrt(0.75)
        assert camera.resolution == (round(columns * pixels), round(rows * step * pixels))
        assert camera.focus_distance == pytest.approx(far * focal_length, rel=1e-9)
        assert design_warnings(camera) == []
        # Smaller lenses hardly focus light of 550 nm.
        if pixels * pixel > 4.1 * 0.55e-3 * camera.mla_distance / camera.aperture_diameter:
            assert design_warnings(camera, 550) == []


@LATTICES
def test_detectors_and_pitches_as_data_sheets_print_them(lattice):
    """Detectors end anywhere in a lens; a pitch in millimetres is that of the lenses, not of micro-images."""
    common = {"f_number": 2.8, "focal_length": 50.0, "focus_distance": 320.0, "mla_lattice": lattice}
    first = PlenopticCamera.matched(**common, resolution=(1920, 1200), pixel_size=0.00586, pixels_per_lens=14.3)
    assert first.resolution == (1920, 1200) and first.pixel_size == pytest.approx(0.00586, rel=1e-12)
    width = 14.3 * 0.00586
    z, b = first.detector_distance, first.mla_distance
    assert first.mla_pitch * (b + z) / b == pytest.approx(width, rel=1e-12)
    assert first.aperture_diameter * z / b == pytest.approx(width, rel=1e-12)
    sizes = {"sensor_size": (11.2512, 7.032), "mla_pitch": first.mla_pitch}
    for given in ({"resolution": (1920, 1200)}, {"pixel_size": 0.00586}):
        again = PlenopticCamera.matched(**common, **sizes, **given)
        assert again.resolution == first.resolution
        for name in ("mla_pitch", "detector_distance", "mla_focal_length", "detector_width"):
            assert getattr(again, name) == pytest.approx(getattr(first, name), rel=1e-12)
    named = {**common, "sensor_size": "11.2512,7.032", "pixel_size": 0.00586, "pixels_per_lens": 14.3}
    assert camera_and_record(",".join(f"{name}={value}" for name, value in named.items()))[0] == first


def test_a_real_lens_and_a_medium():
    given = {name: value for name, value in FOCUSED.items() if name != "focal_length"} | {"f_number": 4}
    camera = PlenopticCamera.matched(**given, main_lens="double_gauss", mla_medium=1.5)
    assert camera.f_number == pytest.approx(4)
    width = 2 * camera.pupil_radius * camera.detector_distance / 1.5 / camera.pupil_distance
    assert [width, camera.micro_image_pitch] == pytest.approx([0.05, 0.05], rel=1e-9)
    assert camera.mla_focal_length == camera.detector_distance


def test_files_and_texts_state_the_same_camera(tmp_path, run):
    camera = PlenopticCamera.matched(**FOCUSED | {"lenses": (60, 40)}, mla_lattice="hexagonal")
    numbers = FOCUSED | {"lenses": [60, 40], "mla_lattice": "hexagonal"}
    text = ",".join(f"{name}={value}" for name, value in numbers.items()).replace("[60, 40]", "60,40")
    (tmp_path / "camera.json").write_text(json.dumps(numbers))
    (tmp_path / "camera.yaml").write_text("".join(f"{name}: {value}\n" for name, value in numbers.items()))
    assert PlenopticCamera.from_json(json.dumps(numbers)) == camera
    for source in (text, text.replace("60,40", "(60, 40)"), tmp_path / "camera.json", tmp_path / "camera.yaml"):
        run("info", source, "--fix", tmp_path / "same.json")
        assert PlenopticCamera.from_json((tmp_path / "same.json").read_text()) == camera
    assert PlenopticCamera.from_json(camera.to_json()) == camera


KEPLERIAN = {"mla_distance": 121.536, "mla_focal_length": 0.384, "detector_distance": 0.512}
OBJECTIVE = {"magnification": 20, "numerical_aperture": 0.5}
POOR = {
    "micro-images overlap: their diameter": {"aperture_radius": 10},
    "pixels are wasted": {"aperture_radius": 2},
    "no object plane is in focus": {"mla_distance": 70},
    "no refocusing": {"resolution": (128, 128)},
    "gaps at 240 mm": KEPLERIAN | {"aperture_radius": 2.4},
    "only 0 of them": {"mla_lattice": "hexagonal", "mla_focal_length": (0.512, 0.47, 0.55)},
    "hardly focus": {"mla_pitch": 0.016, "mla_focal_length": 0.128, "resolution": (16384, 16384)},
    "lens_model parabolic: .* 0.74 waves": {"lens_model": "parabolic"},
    "metre": {"mla_pitch": 6.4e-5, "mla_focal_length": 5.12e-4, "detector_width": 8.192e-3}
    | {"focal_length": 0.08, "aperture_radius": 0.005, "mla_distance": 0.12},
    "fill 33% of their pitch": {"main_lens": OBJECTIVE, "mla_pitch": 0.15, "mla_focal_length": 1.0},
}
"""Cameras by what is said of them."""


@pytest.mark.parametrize("words", POOR)
def test_remedies_leave_no_warning(words):
    camera = PlenopticCamera(**POOR[words])
    assert any(re.search(words, warning) for warning in design_warnings(camera, 633))
    assert design_warnings(mended(camera, 633), 633) == []


def test_a_focused_camera_keeps_its_plane():
    camera = PlenopticCamera(**KEPLERIAN | {"aperture_radius": 10})
    better = mended(camera)
    touching = mended(PlenopticCamera(aperture_radius=10))
    assert touching.micro_image_diameter == pytest.approx(touching.micro_image_pitch)
    assert mended(PlenopticCamera.matched(**FOCUSED), 550) == PlenopticCamera.matched(**FOCUSED)
    a = [1 / (1 / each.mla_focal_length - 1 / each.detector_distance) for each in (camera, better)]
    assert better.aperture_radius == 10 and a[1] == pytest.approx(a[0])
