"""The command ``fit``."""

import json
import re

import numpy as np
import pytest
from cameras import HALF, write_scene
from PIL import Image

from mitsuba_plenoptic import load_scene, render_capture, write_capture
from mitsuba_plenoptic.cli import main

SENSOR = '<float name="detector_width" value="0.128"/>' + "".join(
    f'<float name="{name}" value="{value}"/>' for name, value in HALF.items()
)
WALL = """<shape type="disk"><transform name="to_world"><scale value="0.05"/><rotate y="1" angle="180"/>
<translate z="116"/></transform><emitter type="area"><spectrum name="radiance" value="1"/></emitter></shape>"""


@pytest.mark.parametrize(
    ("model", "spp", "away", "limit"),
    [("wave", 4, (0.0005, -0.0003), 2e-4), pytest.param("ray", 256, (0.005, -0.003), 1e-3, marks=pytest.mark.slow)],
)
def test_a_camera_from_a_capture(model, spp, away, limit, tmp_path, capsys):
    """Points of the fit are those of another camera, so that it errs by a part of a micrometre."""
    path, more, fine = write_scene(tmp_path, WALL, sensor=SENSOR), [], {}
    if model == "wave":
        fine, more = {"method": "points", "accuracy": 0.05}, ["--points-per-lens", "4", "--accuracy", "0.05"]
    capture = render_capture(load_scene(path), model=model, spp=spp, **fine)
    write_capture(tmp_path / "raw.exr", capture)
    start = tmp_path / "start.json"
    start.write_text(capture.camera.replace(mla_offset=away).to_json())
    words = ["fit", tmp_path / "raw.exr", "--scene", path, "--parameter", "mla_offset", "--photons", "1e5", *more]
    words += ["--camera", start, "--model", model, "-o", tmp_path / "camera.json"]
    assert main(list(map(str, words))) == 0
    assert np.abs(json.loads((tmp_path / "camera.json").read_text())["mla_offset"]).max() < limit
    printed, said = capsys.readouterr()
    assert "mla_offset.1 = " in printed and " +- " in printed and "determined to " in printed
    assert not list(tmp_path.glob("*.checkpoint"))
    # A rendering of 256 samples has more noise than so many photons.
    assert model == "wave" or ("fit: chi-square is " in said and said.count("\n") == 1)


def test_noise_and_saturation_are_those_that_expose_keeps(tmp_path, run, complaint):
    path = write_scene(tmp_path, WALL, sensor=SENSOR)
    capture = render_capture(load_scene(path), model="wave", method="points", spp=4, accuracy=0.05)
    write_capture(tmp_path / "clean.exr", capture)
    # A tenth of the pixels is saturated.
    full = 600 * float(np.quantile(capture.image, 0.9))
    run("expose", tmp_path / "clean.exr", "-o", tmp_path / "raw.exr", "--photons", "1000", "--full-well", full)
    masked = np.zeros(capture.image.shape, np.uint8)
    masked[:10] = 255
    Image.fromarray(masked).save(tmp_path / "mask.png")
    words = ["fit", tmp_path / "raw.exr", "--scene", path, "--parameter", "mla_offset", "--accuracy", "0.05"]
    words += ["--points-per-lens", "4", "-o", tmp_path / "camera.json"]
    output = run(*words, "--mask", tmp_path / "mask.png")
    chi_square, deviation, pixels = re.search(r"per pixel (\S+) \+- (\S+) over (\d+) pixels", output).groups()
    assert float(chi_square) == pytest.approx(1, abs=4 * float(deviation))
    assert 0.5 < int(pixels) / capture.image.size < 0.9 * 54 / 64
    offset = re.search(r"mla_offset.1 = (\S+) \+- (\S+)", output).groups()
    assert abs(float(offset[0])) < 4 * float(offset[1])
    assert "leave out --photons" in complaint(*words, "--photons", "1000")
    words[1] = tmp_path / "clean.exr"
    assert "clean.exr: it keeps no noise" in complaint(*words)
    assert "saturation = 0: it must be" in complaint(*words, "--photons", "9", "--saturation", "0")
    Image.fromarray(masked[:4]).save(tmp_path / "mask.png")
    assert "mask.png: it has (4, 64) pixels" in complaint(*words, "--photons", "9", "--mask", tmp_path / "mask.png")


def test_the_capture_is_not_written_over(raw, tmp_path, complaint):
    copy, link = tmp_path / "copy.exr", tmp_path / "copy.json"
    copy.write_bytes(raw.read_bytes())
    link.symlink_to(copy)
    words = ["--scene", "letters", "--parameter", "mla_pitch", "--photons", "9"]
    assert "it is read, and would be lost" in complaint("fit", copy, "-o", link, *words)
    assert copy.read_bytes() == raw.read_bytes()


def test_a_fit_is_checked_before_light_is_found(mistake, monkeypatch):
    def found(*_, **__):
        raise AssertionError("light was found")

    monkeypatch.setattr("mitsuba_plenoptic.fitting.known_view", found)
    line = "fit {raw} -o {out}.json --scene letters --parameter"
    mistake(f"{line} mla_pitch --photons x", "photons")
    mistake(f"{line} mla_pitch --photons 9 --scene white", "1 captures and 2 scenes")
    mistake(f"{line} zoom --photons 9", "'zoom': ")
    mistake(f"{line} mla_pitch --photons -1", "photons = -1")
    mistake(f"{line} mla_pich --photons 9", "did you mean mla_pitch?")
    for name in ("focal_length=50", "resolution=256"):
        mistake(f"{line} mla_pitch --photons 9 -D {name}", "the scene's own camera")
