"""Captures on disk."""

import json
import re
from functools import partial
from pathlib import Path

import make_examples
import numpy as np
import OpenEXR
import PIL
import pytest
import tifffile
import xarray as xr
from cameras import small_camera
from PIL import Image
from refusals import refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import Capture, Detector, InputError, PlenopticCamera, expose, read_capture, write_capture
from mitsuba_plenoptic.io import exr, read_picture
from mitsuba_plenoptic.refocus import Volume


@pytest.fixture
def camera():
    return PlenopticCamera(
        detector_width=0.128, resolution=(64, 48), crop_offset=(8, 4), crop_size=(40, 32), lens_model="parabolic"
    )


def test_a_capture_in_colour_survives_the_disk(tmp_path, camera):
    image = np.random.default_rng(1).random((32, 40, 3), dtype=np.float32)
    path, wavelength = tmp_path / "raw.exr", (610.0, 550.0, 465.0)
    write_capture(path, Capture(image, camera, wavelength, "wave", {"seed": 3, "scene": 'ä "quoted"'}))
    read = read_capture(path)
    np.testing.assert_array_equal(read.image, image)
    assert (read.camera, read.wavelength, read.model) == (camera, wavelength, "wave")
    assert read.metadata == {"seed": 3, "scene": 'ä "quoted"'}
    assert list(tmp_path.iterdir()) == [path]


def test_files_stand_for_captures_and_white(tmp_path):
    camera = small_camera(4)
    capture = Capture(np.random.default_rng(0).random(camera.shape), camera)
    white = Capture(0.5 + np.abs(np.sin(np.arange(128))) * np.ones((128, 1)), camera)
    paths = tmp_path / "raw.exr", tmp_path / "white.exr"
    for path, one in zip(paths, (capture, white), strict=True):
        write_capture(path, one)
    for work in (partial(mp.reconstruct, distance=240), mp.decode):
        np.testing.assert_array_equal(work(str(paths[0]), white=paths[1]), work(capture, white=white))


def test_any_viewer_sees_the_window_and_the_pixels(tmp_path, camera):
    write_capture(tmp_path / "raw.exr", Capture(np.ones((32, 40)), camera))
    with OpenEXR.File(str(tmp_path / "raw.exr")) as file:
        header = file.header()
        assert [tuple(corner) for corner in header["dataWindow"]] == [(8, 4), (47, 35)]
        assert [tuple(corner) for corner in header["displayWindow"]] == [(0, 0), (63, 47)]
        assert file.channels()["Y"].pixels.dtype == np.float32


@pytest.mark.parametrize("within", ["read_parts", "require_seal"])
def test_a_capture_that_another_process_replaces_meanwhile_is_read_again(tmp_path, monkeypatch, within):
    """The header of one file and the pixels of another would be damaged, or silently mixed."""
    path = tmp_path / "raw.exr"
    of_size = {size: Capture(np.ones((size, size)), small_camera(size // 32)) for size in (64, 32)}
    write_capture(path, of_size[64])
    step = getattr(exr, within)

    def replaced(*arguments):
        result = step(*arguments)
        monkeypatch.setattr(exr, within, step)
        write_capture(path, of_size[32])
        return result

    monkeypatch.setattr(exr, within, replaced)
    assert read_capture(path).image.shape == (32, 32)
    path.write_bytes(path.read_bytes()[:-40])
    refuses("damaged", read_capture, path)


DISTANCES = (210, 240, 280)
NAMES = ("letters-ray", "letters-wave", "white")
FOLDER = Path(mp.__file__).parent / "examples"


def test_names_and_files_agree():
    """The wheel may grow by 2 MB."""
    files = sorted(FOLDER.iterdir())
    wanted = [f"{name}{suffix}" for name in NAMES for suffix in (".exr", ".truth.exr")]
    assert [file.name for file in files] == sorted(wanted)
    assert sum(file.stat().st_size for file in files) < 2e6
    assert tuple(make_examples.CAPTURES) == NAMES
    refuses("^example = 'letters': ", mp.example, "letters")
    refuses(r"^example = '\.\./scenes/white': ", mp.example_truth, "../scenes/white")


def test_the_white_scene_has_the_closed_form():
    """A wall of radiance 1 fills the image of the pupil, of radius R f / b, behind each lens."""
    white = mp.example("white")
    camera = white.camera
    radius = camera.aperture_radius * camera.detector_distance / camera.mla_distance
    disc = np.pi * radius**2 / camera.mla_pitch**2
    assert white.image.mean() == pytest.approx(disc, rel=2e-3)
    assert white.image.max() == 1


def test_each_letter_is_sharp_at_its_distance(name="letters-wave", loss=0.15):
    """Its radiance is 1 there, less what diffraction takes from its strokes, and elsewhere it is blurred."""
    depth = mp.example_truth(name).views["depth"]
    seen = depth[depth.shape[0] // 2, depth.shape[1] // 2]
    found = mp.reconstruct(mp.example(name), DISTANCES, white=mp.example("white"))
    for distance in DISTANCES:
        means = {one.distance: float(one.image[seen == distance].mean()) for one in found}
        peaks = {one.distance: float(one.image[seen == distance].max()) for one in found}
        assert 1 - loss < peaks[distance] < 1.001
        assert all(means[distance] > 1.4 * means[other] for other in DISTANCES if other != distance)


def test_the_tool_makes_them(tmp_path, monkeypatch):
    monkeypatch.setattr(make_examples, "SAMPLES", 2)
    make_examples.write_example(tmp_path / "white.exr", *make_examples.CAPTURES["white"])
    made, packed = mp.read_capture(tmp_path / "white.exr"), mp.example("white")
    assert made.image.mean() == pytest.approx(packed.image.mean(), rel=2e-3)
    assert made.camera == packed.camera
    np.testing.assert_array_equal(made.image * 2**14 % 1, 0)
    truth, kept = mp.read_ground_truth(tmp_path / "white.truth.exr"), mp.example_truth("white")
    np.testing.assert_array_equal(truth.pixels["depth"], kept.pixels["depth"])
    assert made.metadata | {"spp": 64, "software": 0} == packed.metadata | {"software": 0}


def test_command(tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    run("example", "letters-wave", "-o", "raw.exr")
    read, packed = read_capture("raw.exr"), mp.example("letters-wave")
    np.testing.assert_array_equal(read.image, packed.image)
    assert read.metadata == packed.metadata | {"ground_truth": "raw.truth.exr"} and read.camera == packed.camera
    truth, known = mp.read_ground_truth("raw.truth.exr"), mp.example_truth("letters-wave")
    np.testing.assert_array_equal(truth.views["depth"], known.views["depth"])


RAMP = np.linspace(0.1, 0.9, 32).reshape(4, 8)
COLOURS = np.stack([RAMP, RAMP / 2, RAMP / 4], -1)
FOUR = mp.PlenopticCamera(detector_width=0.256, resolution=(64, 64))


@pytest.mark.parametrize(("numbers", "options", "expected"), [
    (RAMP.astype("f4"), {}, RAMP),
    ((4000 * RAMP).astype("f8"), {}, 4000 * RAMP),
    ((RAMP * 65535).astype(">u2"), {"byteorder": ">"}, (RAMP * 65535).astype("u2") / 65535),
    ((RAMP * 1e9).astype("u4"), {"bigtiff": True}, (RAMP * 1e9).astype("u4") / (2**32 - 1)),
    ((RAMP * 255).astype("u1"), {"photometric": "miniswhite"}, 1 - (RAMP * 255).astype("u1") / 255),
    (np.moveaxis(COLOURS, 2, 0).astype("f4"), {"photometric": "rgb", "planarconfig": "separate"}, COLOURS),
])  # fmt: skip
def test_samples_of_tiff_mean_what_they_say(tmp_path, numbers, options, expected):
    tifffile.imwrite(tmp_path / "a.tiff", numbers, **options)
    np.testing.assert_allclose(read_picture(tmp_path / "a.tiff", linear=True), expected, rtol=1e-6)


@pytest.mark.parametrize(("mode", "same"), [("P", "RGB"), ("1", "L")])
def test_a_bmp_means_what_the_same_png_means(tmp_path, mode, same):
    picture = Image.fromarray((COLOURS * 255).astype("u1")).convert(mode)
    picture.save(tmp_path / "a.bmp")
    picture.convert(same).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_picture(tmp_path / "a.bmp"), read_picture(tmp_path / "a.png"))
    camera = FOUR.replace(crop_offset=(0, 0), crop_size=(8, 4))
    assert read_capture(tmp_path / "a.bmp", camera=camera).image.shape[:2] == (4, 8)
    (tmp_path / "a.bmp").write_bytes((tmp_path / "a.bmp").read_bytes()[:-9])
    refuses("a.bmp: it cannot be read as a picture", read_picture, tmp_path / "a.bmp")


@pytest.mark.needs_extension("raw")
def test_folders_of_views_and_old_files_of_hci_become_mosaics(tmp_path):
    views = np.random.default_rng(2).integers(0, 256, (3, 3, 8, 10, 3), np.uint8)
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "lf.h5", "w") as file:
        file["LF"] = views
    for i, view in enumerate(views.reshape(9, 8, 10, 3)):
        Image.fromarray(view).save(tmp_path / f"out_{i // 3:02}_{i % 3:02}_.png")
    refuses("folder of 9 pictures.* -tile 3x .*and give views.png with views", mp.exchange.open_light_field, tmp_path)
    with pytest.raises(InputError) as caught:
        mp.exchange.open_light_field(tmp_path / "lf.h5")
    step = re.search(r"mosaic, (.*?); give", str(caught.value))[1].replace("views.png", str(tmp_path / "m.png"))
    exec(step, {"LF": views, "PIL": PIL})
    lf = mp.exchange.open_light_field(tmp_path / "m.png", views=3, linear=True)
    np.testing.assert_allclose(lf.isel(v=2, u=1), views[2, 1] / 255, rtol=1e-6)


def test_numpy_takes_the_image_of_a_result():
    capture = Capture(np.random.default_rng(0).random((64, 64, 3)), FOUR)
    result = mp.reconstruct(capture, 240)
    volume = Volume(np.ones((2, 3, 4), np.float32), (210.0, 230.0), 0.03)
    for taken, array in ((capture, capture.image), (result, result.image), (volume, volume.values)):
        assert np.shares_memory(np.asarray(taken), array) and not np.shares_memory(np.array(taken), array)
        assert np.asarray(taken, "f8").dtype == np.float64
        np.testing.assert_array_equal(np.asarray(taken, np.float64), array)


def test_plain_exr_is_a_raw_picture_of_a_given_camera(tmp_path):
    image, path = np.random.default_rng(0).random((70, 72, 3), dtype=np.float32), tmp_path / "a.exr"
    planes = {f"beauty.{name}": np.ascontiguousarray(image[..., i]) for i, name in enumerate("RGB")}
    header = {"dataWindow": np.array([(-3, -2), (68, 67)], "i4"), "displayWindow": np.array([(0, 0), (63, 63)], "i4")}
    OpenEXR.File({name: tuple(window) for name, window in header.items()}, planes).write(str(path))
    cut = FOUR.replace(crop_offset=(8, 16), crop_size=(32, 24))
    np.testing.assert_array_equal(read_capture(path, camera=cut).image, image[18:42, 11:43])
    refuses("so its camera is unknown; give camera", read_capture, path)
    header["displayWindow"] += (20, 0)
    OpenEXR.File({name: tuple(window) for name, window in header.items()}, planes).write(str(path))
    refuses("does not cover the 64 x 64 of the detector", read_capture, path, camera=FOUR)


def test_units_of_phase_screens_are_converted():
    waves = np.arange(64.0).reshape(8, 8) / 64
    for unit, size in {"m": 633e-9, "micron": 0.633, "nm": 633.0, "radian": 2 * np.pi, "waves": 1.0}.items():
        given = xr.DataArray(size * waves.T, dims=("x", "y"), attrs={"units": unit})
        np.testing.assert_allclose(mp.PhaseScreen(given, width=12).waves, waves, rtol=1e-6)
    with pytest.raises(InputError, match="'Jy'"):
        mp.PhaseScreen(xr.DataArray(waves, dims=("y", "x"), attrs={"units": "Jy"}), width=12)


def test_units_in_fits_are_converted(tmp_path):
    fits = pytest.importorskip("astropy.io.fits")
    waves = np.arange(64.0).reshape(8, 8) / 64
    hdu = fits.PrimaryHDU(waves * 2 * np.pi)
    hdu.header["BUNIT"], hdu.header["WAVELEN"] = "radians", 550e-9
    hdu.writeto(tmp_path / "a.fits")
    np.testing.assert_allclose(mp.PhaseScreen(tmp_path / "a.fits", width=12).waves, waves * 550 / 633, rtol=1e-6)


def test_names_are_followed_and_buffers_copied():
    image = np.random.default_rng(0).random((64, 64), dtype=np.float32)
    labelled = xr.DataArray(image, dims=("y", "x"))
    np.testing.assert_array_equal(Capture(labelled.transpose("x", "y"), FOUR).image, image)
    with pytest.raises(InputError, match=r"\('lat', 'lon'\)"):
        Capture(xr.DataArray(image, dims=("lat", "lon")), FOUR)
    kept = Capture(image, FOUR)
    image[:] = -1
    assert kept.image.min() >= 0


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_a_mosaic_comes_back_as_it_was(tmp_path, camera, suffix):
    """The numbers are those that other programs see: 12 bits, black where it is dark. Colours go to TIFF alone."""
    given = Capture(np.random.default_rng(0).random((32, 40, 3)), camera)
    raw = expose(given, Detector(mosaic="GBRG", bits=12, dark_electrons=3.0), photons=9000, seed=2)
    path = tmp_path / f"raw{suffix}"
    mp.write_raw(path, raw)
    back = read_capture(path)
    np.testing.assert_allclose(back.image, raw.image, atol=1e-6)
    assert back.camera == raw.camera and back.metadata == json.loads(json.dumps(raw.metadata))
    seen = np.asarray(Image.open(path)) if suffix == ".png" else tifffile.imread(path)
    assert seen.dtype == np.uint16 and seen.shape == (32, 40) and 40 < seen.max() <= 4095
    colours = expose(given, Detector(), photons=2000)
    if suffix == ".png":
        refuses(r"raw pictures of three channels are written as .tiff", mp.write_raw, path, colours)
    else:
        mp.write_raw(path, colours)
        np.testing.assert_allclose(read_capture(path).image, colours.image, atol=1e-6)
