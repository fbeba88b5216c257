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
