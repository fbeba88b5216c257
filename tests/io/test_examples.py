"""The captures that come with the package: what they hold, and that their tool makes them."""

from pathlib import Path

import make_examples
import numpy as np
import pytest
from refusals import refuses

import mitsuba_plenoptic as mp

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
    refuses(r"^example = 'letters': it must be one of letters-ray, letters-wave, white", mp.example, "letters")
    refuses(r"^example = '\.\./scenes/white': it must be one of", mp.example_truth, "../scenes/white")


def test_the_models_and_one_camera():
    captures = {name: mp.example(name) for name in NAMES}
    assert {name: (one.model, one.wavelength) for name, one in captures.items()} == {
        "letters-ray": ("ray", None),
        "letters-wave": ("wave", 633.0),
        "white": ("ray", None),
    }
    camera = captures["white"].camera
    assert {one.camera for one in captures.values()} == {camera} and camera.bin_count == (48, 48)
    assert camera.focus_distance == pytest.approx(240)
    assert {mp.example_truth(name).camera for name in NAMES} == {camera}
    assert captures["letters-wave"].metadata["parameters"] == make_examples.LETTERS


def test_the_white_scene_has_the_closed_form():
    """A wall of radiance 1 fills the image of the pupil, of radius R f / b, behind each lens."""
    white = mp.example("white")
    camera = white.camera
    radius = camera.aperture_radius * camera.detector_distance / camera.mla_distance
    disc = np.pi * radius**2 / camera.mla_pitch**2
    assert white.image.mean() == pytest.approx(disc, rel=2e-3)
    assert white.image.max() == 1


def test_the_wave_capture_has_the_light_of_the_ray_capture():
    ray, wave = (mp.example(f"letters-{model}").image for model in ("ray", "wave"))
    assert wave.sum() == pytest.approx(ray.sum(), rel=0.02)
    assert not np.allclose(wave, ray, atol=0.05)


def test_depths_are_those_of_the_scene():
    letters, white = (mp.example_truth(name) for name in ("letters-ray", "white"))
    assert set(np.unique(letters.views["depth"][np.isfinite(letters.views["depth"])])) == set(DISTANCES)
    assert np.all(white.pixels["depth"][np.isfinite(white.pixels["depth"])] == 240)
    capture = mp.example("letters-ray")
    lit = capture.image > 0.99
    assert lit.any() and np.isfinite(letters.pixels["depth"][lit]).mean() > 0.95


@pytest.mark.parametrize("name, loss", [("letters-ray", 0.01), ("letters-wave", 0.15)])
def test_each_letter_is_sharp_at_its_distance(name, loss):
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
    run("example", "white")
    assert (tmp_path / "white.truth.exr").is_file()
