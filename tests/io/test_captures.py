"""Captures on disk."""

import json
from functools import partial
from importlib.metadata import version
from pathlib import Path

import make_examples
import numpy as np
import OpenEXR
import pytest
from cameras import letters, small_camera
from refusals import refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import Capture, PlenopticCamera, read_capture, write_capture
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.io import exr


@pytest.fixture
def camera():
    return PlenopticCamera(
        detector_width=0.128, resolution=(64, 48), crop_offset=(8, 4), crop_size=(40, 32), lens_model="parabolic"
    )


@pytest.mark.parametrize("channels", [(), (3,)])
def test_a_capture_survives_the_disk(tmp_path, camera, channels):
    image = np.random.default_rng(1).random((32, 40, *channels), dtype=np.float32)
    wavelength = (610.0, 550.0, 465.0) if channels else 633.0
    path = tmp_path / "raw.exr"
    write_capture(path, Capture(image, camera, wavelength, "wave", {"seed": 3, "scene": 'ä "quoted"'}))
    read = read_capture(path)
    np.testing.assert_array_equal(read.image, image)
    assert (read.camera, read.wavelength, read.model) == (camera, wavelength, "wave")
    assert read.metadata == {"seed": 3, "scene": 'ä "quoted"'}
    assert list(tmp_path.iterdir()) == [path]


def test_files_stand_for_captures_and_white(tmp_path):
    camera = small_camera(4)
    capture = Capture(np.random.default_rng(0).random(camera.shape), camera)
    white = Capture(0.5 + np.abs(np.sin(np.arange(128))) * np.ones((128, 1)), camera)
    paths = tmp_path / "raw.exr", tmp_path / "white.exr"
    for path, one in zip(paths, (capture, white), strict=True):
        write_capture(path, one)
    for work in (partial(mp.reconstruct, distance=240), mp.decode):
        np.testing.assert_array_equal(work(str(paths[0]), white=paths[1]), work(capture, white=white))


def test_any_viewer_sees_the_window_and_the_pixels(tmp_path, camera):
    write_capture(tmp_path / "raw.exr", Capture(np.ones((32, 40)), camera))
    with OpenEXR.File(str(tmp_path / "raw.exr")) as file:
        header = file.header()
        assert [tuple(corner) for corner in header["dataWindow"]] == [(8, 4), (47, 35)]
        assert [tuple(corner) for corner in header["displayWindow"]] == [(0, 0), (63, 47)]
        assert file.channels()["Y"].pixels.dtype == np.float32


def test_files_state_the_version(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = mp.load_scene("letters", parameters=letters(2))
    capture = mp.render_capture(scene, spp=1)
    write_capture("raw.exr", capture)
    mp.write_ground_truth("raw.truth.exr", mp.ground_truth(scene))
    mp.write_raw("raw.png", mp.expose(capture, mp.Detector(), photons=100, seed=1))
    assert main(["reconstruct", "raw.exr", "-o", "out.exr", "--distance", "240"]) == 0
    for name in ("raw.exr", "raw.truth.exr", "out.exr"):
        with OpenEXR.File(name, header_only=True) as file:
            assert json.loads(file.header()["mitsuba_plenoptic"])["version"] == version("mitsuba-plenoptic")
    assert f'"version": "{version("mitsuba-plenoptic")}"'.encode() in Path("raw.png").read_bytes()


@pytest.mark.parametrize("within", ["read_parts", "require_seal"])
def test_a_capture_that_another_process_replaces_meanwhile_is_read_again(tmp_path, monkeypatch, within):
    """The header of one file and the pixels of another would be damaged, or silently mixed."""
    path = tmp_path / "raw.exr"
    of_size = {size: Capture(np.ones((size, size)), small_camera(size // 32)) for size in (64, 32)}
    write_capture(path, of_size[64])
    step = getattr(exr, within)

    def replaced(*arguments):
        result = step(*arguments)
        monkeypatch.setattr(exr, within, step)
        write_capture(path, of_size[32])
        return result

    monkeypatch.setattr(exr, within, replaced)
    assert read_capture(path).image.shape == (32, 32)
    path.write_bytes(path.read_bytes()[:-40])
    refuses("damaged", read_capture, path)


DISTANCES = (210, 240, 280)
NAMES = ("letters-ray", "letters-wave", "white")
FOLDER = Path(mp.__file__).parent / "examples"


def test_names_and_files_agree():
    """The wheel may grow by 2 MB."""
    files = sorted(FOLDER.iterdir())
    assert [file.name for file in files] == sorted(
        f"{name}{suffix}" for name in NAMES for suffix in (".exr", ".truth.exr")
    )
    assert sum(file.stat().st_size for file in files) < 2e6
    assert tuple(make_examples.CAPTURES) == NAMES
    refuses("^example = 'letters': ", mp.example, "letters")
    refuses(r"^example = '\.\./scenes/white': ", mp.example_truth, "../scenes/white")


def test_the_white_scene_has_the_closed_form():
    """A wall of radiance 1 fills the image of the pupil, of radius R f / b, behind each lens."""
    white = mp.example("white")
    camera = white.camera
    radius = camera.aperture_radius * camera.detector_distance / camera.mla_distance
    disc = np.pi * radius**2 / camera.mla_pitch**2
    assert white.image.mean() == pytest.approx(disc, rel=2e-3)
    assert white.image.max() == 1


def test_each_letter_is_sharp_at_its_distance(name="letters-wave", loss=0.15):
    """Its radiance is 1 there, less what diffraction takes from its strokes, and elsewhere it is blurred."""
    depth = mp.example_truth(name).views["depth"]
    seen = depth[depth.shape[0] // 2, depth.shape[1] // 2]
    found = mp.reconstruct(mp.example(name), DISTANCES, white=mp.example("white"))
    for distance in DISTANCES:
        means = {one.distance: float(one.image[seen == distance].mean()) for one in found}
        peaks = {one.distance: float(one.image[seen == distance].max()) for one in found}
        assert 1 - loss < peaks[distance] < 1.001
        assert all(means[distance] > 1.4 * means[other] for other in DISTANCES if other != distance)


def test_the_tool_makes_them(tmp_path, monkeypatch):
    """With few samples: the mean agrees, and the ground truth is the same."""
    monkeypatch.setattr(make_examples, "SAMPLES", 2)
    make_examples.write_example(tmp_path / "white.exr", *make_examples.CAPTURES["white"])
    made, packed = mp.read_capture(tmp_path / "white.exr"), mp.example("white")
    assert made.image.mean() == pytest.approx(packed.image.mean(), rel=2e-3)
    assert made.camera == packed.camera
    np.testing.assert_array_equal(made.image * 2**14 % 1, 0)
    truth, kept = mp.read_ground_truth(tmp_path / "white.truth.exr"), mp.example_truth("white")
    np.testing.assert_array_equal(truth.pixels["depth"], kept.pixels["depth"])
    assert made.metadata | {"spp": 64, "software": 0} == packed.metadata | {"software": 0}


def test_command(tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    said = run("example", "letters-wave", "-o", "raw.exr")
    assert said == "raw.exr: capture of 768 x 768 pixels, wave model; ground truth in raw.truth.exr\n"
    read, packed = mp.read_capture("raw.exr"), mp.example("letters-wave")
    np.testing.assert_array_equal(read.image, packed.image)
    assert read.metadata == packed.metadata | {"ground_truth": "raw.truth.exr"} and read.camera == packed.camera
    truth, known = mp.read_ground_truth("raw.truth.exr"), mp.example_truth("letters-wave")
    np.testing.assert_array_equal(truth.views["depth"], known.views["depth"])
