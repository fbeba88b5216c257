"""The command ``fit``."""

import json

import numpy as np
import pytest
from scene_cases import write_scene
from wave_cases import HALF

from mitsuba_plenoptic import load_scene, render_capture, write_capture
from mitsuba_plenoptic.cli import main

SENSOR = '<float name="detector_width" value="0.128"/>' + "".join(
    f'<float name="{name}" value="{value}"/>' for name, value in HALF.items()
)
WALL = """<shape type="disk"><transform name="to_world"><scale value="0.05"/><rotate y="1" angle="180"/>
<translate z="116"/></transform><emitter type="area"><spectrum name="radiance" value="1"/></emitter></shape>"""


def test_a_camera_from_a_capture(tmp_path, capsys):
    path = write_scene(tmp_path, WALL, sensor=SENSOR)
    capture = render_capture(load_scene(path), model="wave", spp=1, radiators_per_lens=2, accuracy=0.05)
    write_capture(tmp_path / "raw.exr", capture)
    start = tmp_path / "start.json"
    start.write_text(capture.camera.replace(mla_offset=(0.0005, -0.0003)).to_json())
    words = ["fit", tmp_path / "raw.exr", "--scene", path, "--number", "mla_offset", "--photons", "1e5"]
    words += ["--camera", start, "--radiators-per-lens", "2", "--accuracy", "0.05", "-o", tmp_path / "camera.json"]
    assert main(list(map(str, words))) == 0
    found = json.loads((tmp_path / "camera.json").read_text())
    # The radiators are those of another camera, by half a micrometre.
    assert np.abs(found["mla_offset"]).max() < 2e-4
    printed = capsys.readouterr().out
    assert "mla_offset.1 = " in printed and " +- " in printed and "told to " in printed


def test_a_camera_from_a_capture_by_rays(tmp_path, capsys):
    path = write_scene(tmp_path, WALL, sensor=SENSOR)
    capture = render_capture(load_scene(path), model="ray", spp=256)
    write_capture(tmp_path / "raw.exr", capture)
    start = tmp_path / "start.json"
    start.write_text(capture.camera.replace(mla_offset=(0.005, -0.003)).to_json())
    words = ["fit", tmp_path / "raw.exr", "--scene", path, "--number", "mla_offset", "--photons", "1e5"]
    words += ["--camera", start, "--method", "rays", "-o", tmp_path / "camera.json"]
    assert main(list(map(str, words))) == 0
    found = json.loads((tmp_path / "camera.json").read_text())
    assert np.abs(found["mla_offset"]).max() < 1e-3
    assert not list(tmp_path.glob("*.checkpoint"))
    capsys.readouterr()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--scene", "letters", "--scene", "white"], "1 captures and 2 scenes"),
        (["--scene", "letters", "--photons", "x"], "photons"),
    ],
)
def test_mistakes_are_one_line(tmp_path, capsys, words, message):
    given = ["fit", str(tmp_path / "raw.exr"), "--number", "mla_pitch", "-o", str(tmp_path / "camera.json")]
    assert main([*given, *([] if "--photons" in words else ["--photons", "10"]), *words]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
