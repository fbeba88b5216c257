"""Mosaics of colour filters: which pixel records what, and what demosaicking makes of micro-images."""

import dataclasses

import numpy as np
import pytest
import tifffile
from cameras import colour_filters
from refusals import refused, refuses

import mitsuba_plenoptic as mp

from mitsuba_plenoptic import demosaic, write_capture  # isort: skip
from mitsuba_plenoptic.views import white_image

CAMERA = mp.PlenopticCamera(resolution=(256, 256), detector_width=0.512)
PERFECT = {"quantum_efficiency": 1, "read_noise": 0, "bits": 16, "full_well": 6e4, "black_level": 0}


def coloured(camera, seed=0):
    """A capture in which every lens sees another colour, as it does of a plane in focus on the array."""
    to_lenses = camera.mla_distance / (camera.mla_distance + camera.detector_distance)
    i, j = camera.lattice.cell(*np.meshgrid(*(camera.pixel_coordinates(axis) * to_lenses for axis in (0, 1))))
    lens = np.unique(1000 * np.rint(i) + np.rint(j), return_inverse=True)[1].reshape(camera.shape)
    colours = np.random.default_rng(seed).uniform(0.05, 1, (lens.max() + 1, 3))
    return mp.Capture(colours[lens] * white_image(camera)[..., None], camera, (610.0, 550.0, 460.0), "wave")


def mosaicked(capture, mosaic="RGGB"):
    """The same without noise, through filters."""
    image = np.take_along_axis(capture.image, colour_filters(capture.camera, mosaic)[..., None], 2)[..., 0]
    return mp.Capture(image, capture.camera)


CROP = {"crop_offset": (35, 53), "crop_size": (192, 194)}


@pytest.mark.parametrize(("mosaic", "crop"), [("RGGB", {}), ("BGGR", CROP), ("GRBG", CROP), ("GBRG", {})])
def test_expose_through_a_mosaic(mosaic, crop, tmp_path):
    """Each pixel has its channel's value, to a digital number and the photons' noise; the file remembers it."""
    given = coloured(CAMERA.replace(**crop))
    raw = mp.expose(given, mp.Detector(mosaic=mosaic, **PERFECT), photons=5e4)
    assert raw.image.ndim == 2 and raw.wavelength is None
    assert np.abs(raw.image - mosaicked(given, mosaic).image).max() < 6 / np.sqrt(5e4)
    write_capture(tmp_path / "raw.exr", raw)
    back = demosaic(mp.read_capture(tmp_path / "raw.exr"), white=mp.Capture(white_image(given.camera), given.camera))
    assert back.wavelength == given.wavelength and back.image.shape == given.image.shape
    assert back.metadata["exposure"]["mosaic"] is None and back.metadata["exposure"]["demosaiced"] == mosaic
    refuses(f"mosaic = {mosaic}: ", mp.reconstruct, raw, 240)
    refuses(f"mosaic = {mosaic}: ", mp.decode, raw)
    refuses(f"mosaic = {mosaic}: ", mp.expose, raw, mp.Detector(), photons=100)


@pytest.mark.parametrize(
    "change",
    [
        {"mla_lattice": "hexagonal", "mla_rotation": 7.0},
        {"resolution": (96, 96)},
        {"crop_offset": (33, 20), "crop_size": (150, 131)},
        {"aperture_radius": 7.4},
    ],
    ids=["hexagonal", "few pixels", "crop", "touching"],
)
def test_colours_do_not_bleed_over_borders_of_micro_images(change):
    """Micro-images of even colours come back to 1e-5, where plain bilinear interpolation mixes neighbours."""
    given = coloured(CAMERA.replace(**change))
    found, plain = (demosaic(mosaicked(given), mosaic="RGGB", method=m).image for m in ("micro-images", "plain"))
    lit = white_image(given.camera) > 0.02
    # Corners of small crops can lack a colour.
    known = lit & (np.abs(found - given.image).max(axis=2) < 1e-5)
    assert known.sum() / lit.sum() > 0.999
    errors = [np.abs(image - given.image).max(axis=2)[lit].mean() for image in (plain, found)]
    assert errors[0] > 20 * errors[1]
    assert np.abs(plain - given.image)[lit].max() > 0.1


def test_cut_micro_images_get_the_colours_they_lack():
    """An even coloured world reads even in each bin, also where a border leaves a lens no pixel of a colour."""
    camera = CAMERA.replace(resolution=(64, 64), crop_offset=(9, 0), crop_size=(51, 50))
    colours = np.array([0.9, 0.35, 0.12])
    given = mp.Capture(white_image(camera)[..., None] * colours, camera)
    found = demosaic(mosaicked(given), mosaic="RGGB")
    np.testing.assert_allclose(found.image, given.image, atol=1e-5)
    seen = np.isfinite(mp.reconstruct(given, 300.0).image)
    np.testing.assert_allclose(mp.reconstruct(found, 300.0).image, np.where(seen, colours, np.nan), atol=1e-4)


def test_a_gradient_in_a_micro_image():
    """A slope of radiance over the pupil is kept in the middle of micro-images, as bilinear interpolation keeps it."""
    x = np.broadcast_to(CAMERA.pixel_coordinates(0), CAMERA.shape)
    given = mp.Capture((1 + 2 * x[..., None] * np.array([1, -0.5, 0.3])) * white_image(CAMERA)[..., None], CAMERA)
    inside = white_image(CAMERA) == 1
    found = demosaic(mosaicked(given, "GRBG"), mosaic="GRBG").image
    # Within two pixels of a rim neighbours are on one side only.
    assert np.abs(found - given.image)[inside].max() < 0.012
    assert np.abs(found - given.image)[inside].mean() < 5e-4


def test_white_of_its_own():
    """A white capture takes the place of the computed one; colours of the lamp and the filters are its own."""
    white = white_image(CAMERA)[..., None] * np.array([0.6, 1.0, 0.8])
    given = dataclasses.replace(coloured(CAMERA), image=coloured(CAMERA).image * [0.6, 1.0, 0.8])
    found = demosaic(mosaicked(given), mosaic="RGGB", white=mp.Capture(white, CAMERA)).image
    assert (np.abs(found - given.image).max(axis=2)[white_image(CAMERA) > 0.02] < 1e-5).mean() > 0.999


test_mistakes = refused(
    (lambda: demosaic(coloured(CAMERA), mosaic="RGGB"), "capture of 3 channels: "),
    (lambda: demosaic(mosaicked(coloured(CAMERA))), "mosaic = None: "),
    (lambda: mp.expose(mosaicked(coloured(CAMERA)), mp.Detector(mosaic="RGGB"), photons=9), "mosaic = RGGB: "),
)


def test_the_commands(tmp_path, run, complaint, mistake):
    mistake("demosaic {raw} -o {raw} --mosaic RGGB", "it is read, and would be lost")
    mistake("demosaic {raw} -o {out}.exr --mosaic RGGB --linear", "--linear: ")
    mistake("demosaic {raw} -o {out}.exr --mosaic RGGG", "did you mean RGGB?")
    colours, bayer, back = (tmp_path / name for name in ("colours.exr", "bayer.exr", "back.exr"))
    # By rays, as the white of a wave capture takes seconds.
    write_capture(colours, mp.Capture(coloured(CAMERA).image, CAMERA))
    run("expose", colours, "-o", bayer, "--photons", "5000", "--mosaic", "BGGR")
    assert "256 x 256 pixels of three colours" in run("demosaic", bayer, "-o", back)
    assert mp.read_capture(back).image.shape == (256, 256, 3)
    assert "capture of 3 channels" in complaint("demosaic", back, "-o", tmp_path / "again.exr")
    # A raw picture of a camera in a file, as industrial cameras write them: 16 bits, above a black level.
    (tmp_path / "camera.json").write_text(CAMERA.to_json())
    tifffile.imwrite(tmp_path / "raw.tiff", np.uint16(256 + np.rint(mosaicked(coloured(CAMERA)).image * 60000)))
    options = ["--camera", tmp_path / "camera.json", "--linear", "--mosaic", "RGGB", "--black-level", "256"]
    run("demosaic", tmp_path / "raw.tiff", "-o", back, *options)
    found = mp.read_capture(back).image / (60000 / (65535 - 256))
    assert np.abs(found - coloured(CAMERA).image)[white_image(CAMERA) > 0.02].mean() < 1e-4


@pytest.mark.slow
def test_a_wave_capture_keeps_its_light_by_its_own_white():
    """White by rays, to which light between micro-images is unknown, keeps 0.96 to 0.98 of it."""
    camera = mp.PlenopticCamera(detector_width=0.512, resolution=(128, 128))
    sky = {"type": "scene", "integrator": {"type": "direct"}, "sky": {"type": "constant"}}
    scene = mp.load_scene(sky | {"camera": camera.to_sensor()}, variant="llvm_ad_mono")
    waves = [mp.render_capture(scene, model="wave", spp=256, wavelength=light) for light in (610.0, 550.0, 460.0)]
    colours = mp.Capture(np.stack([each.image for each in waves], -1), camera, (610.0, 550.0, 460.0), "wave")
    back = demosaic(mp.expose(colours, mp.Detector(mosaic="RGGB", full_well=1e6, bits=16), photons=1e6))
    np.testing.assert_allclose(back.image.sum((0, 1)) / colours.image.sum((0, 1)), 1, atol=2e-3)
    assert np.linalg.norm(back.image - colours.image) < 0.01 * np.linalg.norm(colours.image)
