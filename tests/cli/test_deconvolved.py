"""The command deconvolves, and tells what it found."""

from __future__ import annotations

import json

import numpy as np
import OpenEXR

from mitsuba_plenoptic import PlenopticCamera, write_capture
from mitsuba_plenoptic.io.captures import Capture
from mitsuba_plenoptic.lightfield import white_image


def test_reconstruct_deconvolved(tmp_path, run, complaint):
    camera = PlenopticCamera(detector_width=0.384, resolution=(192, 192))
    raw, out = tmp_path / "raw.exr", tmp_path / "out.exr"
    write_capture(raw, Capture(white_image(camera), camera))
    options = "--method", "deconvolved", "--distance", 253, "--oversample", 2
    told = run("reconstruct", raw, "-o", out, *options, "--iterations", 3)
    assert "12 x 12 bins" in told
    assert "3 iterations, as many as were to be made" in told
    with OpenEXR.File(str(out)) as file:
        made = json.loads(file.header()["mitsuba_plenoptic"])
        image = file.channels()["Y"].pixels
    # A capture by rays is deconvolved by rays; white is white, at the borders too.
    assert made["options"]["response"] == "ray"
    assert made["facts"]["iterations"] == 3
    np.testing.assert_allclose(image, 1, atol=0.06)
    assert "stopped by the noise" in run("reconstruct", raw, "-o", out, *options, "--photons", 50)
    assert "photons = -1" in complaint("reconstruct", raw, "-o", out, *options, "--photons", -1)
    assert "wavelength" in complaint("reconstruct", raw, "-o", out, *options, "--response", "wave")


def test_info_tells_the_limit(run):
    output = run("info", "paper", "--wavelength", "633")
    assert "resolution, deconvolved" in output
    assert "deconvolution does not help" in output
