"""Apertures of blades and pictures: rays against pupil points masked here, waves against NumPy."""

import json

import cases
import mitsuba as mi
import numpy as np
import pytest
from cameras import CODE

from mitsuba_plenoptic import Aperture, PlenopticCamera, render_capture
from mitsuba_plenoptic.report.sheet import design_sheet
from tools.bench.cases import ordinary_cameras

WHITE = {"sky": {"type": "constant"}}
PUPILS = {"hexagon": cases.polygon(6, 15.0), "square": cases.polygon(4, 0.0), "coded": cases.picture(CODE)}
"""Parameters and masks. The code has nothing that turning or mirroring would leave alike."""


def ordinary(**given):
    thin = {"focal_length": 50.0, "focus_distance": 300.0, "aperture_radius": 8.0, "detector_width": 12.0}
    return PlenopticCamera(mla_lattice="none", **(thin | {"resolution": (24, 16)} | given))


def samples(mask, count):
    """A mask and the open circle on a grid of the square around the pupil, and its coordinates over the radius."""
    along = (np.arange(count) + 0.5) * 2 / count - 1
    return *(function(*np.meshgrid(along, along)) for function in (mask, cases.opening)), along


def open_part(mask):
    mask, circle, _ = samples(mask, 1008)
    return mask.sum() / circle.sum()


def test_pictures_are_read_from_files(tmp_path):
    assert ordinary(aperture_image=CODE) != ordinary() and "0.0, 1.0, 1.0" not in repr(ordinary(aperture_image=CODE))
    values = np.round(CODE * 255) / 255
    mi.Bitmap(np.round(CODE * 255).astype(np.uint8)[..., None]).write(str(tmp_path / "code.png"))
    mi.Bitmap(values.astype(np.float32)[..., None]).write(str(tmp_path / "code.exr"))
    np.save(tmp_path / "code.npy", values)
    (tmp_path / "code.json").write_text(json.dumps({"transmission": values.tolist()}))
    rows = design_sheet(ordinary(aperture_blades=6))
    assert [row.value for row in rows if row.quantity.startswith("open part")] == ["0.827"]
    for file in tmp_path.iterdir():
        assert ordinary(aperture_image=file).aperture_image == Aperture(values)
        assert ordinary(aperture_image={"transmission": str(tmp_path / "code.npy")}).aperture_image == Aperture(values)


@pytest.mark.parametrize(("given", "mask"), PUPILS.values(), ids=PUPILS)
def test_a_white_scene_reads_the_open_part_of_the_circle(given, mask):
    part = open_part(mask)
    image = render_capture(cases.scene_of(ordinary(**given).to_sensor(), **WHITE), spp=16).image
    assert image.mean() == pytest.approx(part, rel=0.002) and image.std() < 0.01 * part


def by_hand(camera, distance, half, centre):
    """The picture of a square lamp, the sum over points of the masked pupil: lines of its light on each axis."""
    mask, circle, along = samples(PUPILS["coded"][1], 420)
    P, b = along * camera.aperture_radius, camera.mla_distance
    lines = []
    for axis, middle in ((0, centre), (1, 0.0)):
        # Where rays through P from the edges of the lamp land, and the parts of pixels between them.
        low, high = (P + b * (P - middle - side * half) / distance - b * P / camera.focal_length for side in (1, -1))
        x, step = camera.pixel_coordinates(axis)[:, None], camera.pixel_size
        lines.append((np.minimum(high, x + step / 2) - np.maximum(low, x - step / 2)).clip(0) / step)
    return lines[1] @ mask @ lines[0].T / circle.sum()


@pytest.mark.parametrize("distance", [200.0, 600.0])
def test_the_bokeh_of_a_lamp_is_the_picture_in_the_pupil(distance):
    """Light of a near lamp lands on the side of the axis where it passes the pupil, that of a far one on the other."""
    # Columns of a capture rise with x of the camera frame on the detector, and rows with y.
    camera = ordinary(aperture_image=CODE, detector_width=4.0, resolution=(60, 40))
    lamp = {"lamp": cases.facing(distance, distance / 200, (distance / 120, 0.0), **cases.radiating())}
    image = render_capture(cases.scene_of(camera.to_sensor(), **lamp), spp=2048).image
    expected = by_hand(camera, distance, distance / 200, distance / 120)
    assert cases.relative(image, expected) < 0.07
    assert image.sum() == pytest.approx(expected.sum(), rel=0.01)
    for other in (CODE[::-1], CODE[:, ::-1], CODE.T, CODE[::-1, ::-1]):
        wrong = render_capture(cases.scene_of(camera.replace(aperture_image=other).to_sensor(), **lamp), spp=64).image
        assert cases.relative(wrong, expected) > 0.3
    # Only the cell at +x is open.
    side = np.zeros((5, 5))
    side[2, 4] = 1
    lit = render_capture(cases.scene_of(camera.replace(aperture_image=side).to_sensor(), **lamp), spp=64).image
    middle = -camera.mla_distance * (distance / 120) / distance
    moved = (lit.sum(0) @ camera.pixel_coordinates(0)) / lit.sum() - middle
    assert moved == pytest.approx(0.8 * camera.aperture_radius * camera.defocus(distance), rel=0.05)


@pytest.mark.slow
def test_a_wall_through_two_holes_is_the_sum_over_the_mask():
    """Rays through the closed middle bring the fringes, without which the wall differs by more than a fifth."""
    given, mask = cases.APERTURES["two holes"]
    camera = cases.ordinary_camera(1.0, 16, **given)
    scene, wall = cases.textured_wall(camera, 4, 4.0, cases.WIDE)
    expected = cases.diffracted(camera, wall, 4, 4.0, mask=mask)
    found = render_capture(scene, model="wave", spp=256, wavelength=cases.ORDINARY_WAVELENGTH).image
    assert cases.relative(found, expected) < 0.015
    assert found.sum() == pytest.approx(expected.sum(), rel=0.003)
    assert cases.relative(render_capture(scene, spp=256).image, expected) > 0.2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["7 x 7", "two holes", "annulus", "33 x 33 with 33 open", "grey"])
def test_walls_through_apertures_of_any_shape(name):
    rows = list(ordinary_cameras.apertures(apertures=(name,), blurs=(0.0, 1.0, 4.0, 8.0), film=24))
    # Light behind few cells comes from far pixels, of which one in four is traced.
    limit = 0.013 if name == "33 x 33 with 33 open" else 0.01
    assert [row for row in rows if row["waves"] >= limit or row["rays"] < 2 * row["waves"]] == []
