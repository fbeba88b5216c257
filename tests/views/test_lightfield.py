"""Decoding: where samples come from, what they are worth, and what the axes mean."""

import dataclasses
import math

import numpy as np
import pytest
from light_field_cases import LATTICES, PAPER, all_cameras, fall_off_of, square_cameras
from refusals import refuses
from scipy.spatial import cKDTree

from mitsuba_plenoptic import LensTransmissions, PlenopticCamera, Vignetting, decode, views
from mitsuba_plenoptic.views.viewpoints import lens_mosaic


def rays_of_pixels(camera, grid):
    """Pupil point and lens centre of every pixel by the textbook's formulas, axis by axis; the nearest lens."""
    b, z = camera.mla_distance, camera.detector_distance
    centres = grid.centres()
    result = []
    for axis in (0, 1):
        pixel = np.arange(camera.crop_size[axis]) + camera.crop_offset[axis] + 0.5
        p = (pixel - camera.resolution[axis] / 2) * camera.pixel_size
        line = centres[0, :, 0] if axis == 0 else centres[:, 0, 1]
        lens = (line + camera.crop_offset[axis] - camera.resolution[axis] / 2) * camera.pixel_size * b / (b + z)
        c = lens[np.abs(p[:, None] * b / (b + z) - lens).argmin(1)]
        result.append((c + b / z * (c - p), c))
    return result


@pytest.mark.parametrize(("pixels", "f_number", "size"), [(16, 22, 0.0065), (32, 1.8, 0.0065), (20, 2, 0.0014)])
def test_detectors_of_every_size_have_as_many_views(pixels, f_number, size):
    # A lens's image is a whole number of pixels wide, or half a pixel more, where quotients round up and down.
    given = {"pixels_per_lens": pixels, "f_number": f_number, "pixel_size": size, "focal_length": 50}
    cameras = [PlenopticCamera.matched(**given, lenses=count, focus_distance=500) for count in (10, 11, 14, 23)]
    found = {decode(np.ones(camera.shape), camera=camera).shape[:2] for camera in cameras}
    assert len(found) == 1, found


def test_rows_of_lenses_turn_about_the_first_centre_and_shift():
    grid = views.LensGrid((10, 8), (3, 4), (3, 2), math.pi / 2, 1)
    expected = [[[3, 4], [3, 14]], [[-5, 9], [-5, 19]], [[-13, 4], [-13, 14]]]
    np.testing.assert_allclose(grid.centres(), expected, atol=1e-12)


def test_area_of_one_micro_image():
    single = views.white_image(PAPER, views.LensGrid((32, 32), (256.3, 255.8), (1, 1)))
    radius = PAPER.micro_image_diameter / PAPER.pixel_size / 2
    assert single.sum() == pytest.approx(math.pi * radius**2, rel=5e-4)
    y, x = np.indices(single.shape) + 0.5
    assert (single * x).sum() / single.sum() == pytest.approx(256.3, abs=1e-3)
    assert (single * y).sum() / single.sum() == pytest.approx(255.8, abs=1e-3)
    assert single.max() == 1 and single[255, 256 + 12] == 0


OUTLINE = Vignetting([1, 0, 0, -0.3, 0, -0.3], scale=0.5)
UNEVEN = {
    "lenses": {"mla_transmissions": LensTransmissions(np.random.default_rng(0).uniform(0.45, 1.4, (20, 20)))},
    "hexagonal": {"mla_transmissions": LensTransmissions(np.random.default_rng(0).uniform(0.45, 1.4, (20, 20)))},
    "apodised": {"pupil_apodisation": (-0.6, 0)},
    "outline": {"vignetting": dataclasses.replace(OUTLINE, apodisation_2=-0.3, slope_x=(0, 0.3, 0))},
}


class TestDecode:
    @all_cameras
    def test_white_is_one_wherever_the_pupil_is_seen(self, camera):
        lf = decode(views.white_image(camera), camera=camera)
        seen = lf.weight.values > 0
        assert 0.5 < seen.mean() < 0.9
        np.testing.assert_allclose(lf.values[seen], 1, atol=1e-5)
        assert not lf.values[~seen].any()
        sizes = camera.bin_count[::-1]
        if camera.is_cropped:
            # Those whose micro-image is centred in the recorded window.
            pixels = [camera.pixel_coordinates(axis) for axis in (1, 0)]
            bins = [(np.arange(size) - size / 2 + 0.5) * camera.micro_image_pitch for size in sizes]
            sizes = [np.sum((x[0] <= at) & (at <= x[-1])) for x, at in zip(pixels, bins, strict=True)]
        assert lf.shape[2:] == tuple(sizes)
        middle = lf.sizes["u"] // 2
        np.testing.assert_allclose(lf.weight[middle, middle, 2:-2, 2:-2], 1, atol=1e-3)
        for name in lf.dims:
            assert (np.diff(lf[name]) < 0).all()
        assert -np.diff(lf.s)[0] == pytest.approx(camera.bin_size(camera.focus_distance))
        assert views.camera_of(lf) == camera

    @square_cameras
    def test_samples_come_from_the_right_rays(self, camera):
        # A capture whose value is a linear function of the ray: of pupil point and lens, in x and in y.
        (Px, cx), (Py, cy) = rays_of_pixels(camera, views.lens_grid(camera))
        lf = decode((40 + 2 * Px + 30 * cx + (3 * Py - 20 * cy)[:, None]) * views.white_image(camera), camera=camera)
        g0, b = camera.focus_distance, camera.mla_distance
        expected = 40 + 2 * lf.u - 30 * lf.s * b / g0 + 3 * lf.v + 20 * lf.t * b / g0
        open_ = lf.weight.values > 0.999
        assert open_.mean() > 0.4
        # The pupil is covered to within a step and no sample lies half a step beyond it.
        step = -np.diff(lf.u)[0]
        assert step == pytest.approx(camera.pixel_size * camera.mla_distance / camera.detector_distance)
        assert camera.aperture_radius - step < lf.u.values[0] < camera.aperture_radius + step / 2
        np.testing.assert_allclose(lf.values[open_], expected.transpose(*lf.dims).values[open_], atol=2e-3)

    @pytest.mark.filterwarnings("ignore:white")
    @pytest.mark.parametrize(
        ("name", "source"),
        [("hexagonal", "white"), ("lenses", "white alone"), ("apodised", "white"), ("outline", "camera"),
         ("outline", "white")],
    )  # fmt: skip
    def test_what_is_seen_of_the_pupil_is_not_how_bright_it_is(self, name, source, tmp_path):
        even = PAPER.replace(**LATTICES["hexagonal"]) if name == "hexagonal" else PAPER
        dim = even.replace(**UNEVEN[name])
        known = even.replace(vignetting=OUTLINE) if name == "outline" else even
        fall_off = np.ones(dim.shape) if source == "camera" else fall_off_of(dim, 0.2)
        white = (views.white_image(dim) * fall_off).astype(np.float32)
        given = {} if source == "camera" else {"white": 3 * white}
        given |= {"grid": views.lens_grid(dim)} if source == "white alone" else {"camera": dim}
        lf = decode(0.7 * white, **given)
        inner = np.s_[:, :, 1:-1, 1:-1]
        assert np.ptp(lf.values[lf.weight.values > 0]) < 1e-4 * lf.values.max()
        # Of a recorded white, lenses near the axis count as 1; alone it does not tell that they are dim.
        if source == "camera" or name == "apodised":
            assert lf.values.max() == pytest.approx(0.7 * (1 if source == "camera" else 0.88), rel=0.05)
        expected = decode(views.white_image(known), camera=known).weight.values
        around = (lf.shape[0] - len(expected)) // 2
        weight = lf.weight.values[around : len(expected) + around, around : len(expected) + around]
        if source != "white alone" or name == "lenses":
            # Samples that see a tenth of the pupil are just left out, or just not.
            both = (weight > 0) & (expected > 0)
            assert np.abs(np.where(both, weight - expected, 0)[inner]).max() < (1e-5 if source == "camera" else 0.04)
            assert np.mean((weight > 0) == (expected > 0)) > 0.98
        if source == "white alone":
            for saved in (lf, lf.drop_vars("white")):
                views.save_light_field(tmp_path / "a.nc", saved)
                assert views.open_light_field(tmp_path / "a.nc").identical(saved)

    def test_colour(self):
        lf = decode(views.white_image(PAPER)[..., None] * [0.2, 0.5, 0.9], camera=PAPER)
        assert lf.dims == ("v", "u", "t", "s", "c")
        assert lf.c.values.tolist() == ["R", "G", "B"]
        assert lf.sel(c="G").values[11, 11] == pytest.approx(0.5)

    @pytest.mark.parametrize(
        "grid",
        [
            views.LensGrid((20.3, 20.3), (9.2, 5.1), (24, 26), math.radians(2)),
            views.LensGrid((20.3, 20.3 * math.sqrt(0.75)), (12.2, 8.1), (27, 24), 0.0, 1),
            views.LensGrid((19.1, 21.4), (9.2, 5.1), (22, 26), 0.0),
        ],
        ids=["turned", "hexagonal", "rectangular"],
    )
    def test_other_lattices_are_resampled_to_upright_squares(self, grid):
        # The value of a pixel: linear in its lens's place on the detector and in its place within the micro-image.
        centres = grid.centres().reshape(-1, 2)
        y, x = np.indices((480, 500)) + 0.5
        cx, cy = centres[cKDTree(centres).query(np.stack([x, y], axis=-1))[1]].transpose(2, 0, 1)
        image = 100 + 0.1 * cx - 0.2 * cy + (x - cx) - 0.5 * (y - cy)
        lf = decode(image, white=np.ones_like(image), grid=grid)
        assert "camera" not in lf.attrs
        # Far from the border all lenses are there.
        inner = lf.where(lf.weight > 0)[:, :, 4:-4, 4:-4]
        # Only samples nearer to their own lens than to any other.
        assert 0.65 < float((lf.weight > 0)[..., 8, 8].mean()) < 0.85
        slopes = [float(inner.differentiate(name).mean()) for name in ("v", "u", "t", "s")]
        pitch = grid.pitch
        assert slopes == pytest.approx([-0.5, 1.0, -0.2 * pitch, 0.1 * pitch], abs=0.01)
        assert float(inner.differentiate("s").std()) < 0.05
        middle = float(inner.interp(t=0, s=0, v=0, u=0))
        low, high = centres.min(0), centres.max(0)
        assert middle == pytest.approx(100 + 0.1 * (low + high)[0] / 2 - 0.2 * (low + high)[1] / 2, abs=0.2)

    def test_focus_at_infinity_gives_slopes(self):
        camera = PAPER.replace(mla_distance=80.0)
        lf = decode(views.white_image(camera), camera=camera)
        assert lf.s.attrs["units"] == "1" and np.isfinite(lf.s).all()
        assert -np.diff(lf.s)[0] == pytest.approx(0.064 / 80)


class TestDisparity:
    def test_formula_and_its_inverse(self):
        lf = decode(views.white_image(PAPER), camera=PAPER)
        assert views.disparity(lf, 240) == pytest.approx(0, abs=1e-12)
        # s(210) = 1 + 120/210 - 120/80 = 0.0714; one view is 0.46875 mm, one lens 0.064 mm.
        assert views.disparity(lf, 210) == pytest.approx(-0.0714286 * 0.46875 / 0.064, rel=1e-5)
        for g in (190.0, 240.0, 3000.0):
            assert views.distance_of(lf, views.disparity(lf, g)) == pytest.approx(g)
        assert views.distance_of(lf, 100.0) == np.inf


class TestViews:
    @pytest.fixture
    def lf(self):
        values = np.random.default_rng(0).random((5, 5, 4, 6), dtype=np.float32)
        return decode(views.white_image(PAPER), camera=PAPER)[9:14, 9:14, :4, :6].copy(data=values)

    def test_nearest_view(self, lf):
        assert np.array_equal(views.view(lf).values, lf.values[2, 2])
        assert np.array_equal(views.view(lf, u=1.1 * lf.u[0], v=0.5).values, lf.values[1, 0])

    @pytest.mark.parametrize("place", [{"u": 10}, {"v": -10}])
    def test_a_view_beyond_the_pupil_is_refused(self, lf, place):
        (name, value), step = *place.items(), float(lf.u[0] - lf.u[1])
        low, high = float(lf[name][-1]) - step / 2, float(lf[name][0]) + step / 2
        refuses(f"{name} = {value}: .*{low:.4g} to {high:.4g}", views.view, lf, **place)
        refuses("at = 9: ", views.epipolar_image, lf, at=9)
        assert np.array_equal(views.view(lf, **{name: high}), views.view(lf, **{name: float(lf[name][0])}))

    def test_mosaics(self, lf):
        assert np.array_equal(views.pick_views(lf, 2).values[1, 0], lf.values[3, 1])
        for j, i, row, column in ((0, 0, 0, 0), (1, 3, 2, 5), (4, 2, 3, 1)):
            assert views.view_mosaic(lf)[j * 4 + row, i * 6 + column] == lf.values[j, i, row, column]
            assert lens_mosaic(lf)[row * 5 + j, column * 5 + i] == lf.values[j, i, row, column]

    def test_epipolar_images(self, lf):
        flat = views.epipolar_image(lf, at=float(lf.t[1]), through=float(lf.v[3]))
        assert flat.dims == ("u", "s")
        assert np.array_equal(flat.values, lf.values[3, :, 1, :])
        steep = views.epipolar_image(lf, "vertical", at=float(lf.s[5]), through=float(lf.u[0]))
        assert steep.dims == ("v", "t")
        assert np.array_equal(steep.values, lf.values[:, 0, :, 5])


@all_cameras
def test_the_grid_holds_the_lenses(camera):
    centres = views.lens_grid(camera).centres().reshape(-1, 2)
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
    distance = cKDTree(np.stack([x, y], axis=-1)).query(np.stack(lattice.centre(*index.T.astype(float)), axis=-1))[0]
    assert distance.max() < 1e-9


def test_rows_are_found_whatever_the_angle():
    for turn in np.linspace(-360, 360, 97).tolist():
        camera = PlenopticCamera(mla_lattice="hexagonal", mla_rotation=turn, detector_width=0.3, resolution=(150, 150))
        grid = views.lens_grid(camera)
        assert abs(grid.rotation) <= math.radians(15) + 1e-9
        assert grid.shifted_rows is not None
        assert grid.nearest_distance == pytest.approx(camera.micro_image_pitch / camera.pixel_size)


ROOT3 = math.sqrt(3)


def distances(found, truth, shape):
    """Distance of every true centre within the image from the nearest one found, and of each found from a true one."""
    ours, theirs = (grid.centres().reshape(-1, 2) for grid in (found, truth))
    seen = theirs[((theirs > 0) & (theirs < shape[::-1])).all(1)]
    inner = ours[((ours > 5) & (ours < np.array(shape[::-1]) - 5)).all(1)]
    return cKDTree(ours).query(seen)[0], cKDTree(theirs).query(inner)[0]


GRIDS = {
    "square": views.LensGrid((16.317, 16.317), (-23.3, -17.2), (70, 70), math.radians(0.3)),
    "hexagonal, upright": views.LensGrid((17.1 * ROOT3, 17.1 / 2), (-23.3, -17.2), (140, 45), math.radians(-0.3), 0),
    "rectangular": views.LensGrid((17.0, 15.5), (-60.0, 17.3), (90, 80), math.radians(-3.0)),
    "hexagonal, upright, hardly stretched": views.LensGrid(
        (17.1 * ROOT3, 1.003 * 17.1 / 2), (-23.3, -17.2), (140, 45), math.radians(-3.0), 0
    ),
    "hexagonal, tall": views.LensGrid((20.0, 1.3 * 20.0 * ROOT3 / 2), (-95.3, -17.2), (60, 60), math.radians(-5.0), 1),
}


@pytest.mark.parametrize("grid", GRIDS.values(), ids=GRIDS)
def test_centres_of_an_unknown_lattice(grid):
    # A micro-image is 10.7 pixels wide. The picture is darker towards its corners and noisy.
    image = views.white_image(PlenopticCamera(detector_width=3.2, resolution=(800, 720)), grid)
    y, x = (np.linspace(-1, 1, n) for n in image.shape)
    image = 900 * image * (1 - 0.15 * (x**2 + y[:, None] ** 2)) + 40
    image += np.random.default_rng(0).normal(0, 20, image.shape)
    missed, spurious = distances(views.estimate_lens_grid(image), grid, image.shape)
    assert len(missed) > 1000
    assert np.sqrt(np.mean(missed**2)) < 0.05
    # Not a denser lattice that happens to hold the true one.
    assert spurious.max() < 0.1


@pytest.mark.parametrize(
    ("diameter", "lattice", "rotation", "pitch"),
    [
        (0.8, "hexagonal", 8.0, 12.5),
        (1.1, "square", 1.3, 8.3),
        # Here the fundamental wave vanishes, beyond it is negative.
        (1.22, "square", 14.0, 19.23),
        (1.25, "hexagonal", 3.0, 12.5),
    ],
)
def test_lattices_of_micro_images_that_overlap(diameter, lattice, rotation, pitch):
    """Not the lattice of the gaps, turned by 45 degrees and finer by the root of two."""
    wide = PlenopticCamera(mla_lattice=lattice, mla_rotation=rotation, mla_offset=(0.017, -0.023))
    radius = wide.aperture_radius * diameter / wide.micro_image_diameter * wide.micro_image_pitch
    step = wide.micro_image_pitch / pitch
    camera = wide.replace(aperture_radius=radius, resolution=(340, 300), detector_width=340 * step)
    image = np.random.default_rng(0).poisson(4000 * views.white_image(camera).clip(0)) + 300.0
    found = views.estimate_lens_grid(image)
    assert found.nearest_distance == pytest.approx(pitch, rel=1e-3)
    sides = 4 if lattice == "square" else 12
    assert abs((math.degrees(found.rotation) - rotation + 180 / sides) % (360 / sides) - 180 / sides) < 0.02
    missed, spurious = distances(found, views.lens_grid(camera), image.shape)
    assert max(missed.max(), spurious.max()) < 0.1


def test_colour_pictures_count_by_their_mean():
    white = views.white_image(PlenopticCamera(detector_width=0.512, resolution=(256, 256)))
    grey, colour = views.estimate_lens_grid(white), views.estimate_lens_grid(white[..., None] * [0.5, 1.0, 1.5])
    assert colour.offset == pytest.approx(grey.offset, abs=1e-3)
