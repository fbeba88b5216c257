"""The command ``preview``: what it prints and refuses."""

from dataclasses import replace

import mitsuba as mi
import pytest
from PIL import Image

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.extensions.studio import preview


@pytest.fixture(autouse=True)
def few_samples(monkeypatch, coarse_figures):
    monkeypatch.setattr(preview, "_SPP", 1)
    monkeypatch.setattr(preview, "_COLUMNS", 32)


SMALL = ("-D", "resolution=256", "-D", "detector_width=2.048")


def test_what_is_printed(tmp_path, run, complaint):
    path = tmp_path / "look.png"
    text = run("preview", "letters", *SMALL, "-o", path, "--spp", "1", "--waves", "--dpi", 50)
    assert "field: 4.096 x 4.096 mm at 240 mm" in text
    assert "micro-images: 8.03 pixels apart, 32 x 32 of them" in text
    assert "ray capture: about" in text and "wave capture: about" in text
    assert Image.open(path).width == 490
    assert ".png or .pdf" in complaint("preview", "letters", "-o", tmp_path / "a.jpg")


def test_lenses_of_a_hexagonal_array_are_counted_not_bins(tmp_path, run):
    sheet = "f_number=4,lenses=20,pixels_per_lens=10,pixel_size=0.005,focal_length=50,focus_distance=320"
    text = run("preview", "letters", "--camera", f"{sheet},mla_lattice=hexagonal", "-o", tmp_path / "look.png")
    assert "micro-images: 10 pixels apart, 20 x 20 of them" in text


def test_the_picture_comes_first_and_waves_are_estimated_only_when_asked_for(tmp_path, run, monkeypatch):
    path, seen, estimated = tmp_path / "look.png", [], mp.estimate_capture

    def estimate(scene, *, model, spp):
        seen.append((model, path.exists(), mi.variant()))
        return replace(estimated(scene, model=model, spp=spp), seconds=151.0, memory=2**30)

    monkeypatch.setattr("mitsuba_plenoptic.scene.estimate_capture", estimate)
    text = run("preview", "letters", *SMALL, "-o", path, "--variant", "llvm_ad_rgb")
    assert seen == [("ray", True, "llvm_ad_rgb")] and text.startswith(f"{path}: the picture")
    assert "ray capture: about 3 min and 1 GiB" in text and "wave" not in text


def test_a_telescope_focused_at_infinity_sees_a_planet_farther_than_mitsubas_cameras_do_by_default(tmp_path, run):
    text = run("preview", "telescope", "--spp", 1, "-o", tmp_path / "look.png")
    # A detector of 2.56 mm behind 500 mm.
    assert "field: 0.2934 x 0.2934 degrees at infinity" in text
    assert "made sharp by refocusing: 488.3 to infinity" in text and "e+07" not in text
    assert "nothing of the scene is in the picture" not in text
