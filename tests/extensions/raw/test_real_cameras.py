"""Raw pictures of real cameras at the command line: Lytro's containers with white pictures, and TIFF with a camera."""

import numpy as np
import pytest
import tifffile
from cameras import colour_filters
from foreign_files import lytro_metadata, write_lytro, write_lytro_white

from mitsuba_plenoptic import Capture, Detector, PlenopticCamera, expose, read_capture
from mitsuba_plenoptic.exchange import read_lytro
from mitsuba_plenoptic.io.exr import read_exr
from mitsuba_plenoptic.views import white_image

COLUMNS, ROWS = 160, 120


def recorded(light, camera):
    """Return the digital numbers of a first Lytro's detector for light in three colours."""
    detector = Detector(mosaic="BGGR", bits=12, black_level=168, gain=1.0, full_well=3927, quantum_efficiency=1.0)
    return np.rint(expose(Capture(light, camera), detector, photons=3927.0).image * 3927 + 168).astype(int)


@pytest.fixture(scope="module")
def lytro(tmp_path_factory):
    """Write a picture of a colour wedge and white pictures; their metadata are a little wrong on the array."""
    folder = tmp_path_factory.mktemp("lytro")
    (folder / "whites").mkdir()
    camera = read_lytro(write_lytro(folder / "a.lfp", np.zeros((ROWS, COLUMNS)), lytro_metadata(COLUMNS, ROWS))).camera
    white, wedge = white_image(camera)[..., None] * 0.8, np.linspace(0.1, 0.9, COLUMNS)[:, None] * [1, 0.6, 0.3]
    metadata = lytro_metadata(COLUMNS, ROWS)
    metadata["devices"]["mla"]["rotation"] += 0.004
    metadata["devices"]["mla"]["sensorOffset"]["x"] += 1.1e-06
    metadata["devices"]["mla"]["lensPitch"] *= 1.003
    write_lytro(folder / "photo.lfr", recorded(white * wedge, camera), metadata)
    write_lytro_white(folder / "whites" / "MOD_0001", recorded(white * np.ones(3), camera), metadata)
    write_lytro_white(folder / "whites" / "MOD_0002", recorded(white * np.ones(3) / 9, camera), metadata)
    return folder, camera, white * wedge


def test_a_white_picture_corrects_the_array(lytro, tmp_path, run):
    folder, camera, true = lytro
    said = run("demosaic", folder / "photo.lfr", "-o", tmp_path / "colours.exr", "--white", folder / "whites")
    assert "MOD_0001.RAW: the white picture of the nearest zoom and focus" in said
    found = read_capture(tmp_path / "colours.exr")
    assert found.camera.mla_pitches == pytest.approx(camera.mla_pitches, rel=1e-4)
    assert found.camera.mla_rotation == pytest.approx(camera.mla_rotation, abs=0.02)
    assert found.camera.mla_offset == pytest.approx(camera.mla_offset, abs=1e-4)
    run("demosaic", folder / "photo.lfr", "-o", tmp_path / "stated.exr")
    stated = read_capture(tmp_path / "stated.exr")
    assert stated.camera == read_lytro(folder / "photo.lfr").camera != found.camera
    errors = [np.abs(each.image - true).mean() for each in (found, stated)]
    assert errors[0] < 0.5 * errors[1] and errors[0] < 0.01


def test_a_mosaic_needs_to_be_demosaiced(lytro, tmp_path, complaint):
    photo = lytro[0] / "photo.lfr"
    for words in (["reconstruct", "--distance", "inf"], ["views"], ["calibrate"]):
        assert "demosaic it first" in complaint(words[0], photo, "-o", tmp_path / "a.png", *words[1:])
    assert "-D: " in complaint("info", photo, "-D", "a=1")
    assert "no white pictures" in complaint("demosaic", photo, "-o", tmp_path / "a.exr", "--white", tmp_path)


def test_a_tiff_file_of_a_mosaic_and_its_camera(tmp_path, run):
    """As industrial cameras, Raytrix's among them, write them: 16 bits, above a black level."""
    camera = PlenopticCamera.preset("raytrix").replace(crop_offset=(2000, 1500), crop_size=(140, 117))
    (tmp_path / "camera.json").write_text(camera.to_json())
    white = white_image(camera)
    light = white[..., None] * [0.2, 0.4, 0.6]
    image = np.take_along_axis(light, colour_filters(camera, "GRBG")[..., None], 2)[..., 0]
    tifffile.imwrite(tmp_path / "raw.tiff", np.uint16(256 + np.rint(image * 60000)))
    colours, words = tmp_path / "colours.exr", ["--mosaic", "GRBG", "--black-level", "256", "--linear"]
    run("demosaic", tmp_path / "raw.tiff", "-o", colours, "--camera", tmp_path / "camera.json", *words)
    found = read_capture(colours).image
    # At the borders of the picture a colour may be unknown.
    np.testing.assert_allclose(found[2:-2, 2:-2], (light * 60000 / (65535 - 256))[2:-2, 2:-2], atol=2e-3)
    run("reconstruct", colours, "-o", tmp_path / "out.exr", "--distance", "600")
    out = read_exr(tmp_path / "out.exr")[0]
    reached = out[np.isfinite(out).reshape(*out.shape[:2], -1).all(2)]
    low, middle, high = np.quantile(reached / reached.mean(0), [0.1, 0.5, 0.9])
    assert 0.92 * middle < low and high < 1.08 * middle
