"""Raw pictures of real cameras: Lytro's containers, mosaics and their white pictures."""

import functools
import json
import math
import random
import re

import numpy as np
import pytest
from foreign_files import lytro_metadata, write_lytro, write_lytro_white
from refusals import refuses

from mitsuba_plenoptic import Capture, Detector, InputError, expose, read_capture
from mitsuba_plenoptic.exchange import nearest_white, read_lytro
from mitsuba_plenoptic.views import white_image
from mitsuba_plenoptic.views.grid import micro_image_centres

COLUMNS, ROWS = 120, 90


def numbers_of(bits, seed=0):
    return np.random.default_rng(seed).integers(0, 2**bits, (ROWS, COLUMNS))


@pytest.mark.parametrize("bits, black, white, tile, name", [(12, 168, 4095, "r", "RGGB"), (10, 64, 1023, "gb", "GBRG")])
def test_pixels_and_header(bits, black, white, tile, name, tmp_path):
    numbers, metadata = numbers_of(bits), lytro_metadata(COLUMNS, ROWS, bits=bits, upper_left=tile)
    numbers[0, :2] = white, black
    found = read_lytro(write_lytro(tmp_path / "photo.LFR", numbers, metadata))
    np.testing.assert_allclose(found.image, (numbers - black) / (white - black), atol=1e-6)
    assert found.image[0, 0] == 1 and found.image[0, 1] == 0
    record = found.metadata["raw"]
    assert record["devices"] == metadata["devices"] and record["image"] == metadata["image"]
    assert record["mosaic"] == name
    assert record["saturated_pixels"] == np.count_nonzero(numbers >= white)


def test_levels_of_the_filters_and_the_published_order_of_bits(tmp_path):
    """FF F0 00 is a white pixel and a black one, 12 34 56 are 123 and 456."""
    metadata = lytro_metadata(2, 2, upper_left="gr")
    levels = metadata["image"]["rawDetails"]["pixelFormat"]
    levels["black"] = {"gr": 0, "r": 0, "b": 0x23, "gb": 0}
    levels["white"] = {"gr": 0xFFF, "r": 1, "b": 0x223, "gb": 0x456}
    (tmp_path / "a.TXT").write_text(json.dumps({"picture": {"frameArray": [{"frame": {"metadata": metadata}}]}}))
    (tmp_path / "a.RAW").write_bytes(bytes.fromhex("FFF000123456"))
    found = read_lytro(tmp_path / "a.RAW")
    assert found.metadata["raw"]["mosaic"] == "GRBG"
    np.testing.assert_allclose(found.image, [[1, 0], [0.5, 1]])


@pytest.mark.parametrize("tiling", ["hexUniformRowMajor", "squareUniform"])
@pytest.mark.parametrize("pupil", [0.1163, 0.0])
def test_micro_images_lie_where_the_metadata_put_them(tiling, pupil, tmp_path):
    """A lens is centred `sensorOffset` from the middle, the others pitches aside, as seen from the exit pupil."""
    metadata = lytro_metadata(COLUMNS, ROWS)
    metadata["devices"]["mla"]["tiling"] = tiling
    metadata["devices"]["lens"]["exitPupilOffset"]["z"] = pupil
    camera = read_lytro(write_lytro(tmp_path / "a.lfp", numbers_of(12), metadata)).camera
    assert camera.resolution == (COLUMNS, ROWS) and camera.pixel_size == pytest.approx(1.4e-3)
    assert camera.f_number == pytest.approx(1.92) and camera.detector_distance == pytest.approx(0.025)
    assert math.isinf(camera.focus_distance)
    pitch = 10 * (1 + (2.5e-5 / pupil if pupil else 0))
    row, column = np.mgrid[-9:10, -12:13].astype(float)
    if tiling == "hexUniformRowMajor":
        column, row = column + row / 2, row * math.sqrt(0.75)
    turn, x, y = complex(math.cos(0.0021), -math.sin(0.0021)), pitch * column, 1.0005 * pitch * row
    centres = (turn * (x + 1j * y)).ravel() + (COLUMNS / 2 + 3.1 / 1.4) + 1j * (ROWS / 2 - 2.6 / 1.4)
    found = micro_image_centres(camera, 0)
    inside = centres[(centres.real > 0) & (centres.real < COLUMNS) & (centres.imag > 0) & (centres.imag < ROWS)]
    assert len(found) == len(inside)
    assert np.abs(found[:, 0] + 1j * found[:, 1] - inside[:, None]).min(0).max() < 1e-9


def test_the_nearest_white_picture(tmp_path):
    dim = numbers_of(12) // 8 + 168
    for name, zoom, focus, factor in (
        ("a", 500, 801, 1), ("b", 610, 300, 1), ("c", 610, 790, 1), ("d", 610, 790, 3), ("e", 610, 790, 9),
    ):  # fmt: skip
        metadata = lytro_metadata(COLUMNS, ROWS, zoom=zoom, focus=focus)
        write_lytro_white(tmp_path / name, np.minimum(factor * dim, 4095), metadata)
    photo = read_lytro(write_lytro(tmp_path / "photo.lfp", numbers_of(12), lytro_metadata(COLUMNS, ROWS)))
    (tmp_path / "photo.lfp").unlink()
    assert nearest_white(tmp_path, photo).name == "d.RAW"
    (tmp_path / "d.TXT").unlink()
    (tmp_path / "empty").mkdir()
    unknown = Capture(np.zeros((ROWS, COLUMNS)), photo.camera)
    for folder, capture, words in (
        ("", photo, "d.RAW: its metadata are not next to it, in d.txt"),
        ("", unknown, "capture: .* devices.lens.zoomStep"),
        ("none", photo, "none: there is no such folder"),
        ("empty", photo, "empty: it has no white pictures"),
    ):
        refuses(words, nearest_white, tmp_path / folder, capture)


def changed(name, value):
    """Return metadata with another value by its name with dots, or without it."""
    metadata = lytro_metadata(COLUMNS, ROWS)
    *parents, last = name.split(".")
    group = functools.reduce(dict.__getitem__, parents, metadata)
    group[last] = value
    if value is None:
        del group[last]
    return metadata


@pytest.mark.parametrize(("name", "value", "rule"), [
    ("devices.mla.lensPitch", None, "its metadata have no devices.mla.lensPitch"),
    ("devices.mla.tiling", "penrose", "devices.mla.tiling = 'penrose'"),
    ("image.width", 121, "image: 16200 bytes for 121 x 90 pixels"),
    ("image.rawDetails.pixelPacking.bitsPerPixel", 14, "image.rawDetails.pixelPacking: 14 bits"),
    ("image.rawDetails.pixelFormat.rightShift", 4, "image.rawDetails.pixelFormat.rightShift = 4"),
    ("image.rawDetails.pixelFormat.white.gb", 168, "image.rawDetails.pixelFormat: white"),
    ("image.rawDetails.mosaic.tile", "x", "image.rawDetails.mosaic.tile = 'x'"),
])  # fmt: skip
def test_metadata_that_are_not_understood(name, value, rule, tmp_path):
    pixels = write_lytro_white(tmp_path / "b", numbers_of(12), lytro_metadata(COLUMNS, ROWS))
    text = {"master": {"picture": {"frameArray": [{"frame": {"metadata": changed(name, value)}}]}}}
    pixels.with_suffix(".TXT").write_text(json.dumps(text))
    refuses(f"^{re.escape(f'{pixels}: {rule}')}", read_lytro, pixels)


def test_files_for_the_web_have_no_raw_picture(tmp_path):
    path = write_lytro(tmp_path / "a.lfp", numbers_of(12), lytro_metadata(COLUMNS, ROWS))
    content = path.read_bytes()
    cuts = {"no raw picture": content[: content.index(b"\x89LFC")], "no sections": content[:16]}
    for words, cut in (cuts | {"does not begin as a Lytro container": b"\x89PNG"}).items():
        path.write_bytes(cut)
        refuses(f"a.lfp: .*{words}", read_lytro, path)


@pytest.mark.parametrize("bits", [12, 10])
def test_cut_and_damaged_containers(bits, tmp_path):
    """Whatever is cut off or flipped: one line with the file's name, or the same picture."""
    path = tmp_path / "a.lfr"
    content = write_lytro(path, np.arange(64).reshape(8, 8), lytro_metadata(8, 8, bits=bits)).read_bytes()
    whole, draw, refused = read_lytro(path), random.Random(bits), 0
    for _ in range(100):
        damaged = bytearray(content)
        if draw.random() < 0.3:
            del damaged[draw.randrange(len(damaged)) :]
        else:
            for _ in range(draw.choice([1, 1, 5])):
                damaged[draw.randrange(len(damaged))] = draw.randrange(256)
        path.write_bytes(damaged)
        try:
            assert (read_lytro(path).image == whole.image).all()
        except InputError as error:
            assert str(error).startswith(f"{path}: ") and "\n" not in str(error)
            refused += 1
    assert refused > 60


ACROSS, DOWN = 160, 120


def recorded(light, camera):
    """Return the digital numbers of a first Lytro's detector for light in three colours."""
    detector = Detector(mosaic="BGGR", bits=12, black_level=168, gain=1.0, full_well=3927, quantum_efficiency=1.0)
    return np.rint(expose(Capture(light, camera), detector, photons=3927.0).image * 3927 + 168).astype(int)


@pytest.fixture(scope="module")
def lytro(tmp_path_factory):
    """Write a picture of a colour wedge and white pictures; their metadata are a little wrong on the array."""
    folder = tmp_path_factory.mktemp("lytro")
    (folder / "whites").mkdir()
    camera = read_lytro(write_lytro(folder / "a.lfp", np.zeros((DOWN, ACROSS)), lytro_metadata(ACROSS, DOWN))).camera
    white, wedge = white_image(camera)[..., None] * 0.8, np.linspace(0.1, 0.9, ACROSS)[:, None] * [1, 0.6, 0.3]
    metadata = lytro_metadata(ACROSS, DOWN)
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
    assert found.metadata["raw"]["demosaiced"] == "BGGR"
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
    for words in (["reconstruct", "--distance", "inf"], ["views"]):
        assert "demosaic it first" in complaint(words[0], photo, "-o", tmp_path / "a.png", *words[1:])
    assert "demosaic it first" in complaint("calibrate", "centres", photo, "-o", tmp_path / "a.csv")
    assert "-D: " in complaint("info", photo, "-D", "a=1")
    assert "no white pictures" in complaint("demosaic", photo, "-o", tmp_path / "a.exr", "--white", tmp_path)
