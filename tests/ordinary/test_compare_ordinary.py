"""`compare --against ordinary`: the pictures of a camera with and without its array, and their sharpness."""

import json

import numpy as np
import pytest
from cameras import definitions, letters
from PIL import Image

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import InputError, capture_spec
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.report import experiment
from mitsuba_plenoptic.report.comparison import compare
from mitsuba_plenoptic.report.experiment import Settings
from mitsuba_plenoptic.report.plots import Plot

DISTANCE = 220.0
SMALL = letters(8, resolution=128)
WORDS = f"compare letters --distance {DISTANCE:g} --spp 4 --methods ray,coherent --against ordinary".split()
WORDS += definitions(SMALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of a small comparison, made by the command, whose figures are blank, and of a second run."""
    out = tmp_path_factory.mktemp("compared") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiment, "OBJECT_COLUMNS", 32)
        patch.setattr(Plot, "save", lambda self, path, dpi=None: Image.new("L", (9, 9)).save(path))
        assert main([*WORDS, "-o", str(out)]) == 0
        first = (out / "results.json").read_bytes()
        patch.setattr(capture_spec, "render_capture", None)
        assert main([*WORDS, "-o", str(out)]) == 0
    assert (out / "results.json").read_bytes() == first
    return out


@pytest.fixture(scope="module")
def found(folder):
    return json.loads((folder / "results.json").read_text())["ordinary"]


@pytest.mark.slow
def test_the_page_shows_the_camera_of_the_scene_and_that_without_the_array(folder, found):
    page = (folder / "report.html").read_text()
    assert "Against an ordinary camera" in page and "--against ordinary" in page
    assert [row["picture"] for row in found["pictures"]] == ["ordinary", "ray", "coherent"]
    assert [row["pixels"] for row in found["pictures"]] == [[128, 128]] + 2 * [[8, 8]]
    for row in found["pictures"]:
        assert f'{row["title"]}</td><td class="number">{row["pixels"][0]} x ' in page
        assert f"{row['mtf50_per_mm']:.3g}" in page and f"{row['mtf10_per_mm']:.3g}" in page
    camera = mp.read_capture(folder / "data" / "capture_wave.exr").camera
    twin = camera.replace(mla_lattice="none").replace(focus_distance=DISTANCE)
    capture = mp.read_capture(folder / "data" / "capture_ordinary.exr")
    assert capture.camera == twin == mp.PlenopticCamera.from_dict(found["camera"])
    scene = mp.with_camera(mp.load_scene("letters", parameters=SMALL), twin)
    np.testing.assert_array_equal(capture.image, mp.render_capture(scene, model="wave", wavelength=633.0, spp=4).image)


@pytest.mark.slow
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
    along, across = (frequency * pixel * part for part in (np.cos(np.radians(5)), np.sin(np.radians(5))))
    expected = disc * np.sinc(along) * np.sinc(across)
    assert ordinary["transfer"][: s.size] == pytest.approx(expected, abs=0.03)
    for level, name in ((0.5, "mtf50_per_mm"), (0.1, "mtf10_per_mm")):
        assert np.interp(ordinary[name], frequency, expected) == pytest.approx(level, abs=0.03)


BARE = mp.PlenopticCamera(mla_lattice="none", resolution=(64, 64), detector_width=0.3)


def preset(name, distance):
    """Settings of the letters by a known camera, refocused to a distance."""
    return {"camera": mp.PlenopticCamera.preset(name).to_dict(), "parameters": {}, "distances": (distance,)}


@pytest.mark.parametrize(
    ("changes", "against", "words"),
    [
        ({"distances": (np.inf,)}, "ordinary", "^against = ordinary: distance = inf"),
        ({"camera": BARE.to_dict(), "parameters": {}}, "ordinary", "mla_lattice = none"),
        (preset("lfm", 0.001), "ordinary", "^against = ordinary: main_lens = .*: mla_lattice = none"),
        (preset("shack_hartmann", 1e6), "ordinary", "main_lens = collimator"),
        ({}, "phone", "^against = 'phone'"),
    ],
    ids=["infinity", "no array", "objective", "telescope", "phone"],
)
@pytest.mark.filterwarnings("ignore:the whole scene is nearer")
def test_what_has_no_ordinary_twin_is_refused(changes, against, words, tmp_path):
    settings = Settings("letters", **{"distances": (DISTANCE,), "parameters": SMALL, "spp": 1} | changes)
    with pytest.raises(InputError, match=words):
        compare(settings, tmp_path / "out", against=against)
    assert not (tmp_path / "out").exists()
