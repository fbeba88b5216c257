"""Centres of micro-images in white images that are drawn from closed forms."""

import json
import math

import numpy as np
import pytest
from refusals import refuses

from mitsuba_plenoptic import Capture, PlenopticCamera, write_capture
from mitsuba_plenoptic.calibration import find_centres, read_centres, write_centres
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.extensions.calibrate.detect import camera_centres
from mitsuba_plenoptic.views import LensGrid, lens_grid, white_image

PITCH, ROTATION, PHOTONS = 16.37, 0.3, 2000


def drawn(shifted, diameters, brightness=lambda x, y: 1.0):
    """Return discs over 24 x 24 lenses, whose light falls off from place to place, their centres, and the pitches."""
    pitches = (PITCH, math.sqrt(0.75) * PITCH if shifted is not None else PITCH)
    grid = LensGrid(pitches, (-12.3, -17.6), (int(25 * PITCH / pitches[1]) + 2, 27), math.radians(ROTATION), shifted)
    centres = grid.centres().reshape(-1, 2)
    image = np.zeros((4 * 390, 4 * 395))
    y, x = (np.indices(image.shape) + 0.5) / 4
    for number, (cx, cy) in enumerate(centres):
        rows, columns = (slice(max(0, int(4 * (c - 12))), max(0, int(4 * (c + 12)))) for c in (cy, cx))
        away = np.hypot(x[rows, columns] - cx, y[rows, columns] - cy)
        image[rows, columns] += (4 * (diameters[number % len(diameters)] / 2 - away) + 0.5).clip(0, 1)
    image *= brightness(x / 395 * 2 - 1, y / 390 * 2 - 1)
    return 0.98 * image.reshape(390, 4, 395, 4).mean((1, 3)) + 0.02, centres, pitches


@pytest.mark.parametrize(("shifted", "diameters"), [(None, (14.0, 13.4, 13.7)), (0, (14.0,)), (1, (14.0, 13.4, 13.7))])
def test_centres_are_found(shifted, diameters, tmp_path):
    image, true, _ = drawn(shifted, diameters)
    found = find_centres(np.random.default_rng(0).poisson(PHOTONS * image) / PHOTONS)
    assert len(found.pixel) > 300
    off = found.pixel[:, None] + 0.5 - true
    error = off[np.arange(len(off)), np.hypot(*off.transpose(2, 0, 1)).argmin(1)]
    assert np.sqrt((error**2).sum(1).mean()) < 0.05
    assert np.abs(error).max() < 0.2
    assert found.grid.spacing[0] == pytest.approx(PITCH, rel=1e-4)
    assert math.degrees(found.grid.rotation) == pytest.approx(ROTATION, abs=2e-3)
    assert found.light.max() == 1
    path = tmp_path / "centres.csv"
    write_centres(path, found)
    np.testing.assert_allclose(read_centres(path).pixel, found.pixel, atol=1e-4)


FADED = {
    "off the middle, hexagonal": (0.855, 0, lambda x, y: 0.25 ** (((x - 0.4) ** 2 + (y + 0.3) ** 2) / 3.65)),
    "along one axis, touching": (1.0, None, lambda x, y: 0.25 ** (0.85 * x * x + 0.15 * y * y)),
    "polynomial, gaps": (0.6, None, lambda x, y: 1 - 0.45 * (x * x + y * y) / 2 - 0.3 * (x * x + y * y) ** 2 / 4),
    "overlapping": (1.1, 0, lambda x, y: 0.25 ** ((x * x + y * y) / 2)),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name != "off the middle, hexagonal")) for name in FADED]
)
def test_centres_do_not_follow_the_fall_off(name):
    fill, shifted, brightness = FADED[name]
    light, _, pitches = drawn(shifted, (fill * PITCH,), brightness)
    found = find_centres(np.random.default_rng(2).poisson(PHOTONS * light) / PHOTONS)
    np.testing.assert_allclose(found.grid.spacing, pitches, rtol=1e-5)
    assert math.degrees(found.grid.rotation) == pytest.approx(ROTATION, abs=1e-3)
    assert found.error < 0.03
    # The pitches of the centres, too.
    steps = found.lens + [[0.5, 0]] * (found.lens[:, 1:] % 2 == found.grid.shifted_rows)
    _, along, across = np.linalg.lstsq(np.column_stack([np.ones(len(steps)), steps]), found.pixel)[0]
    np.testing.assert_allclose([math.hypot(*along), math.hypot(*across)], pitches, rtol=1.5e-5)


@pytest.mark.slow
def test_centres_that_dust_displaces_are_doubtful(tmp_path, capsys):
    image, true, _ = drawn(0, (14.0, 13.4, 13.7))
    image = np.random.default_rng(0).poisson(PHOTONS * image) / PHOTONS
    assert not find_centres(image).doubtful.any()
    y, x = np.indices(image.shape) + 0.5
    for number, (column, row) in enumerate(np.random.default_rng(5).uniform(40, 350, (10, 2))):
        image *= 1 - 0.7 * np.clip(2.5 + 2 * (number % 4) - np.hypot(x - column, y - row), 0, 1)
    camera = CAMERA.replace(resolution=(395, 390), detector_width=395 * 0.0055)
    write_capture(tmp_path / "white.exr", Capture(image.astype(np.float32), camera))
    assert main(["calibrate", "centres", str(tmp_path / "white.exr"), "-o", str(tmp_path / "centres.csv")]) == 0
    found = read_centres(tmp_path / "centres.csv")
    error = np.array([np.hypot(*(true - place - 0.5).T).min() for place in found.pixel])
    doubtful = found["doubtful"] == 1
    assert (error > 0.15).sum() > 8
    assert doubtful[error > 0.15].all()
    # Dust dims one lens without displacing its centre.
    assert doubtful[error < 0.05].sum() <= 1
    assert f"{doubtful.sum()} doubtful centres" in capsys.readouterr().out


CAMERA = PlenopticCamera.preset("raytrix").replace(
    resolution=(460, 340), detector_width=2.53, mla_rotation=0.3, mla_aperture="circle", mla_fill=0.6
)


def test_centres_at_several_apertures(tmp_path, capsys):
    apertures = [CAMERA.replace(aperture_radius=CAMERA.aperture_radius * part) for part in (1.0, 0.6)]
    paths = [str(tmp_path / f"white{number}.exr") for number in range(2)]
    generator = np.random.default_rng(1)
    for path, camera in zip(paths, apertures, strict=True):
        image = generator.poisson(PHOTONS * white_image(camera)) / PHOTONS
        write_capture(path, Capture(image.astype(np.float32), camera))
    assert main(["calibrate", "centres", *paths, "-o", str(tmp_path / "centres.csv")]) == 0
    assert float(capsys.readouterr().out.partition("turned by ")[2].split()[0]) == pytest.approx(0.3, abs=1e-3)
    found, true = read_centres(tmp_path / "centres.csv").pixel, camera_centres(CAMERA).pixel
    error = np.array([(true - place)[np.hypot(*(true - place).T).argmin()] for place in found])
    assert len(error) > 150
    assert np.sqrt((error**2).sum(1).mean()) < 0.05
    refuses("2 sizes", find_centres, white_image(CAMERA), white_image(CAMERA)[:100])
    white = Capture(white_image(CAMERA), CAMERA)
    np.testing.assert_array_equal(find_centres(white).pixel, find_centres(white.image).pixel)


def test_centres_of_other_programs(tmp_path):
    grid = lens_grid(CAMERA)
    model = {
        "HSpacing": grid.spacing[0], "VSpacing": grid.spacing[1], "HOffset": grid.offset[0] + 0.5,
        "VOffset": grid.offset[1] + 0.5, "Rot": grid.rotation, "UMax": grid.shape[1], "VMax": grid.shape[0],
        "FirstPosShiftRow": grid.shifted_rows + 1, "Orientation": "horz",
    }  # fmt: skip
    places = grid.centres() - 0.5
    mics = [[*places[row, column, ::-1], row, column] for row, column in np.ndindex(grid.shape)]
    for name, values in (
        ("white.grid.json", {"CamInfo": {}, "LensletGridModel": model}),
        ("white.json", {"pat_type": "hex", "ptc_mean": [20.2, 23.3], "mic_list": mics}),
    ):
        path = tmp_path / name
        path.write_text(json.dumps(values))
        found = read_centres(path)
        np.testing.assert_allclose(found.pixel, places.reshape(-1, 2), atol=1e-9)
        np.testing.assert_array_equal(found["k"][: grid.shape[1]], np.arange(grid.shape[1]))


def test_damaged_centres_of_other_programs(tmp_path):
    path = tmp_path / "white.json"
    for text, words in (
        ("{", "no grid"),
        ("[1]", "neither"),
        ('{"mic_list": [[1, NaN, 0, 0]]}', "row 1: u = nan"),
        ('{"LensletGridModel": {"Orientation": "vert"}}', "transpose"),
    ):
        path.write_text(text)
        refuses(words, read_centres, path)
