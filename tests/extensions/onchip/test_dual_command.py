"""The command ``dual``."""

import numpy as np
import OpenEXR

from mitsuba_plenoptic import Capture, PlenopticCamera, dual_pixel, write_capture
from mitsuba_plenoptic.onchip import LAYOUTS

CAMERA = PlenopticCamera(mla_pitch=0.0024, detector_width=0.1536, resolution=(128, 128))


def noise(*shape):
    return np.random.default_rng(0).random(shape, dtype=np.float32)


def test_the_command(tmp_path, run, complaint):
    capture = Capture(noise(128, 128), CAMERA)
    write_capture(tmp_path / "raw.exr", capture)
    said = run("dual", tmp_path / "raw.exr", "-o", tmp_path / "halves.exr")
    assert said.endswith("2 x 1 pictures of 64 x 64 lenses\n")
    parts = {part.name(): part for part in OpenEXR.File(str(tmp_path / "halves.exr"), separate_channels=True).parts}
    assert list(parts) == ["left", "right", "sum"]
    np.testing.assert_array_equal(parts["right"].channels["Y"].pixels, dual_pixel(capture)[0, 1])
    assert "2 x 2 pictures" in run("dual", tmp_path / "raw.exr", "-o", tmp_path / "four.png", "--layout", "2x2")
    assert complaint("dual", tmp_path / "raw.exr", "-o", tmp_path / "x.exr", "--layout", "3x1").startswith("--layout")


def test_layouts_in_the_help_are_those_of_the_library(run):
    assert "|".join(f"{along}x{across}" for along, across in LAYOUTS) in run("dual", "--help")
