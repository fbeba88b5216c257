"""Light fields decoded from captures of hexagonal and turned lattices."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial import cKDTree

from mitsuba_plenoptic import InputError, PlenopticCamera, load_scene, reconstruct, render_capture
from mitsuba_plenoptic.lightfield import decode, estimate_lens_grid, lens_grid, refocus, view, white_image
from mitsuba_plenoptic.lightfield.grid import bin_grid

LATTICES = {
    "hexagonal": {"mla_lattice": "hexagonal"},
    "hexagonal, upright": {"mla_lattice": "hexagonal", "mla_rotation": 90.0, "mla_aperture": "circle"},
    "turned": {"mla_rotation": 17.0, "mla_offset": (0.021, -0.008)},
    "moved": {"mla_offset": (0.021, -0.008)},
    "rectangular": {"mla_pitch": (0.064, 0.058)},
    "hexagonal, stretched": {"mla_lattice": "hexagonal", "mla_pitch": (0.058, 0.064), "mla_rotation": 7.0},
}


@pytest.fixture(params=LATTICES.values(), ids=LATTICES)
def camera(request):
    return PlenopticCamera(detector_width=1.28, resolution=(640, 512), **request.param)


def test_the_grid_holds_the_lenses_and_is_what_is_found_in_a_white_image(camera):
    grid = lens_grid(camera)
    centres = grid.centres().reshape(-1, 2)
    p = (centres - [320, 256]) * camera.pixel_size
    x, y = (p * camera.mla_distance / (camera.mla_distance + camera.detector_distance)).T
    lattice = camera.lattice
    # Every point of the grid is a lens, and every lens in the image is a point of the grid.
    assert np.hypot(*(np.array(lattice.centre(*lattice.cell(x, y))) - [x, y])).max() < 1e-9
    index = lattice.lenses_within((-0.6, -0.5), (0.6, 0.5))
    expected = np.stack(lattice.centre(*index.T.astype(float)), axis=-1)
    distance = cKDTree(np.stack([x, y], axis=-1)).query(expected)[0]
    assert distance.max() < 1e-9

    found = estimate_lens_grid(white_image(camera))
    inner = ((centres > 20) & (centres < [620, 492])).all(1)
    error = cKDTree(found.centres().reshape(-1, 2)).query(centres[inner])[0]
    assert np.sqrt(np.mean(error**2)) < 0.02


def test_rows_are_found_whatever_the_angle():
    for degrees in np.linspace(-360, 360, 1441):
        camera = PlenopticCamera(
            detector_width=0.3, resolution=(150, 150), mla_lattice="hexagonal", mla_rotation=float(degrees)
        )
        grid = lens_grid(camera)
        assert abs(grid.rotation) <= math.radians(15) + 1e-9
        assert grid.shifted_rows is not None
        assert grid.nearest_distance == pytest.approx(camera.micro_image_pitch / camera.pixel_size)


@pytest.mark.parametrize("lattice", [{}, {"mla_lattice": "hexagonal"}])
def test_a_window_without_a_lens_is_refused(lattice):
    camera = PlenopticCamera(crop_offset=(2075, 2075), crop_size=(4, 4), **lattice)
    with pytest.raises(InputError, match="no micro-image is centred in the recorded window"):
        lens_grid(camera)


def test_white_is_one_in_every_view_on_square_bins(camera):
    lf = decode(white_image(camera), camera=camera)
    assert (lf.sizes["t"], lf.sizes["s"]) == bin_grid(camera).shape == camera.bin_count[::-1]
    inner = lf.isel(s=slice(2, -2), t=slice(2, -2))
    weight = inner.weight.values
    np.testing.assert_allclose(inner.values[weight > 0], 1, atol=1e-5)
    half = lf.sizes["u"] // 2
    np.testing.assert_allclose(weight[half, half], 1, atol=1e-3)


@pytest.mark.parametrize("name", ["hexagonal", "turned", "rectangular", "hexagonal, stretched"])
def test_views_show_the_scene_from_their_place_on_the_pupil(name):
    lattice = {key: ", ".join(map(str, np.ravel(value))) for key, value in LATTICES[name].items()}
    small = {"detector_width": "2.048", "resolution": "1024", "letter_scale": "0.25"}
    scene = load_scene("letters", parameters={**small, **lattice})
    capture = render_capture(scene, spp=64)
    lf = decode(capture)
    assert (lf.sizes["s"], lf.sizes["t"]) == capture.camera.bin_count

    width = lf.sizes["s"] * capture.camera.mla_pitch

    def seen_from(x, y):
        sensor = {
            "type": "perspective",
            "fov": math.degrees(2 * math.atan(width / 240)),
            # The film's middle stays where the plane in focus meets the axis.
            "principal_point_offset_x": x * 120 / 240 / width,
            "principal_point_offset_y": y * 120 / 240 / width,
            "to_world": mi.ScalarTransform4f().translate([x, y, 0]),
            "film": {
                "type": "hdrfilm",
                "width": lf.sizes["s"],
                "height": lf.sizes["t"],
                "rfilter": {"type": "box"},
                "pixel_format": "luminance",
                "component_format": "float32",
            },
        }
        return np.array(mi.render(scene, sensor=mi.load_dict(sensor), spp=256))[..., 0]

    for u, v in ((0.0, 0.0), (3.0, 0.0), (0.0, -3.0)):
        one = view(lf, u=u, v=v)
        expected = seen_from(float(one.u), float(one.v))
        aside = [np.roll(expected, step, axis) for step in (-1, 1) for axis in (0, 1)]
        score = np.corrcoef(one.values.ravel(), expected.ravel())[0, 1]
        assert score > 0.97
        assert score > max(np.corrcoef(one.values.ravel(), other.ravel())[0, 1] for other in aside) + 0.02

    # Refocused from the light field and straight from the capture.
    for distance in (210.0, 240.0, 280.0):
        ours = refocus(lf, distance)
        theirs = reconstruct(capture, distance).image
        ours = np.asarray(ours)
        peak = theirs.max()
        assert 10 * math.log10(peak**2 / np.mean((ours - theirs)[3:-3, 3:-3] ** 2)) > 30
