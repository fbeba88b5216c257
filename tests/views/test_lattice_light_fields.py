"""Light fields decoded from captures of hexagonal and turned lattices."""

import math

import numpy as np
import pytest
from cameras import letters, pinhole_picture
from light_field_cases import LATTICES, all_cameras
from scipy.spatial import cKDTree

from mitsuba_plenoptic import PlenopticCamera, decode, load_scene, reconstruct, render_capture
from mitsuba_plenoptic.views import lens_grid, refocus, view


@all_cameras
def test_the_grid_holds_the_lenses(camera):
    grid = lens_grid(camera)
    centres = grid.centres().reshape(-1, 2)
    p = (centres + camera.crop_offset - np.array(camera.resolution) / 2) * camera.pixel_size
    to_lenses = camera.mla_distance / (camera.mla_distance + camera.detector_distance)
    x, y = (p * to_lenses).T
    lattice = camera.lattice
    # Every point of the grid is a lens, and every lens in the image is a point of the grid.
    assert np.hypot(*(np.array(lattice.centre(*lattice.cell(x, y))) - [x, y])).max() < 1e-9
    columns, rows = (camera.pixel_coordinates(axis) * to_lenses for axis in (0, 1))
    index = lattice.lenses_within((columns[0], rows[0]), (columns[-1], rows[-1]))
    if lattice.axis_aligned:
        assert len(centres) == (len(index) if camera.is_cropped else math.prod(camera.lens_count))
    expected = np.stack(lattice.centre(*index.T.astype(float)), axis=-1)
    distance = cKDTree(np.stack([x, y], axis=-1)).query(expected)[0]
    assert distance.max() < 1e-9


def test_rows_are_found_whatever_the_angle():
    for degrees in np.linspace(-360, 360, 289):
        camera = PlenopticCamera(
            detector_width=0.3, resolution=(150, 150), mla_lattice="hexagonal", mla_rotation=float(degrees)
        )
        grid = lens_grid(camera)
        assert abs(grid.rotation) <= math.radians(15) + 1e-9
        assert grid.shifted_rows is not None
        assert grid.nearest_distance == pytest.approx(camera.micro_image_pitch / camera.pixel_size)


def test_views_show_the_scene_from_their_place_on_the_pupil(name="hexagonal, stretched"):
    """By a hexagonal lattice with two pitches."""
    lattice = {key: ", ".join(map(str, np.ravel(value))) for key, value in LATTICES[name].items()}
    scene = load_scene("letters", parameters=letters(32, **lattice))
    capture = render_capture(scene, spp=16)
    lf = decode(capture)
    assert (lf.sizes["s"], lf.sizes["t"]) == capture.camera.bin_count

    for u, v in ((0.0, 0.0), (3.0, 0.0), (0.0, -3.0)):
        one = view(lf, u=u, v=v)
        shape = lf.sizes["s"], lf.sizes["t"]
        width = lf.sizes["s"] * capture.camera.row_pitch
        expected = pinhole_picture(scene, *shape, width, float(one.u), float(one.v), spp=64)[..., 0]
        aside = [np.roll(expected, step, axis) for step in (-1, 1) for axis in (0, 1)]
        score = np.corrcoef(one.values.ravel(), expected.ravel())[0, 1]
        assert score > 0.97
        assert score > max(np.corrcoef(one.values.ravel(), other.ravel())[0, 1] for other in aside) + 0.02

    # Refocused from the light field and straight from the capture.
    for distance in (210.0, 280.0):
        ours, theirs = refocus(lf, distance).values, reconstruct(capture, distance).image
        assert 10 * math.log10(theirs.max() ** 2 / np.mean((ours - theirs)[3:-3, 3:-3] ** 2)) > 30
