"""Lines that the command meets, good and bad: those end with one line that names what was given, and status 2."""

from __future__ import annotations

import shlex

import numpy as np
import pytest

from mitsuba_plenoptic import Capture, PlenopticCamera, write_capture
from mitsuba_plenoptic.cli import main

RECONSTRUCT = "reconstruct x.exr -o a.exr"
REFOCUS = f"{RECONSTRUCT} --distance 210"
RENDER = "render letters -o a.exr"

GOOD = [
    f"{RECONSTRUCT} --distance 210 --distance 280",
    f"{RECONSTRUCT} --distance inf",
    "reconstruct x.exr -oa.exr --distance 210",
    f"{REFOCUS} --method partial --method ray",
    f"{REFOCUS} --oversample 1_000",
    "reconstruct -q x.exr -o a.exr --distance 210",
    "reconstruct x.exr --distance 210 --help",
]

BAD = [
    ("recontruct x.exr", "Did you mean 'reconstruct'?"),
    ("--nosuch", "--nosuch"),
    (RECONSTRUCT, "'--distance'"),
    (f"{RECONSTRUCT} --distance -30", "--distance = -30: it must be greater than the focal length 80"),
    (f"{REFOCUS} --distanc 210", "--distanc; did you mean --distance?"),
    (f"{REFOCUS} --method PARTIAL", "did you mean partial?"),
    (f"{REFOCUS} --wavelength 0.5", "--wavelength = 0.5: it must be from 200 to 2500 nm; it looks like micrometres"),
    (f"{REFOCUS} --oversample 1.5", "--oversample = '1.5'"),
    (f"{REFOCUS} --f-number 2", "--f-number; aperture_radius is focal_length / (2 f_number)"),
    ("reconstruct -o a.exr --distance 210 -- -x.exr", "-x.exr: there is no such file"),
    ("reconstruct x.exr --distance 210 -o", "'-o' requires"),
    (f"{RENDER} -D a=1 -D b=-2 --aov depth,normal --seed 1 --spp 16", "parameter a: the scene "),
    (f'{RENDER} --camera "a=1, b=2"', "a: it is not a camera parameter"),
    (f'{RENDER} --camera ""', "it is a folder"),
]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Work where a small capture is called x.exr."""
    monkeypatch.chdir(tmp_path)
    camera = PlenopticCamera(resolution=(64, 64), detector_width=0.128)
    write_capture("x.exr", Capture(np.ones((64, 64), np.float32), camera, wavelength=633.0))
    return tmp_path


@pytest.mark.needs_extension("deconvolution")
@pytest.mark.parametrize("line", GOOD)
def test_good_lines_run(line, folder):
    assert main(shlex.split(line)) == 0


@pytest.mark.needs_extension("deconvolution")
@pytest.mark.parametrize(("line", "words"), BAD)
def test_bad_lines_are_refused_in_one_line(line, words, folder, complaint):
    assert words in complaint(*shlex.split(line))
    assert [path.name for path in folder.iterdir()] == ["x.exr"]
