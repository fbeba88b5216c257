"""The command deconvolves, and tells what it found."""

import json

import numpy as np
import OpenEXR
import tifffile

from mitsuba_plenoptic import Capture, PlenopticCamera, write_capture
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.views import white_image


def test_reconstruct_deconvolved(tmp_path, run, complaint):
    camera = PlenopticCamera(detector_width=0.384, resolution=(192, 192))
    raw, out = tmp_path / "raw.exr", tmp_path / "out.exr"
    write_capture(raw, Capture(white_image(camera), camera))
    options = "--method", "deconvolved", "--distance", 253, "--oversample", 2
    kept = tmp_path / "out.exr.checkpoint"
    kept.write_bytes(b"")
    assert "not a checkpoint of this version" in complaint("reconstruct", raw, "-o", out, *options, "--resume")
    told = run("reconstruct", raw, "-o", out, *options, "--iterations", 3)
    assert not kept.exists()
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
    assert "deconvolution does not help" in run("info", "paper", "--wavelength", "633")


def test_reconstruct_writes_a_volume(tmp_path, run, complaint, capfd):
    camera = PlenopticCamera(detector_width=0.256, resolution=(128, 128))
    raw, out = tmp_path / "raw.exr", tmp_path / "out.tif"
    write_capture(raw, Capture(white_image(camera), camera))
    planes = "--distance", 226, "--distance", 253, "--distance", 280
    options = "--method", "deconvolved", "--iterations", 2, "--volume", "--variation", 0.01
    told = run("reconstruct", raw, "-o", out, *options, *planes)
    assert f"{out}: volume of" in told
    assert not (tmp_path / "out.tif.checkpoint").exists()
    with tifffile.TiffFile(out) as file:
        assert file.imagej_metadata["spacing"] == 27_000 and file.imagej_metadata["slices"] == 3
    uneven = "--distance", 226, "--distance", 253, "--distance", 290
    assert "evenly spaced" in complaint("reconstruct", raw, "-o", out, *options, *uneven)
    assert "variation = 1" in complaint("reconstruct", raw, "-o", out, *planes, *options[:2], "--variation", 1)
    main([str(word) for word in ("reconstruct", raw, "-o", out, *planes, "--resume", "--workers", 2)])
    note = capfd.readouterr().err
    assert note == (
        "mitsuba-plenoptic: warning: method ray has no use for --resume (of deconvolved), --workers (of deconvolved)\n"
    )
