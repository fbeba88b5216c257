"""`compare --against ordinary`: the pictures of a camera with and without its array, and their sharpness."""

import json

import numpy as np
import pytest
from cameras import definitions, letters

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import InputError, capture_spec
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.report import experiment
from mitsuba_plenoptic.report.comparison import compare
from mitsuba_plenoptic.report.experiment import Settings

DISTANCE = 220.0
SMALL = letters(12, resolution=192)
WORDS = f"compare letters --distance {DISTANCE:g} --spp 4 --against ordinary".split() + definitions(SMALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of a small comparison, made by the command."""
    out = tmp_path_factory.mktemp("compared") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiment, "OBJECT_COLUMNS", 32)
        assert main([*WORDS, "-o", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def found(folder):
    return json.loads((folder / "results.json").read_text())["ordinary"]


@pytest.mark.slow
def test_the_page_shows_both_cameras(folder, found):
    page = (folder / "report.html").read_text()
    assert "Against an ordinary camera" in page and "--against ordinary" in page
    for name in ("ordinary", "mtf"):
        assert all((folder / f"{name}.{suffix}").stat().st_size > 5000 for suffix in ("png", "pdf"))
    assert [row["picture"] for row in found["pictures"]] == ["ordinary", "ray", "coherent", "partial"]
    assert [row["pixels"] for row in found["pictures"]] == [[192, 192]] + 3 * [[12, 12]]
    for row in found["pictures"]:
        assert f'{row["title"]}</td><td class="number">{row["pixels"][0]} x ' in page
        assert f"{row['mtf50_per_mm']:.3g}" in page and f"{row['mtf10_per_mm']:.3g}" in page


def test_the_ordinary_camera_is_that_of_the_scene_without_the_array(folder, found):
    camera = mp.read_capture(folder / "data" / "capture_wave.exr").camera
    twin = camera.replace(mla_lattice="none").replace(focus_distance=DISTANCE)
    capture = mp.read_capture(folder / "data" / "capture_ordinary.exr")
    assert capture.camera == twin == mp.PlenopticCamera.from_dict(found["camera"])
    scene = mp.with_camera(mp.load_scene("letters", parameters=SMALL), twin)
    known = mp.render_capture(scene, model="wave", wavelength=633.0, spp=4)
    np.testing.assert_array_equal(capture.image, known.image)


def test_it_is_as_sharp_as_its_pupil_and_pixels_allow(found):
    camera, ordinary = mp.PlenopticCamera.from_dict(found["camera"]), found["pictures"][0]
    # In the plane in focus: the cut-off of the pupil, and pixels turned by 5 degrees.
    cutoff = 2 * camera.aperture_radius / (633e-6 * DISTANCE)
    pixel = camera.pixel_size * DISTANCE / camera.mla_distance
    assert found["cutoff_per_mm"] == pytest.approx(cutoff, rel=1e-5)
    assert ordinary["nyquist_per_mm"] == pytest.approx(0.5 / pixel, rel=1e-4)
    frequency = np.array(found["frequency_per_mm"])
    frequency = frequency[frequency < 0.8 * min(cutoff, 0.5 / pixel)]
    s = frequency / cutoff
    disc = 2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s * s))
    assert found["diffraction"][: s.size] == pytest.approx(disc, abs=1e-4)
    expected = (
        disc * np.sinc(frequency * pixel * np.cos(np.radians(5))) * np.sinc(frequency * pixel * np.sin(np.radians(5)))
    )
    assert ordinary["transfer"][: s.size] == pytest.approx(expected, abs=0.03)
    for level, name in ((0.5, "mtf50_per_mm"), (0.1, "mtf10_per_mm")):
        assert np.interp(ordinary[name], frequency, expected) == pytest.approx(level, abs=0.03)


def test_the_array_costs_sharpness(found):
    ordinary, *refocused = found["pictures"]
    frequency = np.array(found["frequency_per_mm"])
    for row in refocused:
        assert row["nyquist_per_mm"] == pytest.approx(120 / (2 * 0.064 * DISTANCE), rel=1e-3)
        assert 0.2 < row["mtf50_per_mm"] / (0.6 * 120 / (0.064 * DISTANCE)) < 1
        assert row["mtf50_per_mm"] < ordinary["mtf50_per_mm"] / 4
        assert row["mtf50_per_mm"] < row["mtf10_per_mm"] < ordinary["mtf10_per_mm"]
        held = np.flatnonzero((frequency > 1.5) & (frequency < row["nyquist_per_mm"]))
        assert (np.array(row["transfer"])[held] < np.array(ordinary["transfer"])[held]).all()


def test_a_second_run_takes_up_what_is_there(folder, capsys, monkeypatch):
    monkeypatch.setattr(experiment, "OBJECT_COLUMNS", 32)
    monkeypatch.setattr(capture_spec, "render_capture", None)
    before = (folder / "results.json").read_bytes()
    assert main([*WORDS, "-o", str(folder)]) == 0
    assert (folder / "results.json").read_bytes() == before
    assert "Half the contrast, in cycles per mm: Ordinary camera " in capsys.readouterr().out


BARE = mp.PlenopticCamera(mla_lattice="none", resolution=(64, 64), detector_width=0.3)


def preset(name, distance):
    """Settings of the letters by a known camera, refocused to a distance."""
    return {"camera": mp.PlenopticCamera.preset(name).to_dict(), "parameters": {}, "distances": (distance,)}


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"distances": (np.inf,)}, "^against = ordinary: distance = inf: sharpness is measured on an edge"),
        ({"camera": BARE.to_dict(), "parameters": {}}, "mla_lattice = none: the camera has no microlens array$"),
        (preset("lfm", 0.001), "^against = ordinary: main_lens = .*: mla_lattice = none: the camera has no microlens"),
        (preset("shack_hartmann", 1e6), "main_lens = collimator: "),
    ],
    ids=["infinity", "no array", "objective", "telescope"],
)
@pytest.mark.filterwarnings("ignore:the whole scene is nearer")
def test_what_has_no_ordinary_twin_is_refused(changes, rule, tmp_path):
    settings = Settings("letters", **{"distances": (DISTANCE,), "parameters": SMALL, "spp": 1} | changes)
    with pytest.raises(InputError, match=rule):
        compare(settings, tmp_path / "out", against="ordinary")
    assert not (tmp_path / "out").exists()


def test_other_words_are_refused(tmp_path, capsys):
    with pytest.raises(InputError, match=r"^against = 'phone': it must be one of ordinary"):
        compare(Settings("letters", distances=(DISTANCE,)), tmp_path / "out", against="phone")
    assert main([*WORDS[:6], "--against", "phone", "-o", str(tmp_path / "out")]) == 2
    assert "against = 'phone': it must be one of ordinary" in capsys.readouterr().err
