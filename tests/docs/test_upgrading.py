"""What the README of version 1.0 asks the reader to type works, at a smaller size."""

import re
import shlex
import subprocess
from pathlib import Path

import pytest
from check_release import page_code

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.presets import PRESETS

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "tests" / "files_of_1_0" / "README_of_1.0.md").read_text()
COMMANDS = [
    shlex.split(line, comments=True)
    for block in re.findall(r"^```console\n(.*?)^```", TEXT, flags=re.MULTILINE | re.DOTALL)
    for line in block.splitlines()
]
OURS = [words[1:] for words in COMMANDS if words[0] == "mitsuba-plenoptic"]
SMALL = {"detector_width": "1.024", "resolution": "128", "letter_scale": "0.2"}

SCENE = """<scene version="3.0.0"><integrator type="path"/>
<sensor type="plenoptic">
  <float name="detector_width" value="0.512"/>
  <film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="64"/>
    <string name="pixel_format" value="luminance"/><rfilter type="box"/></film>
</sensor>
<shape type="rectangle" id="wall">
  <transform name="to_world"><scale value="30"/><rotate y="1" angle="180"/><translate z="240"/></transform>
  <emitter type="area"><texture type="checkerboard" name="radiance">
    <transform name="to_uv"><scale value="40"/></transform></texture></emitter>
</shape></scene>"""


@pytest.fixture
def small(tmp_path, monkeypatch):
    """Work in an empty folder, with a scene as the README names it, and a Lytro camera of a twentieth of the width."""
    monkeypatch.chdir(tmp_path)
    Path("my_scene.xml").write_text(SCENE)
    lytro = PRESETS["lytro"]
    monkeypatch.setitem(
        PRESETS, "lytro", lytro | {"detector_width": lytro["detector_width"] / 20, "resolution": (164, 164)}
    )


def test_the_python_code(small, monkeypatch, capsys):
    load = mp.load_scene
    monkeypatch.setattr(mp, "load_scene", lambda name: load(name, parameters=SMALL))
    exec(page_code(TEXT), {})
    said = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in said] == ["210.0", "240.0", "280.0", "10.0"]
    assert mp.read_capture("raw.exr").model == "ray"


@pytest.mark.slow
def test_the_commands(small):
    """One after the other, as later ones read what earlier ones wrote."""
    assert [words[0] for words in OURS] == ["doctor", "render", "render", "reconstruct", "depth", "view", "compare"]
    for words in OURS:
        built_in = words[:2] == ["render", "letters"]
        sizes = [f"-D{name}={value}" for name, value in SMALL.items()] if built_in else []
        assert main([*words, *sizes]) == 0, words
    assert mp.read_capture("raw.exr").camera.mla_lattice == "hexagonal"
    assert mp.read_capture("wave.exr").model == "wave"
    written = {"out_210.png", "out_280.png", "depth.exr", "wave.html", "out"}
    assert written <= {path.name for path in Path().iterdir()} and Path("out/report.html").is_file()


def test_what_is_asked_of_make_and_pip():
    others = [words for words in COMMANDS if words[0] != "mitsuba-plenoptic"]
    assert others == [["make", "demo"], ["make", "test"], ["pip", "install", "."]]
    for words in others[:2]:
        subprocess.run([*words, "--dry-run"], check=True, capture_output=True, cwd=ROOT)
    assert (ROOT / "pyproject.toml").is_file()
