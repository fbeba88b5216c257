"""Refocusing and depth from light fields, against direct sums, the ray reconstruction and known scenes."""

import math

import numpy as np
import pytest
from cameras import letters, small_camera
from light_field_cases import blobs, fall_off_of, of_square_lenses, straight_rays
from scipy.io import savemat
from scipy.ndimage import center_of_mass, gaussian_filter, map_coordinates, uniform_filter

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import views
from mitsuba_plenoptic.design import best_distances
from mitsuba_plenoptic.views.agreement import ViewComparison
from mitsuba_plenoptic.views.coordinates import view_steps
from mitsuba_plenoptic.views.lens_agreement import LensComparison
from mitsuba_plenoptic.views.lens_images import micro_images_of

# Fewer pixels a lens than the paper's, to be quick: 11 views.
CAMERA = mp.PlenopticCamera(detector_width=2.56, resolution=(640, 640))


@pytest.fixture(scope="module")
def blank():
    return mp.decode(views.white_image(CAMERA), camera=CAMERA)


def texture(seed=0, waves=60):
    """Give a smooth random function of two coordinates in lenses, without detail finer than 8 lenses."""
    generator = np.random.default_rng(seed)
    kx, ky = generator.uniform(-0.12, 0.12, (2, waves)) * 2 * np.pi
    phase, height = generator.uniform(0, 2 * np.pi, waves), generator.normal(size=waves)

    def value(x, y):
        total = sum(h * np.cos(a * x + b * y + p) for a, b, p, h in zip(kx, ky, phase, height, strict=True))
        return 0.5 + total / (4 * np.sqrt(waves))

    return value


def flat_scene(lf, distance, function):
    """Fill a light field with a flat textured scene at one distance: the value at lens - step x disparity."""
    slope = views.disparity(lf, distance)
    t, s = (np.arange(lf.sizes[name], dtype=float) for name in ("t", "s"))
    v, u = (view_steps(lf, name) for name in ("v", "u"))
    x = s - slope * u[:, None]
    values = function(x[None, :, None, :], (t - slope * v[:, None])[:, None, :, None]).astype(np.float32)
    return lf.copy(data=np.where(lf.weight.values > 0, values, 0))


def noisy_camera(pixels):
    """Give a camera at f/4 with so many pixels a lens, which finds 1 % of the distance in 0.1 lens a view."""
    return mp.PlenopticCamera(
        aperture_radius=10.0, mla_pitch=0.0822, mla_focal_length=6 * 0.0822,
        detector_width=36 * 0.0822, resolution=(36 * pixels, 36 * pixels),
    )  # fmt: skip


def card(camera, slope, blob, contrast):
    """Give the capture of a card with random blobs, which moves by `slope` lenses from view to view, without noise."""
    pattern = gaussian_filter(np.random.default_rng(0).normal(size=(600, 600)), 8 * blob, mode="wrap")
    # Lenses and pixels average over what they see, eight samples a lens.
    for width in (8, max(1, round(8 * abs(slope)))):
        pattern = uniform_filter(pattern, width, mode="wrap")
    pattern = 0.5 * (1 + contrast * pattern / pattern.std())
    pixel, lenses = np.arange(camera.shape[0]) + 0.5, views.lens_grid(camera).centres()[0, :, 0]
    lens = np.abs(pixel[:, None] - lenses).argmin(axis=1)
    place = 8 * (lens - slope * (pixel - lenses[lens]) + 16)
    return map_coordinates(pattern, np.meshgrid(place, place, indexing="ij"), order=1) * views.white_image(camera)


class TestShiftAndAdd:
    def test_is_the_mean_of_moved_views(self, blank):
        lf = blank.copy(data=np.random.default_rng(0).random(blank.shape, dtype=np.float32))
        # Read out at one bin, with the textbook's bilinear formula.
        slope, row, column = 0.37, 17, 22
        total = weight = 0.0
        for j, dv in enumerate(view_steps(lf, "v")):
            for i, du in enumerate(view_steps(lf, "u")):
                y, x = row + slope * dv, column + slope * du
                y0, x0 = math.floor(y), math.floor(x)
                for yy, wy in ((y0, 1 - (y - y0)), (y0 + 1, y - y0)):
                    for xx, wx in ((x0, 1 - (x - x0)), (x0 + 1, x - x0)):
                        share = wy * wx * blank.weight.values[j, i, yy, xx]
                        total += share * lf.values[j, i, yy, xx]
                        weight += share
        assert views.shift_and_add(lf, slope).values[row, column] == pytest.approx(total / weight, rel=1e-5)

    def test_equals_the_ray_reconstruction(self):
        capture = mp.render_capture(mp.load_scene("letters", parameters=letters(32)), spp=2)
        ours = views.refocus(mp.decode(capture), 280.0).values
        theirs = mp.reconstruct(capture, 280.0, footprint="lens").image
        assert 10 * math.log10(theirs.max() ** 2 / np.mean((ours - theirs) ** 2)) > 45

    def test_a_falling_white_moves_no_blur(self):
        camera = of_square_lenses(10, 20)
        spot = lambda x, y, sx, sy: np.exp(-((x + 200 * sx - 2) ** 2 + (y + 200 * sy - 2) ** 2))  # noqa: E731
        picture = straight_rays(camera, spot)
        white, centres = views.white_image(camera), []
        for corner in (1.0, 0.2):
            dim = fall_off_of(camera, corner)
            image = views.refocus(mp.decode(picture * dim, white=white * dim, camera=camera), 240.0)
            centres.append(center_of_mass(image.values))
        assert np.abs(np.subtract(*centres)).max() < 0.01

    def test_without_a_camera_it_goes_by_lenses_per_view(self):
        lens = views.LensGrid((32, 32), (16, 16), (20, 20))
        unknown = mp.decode(np.ones((640, 640)), white=np.ones((640, 640)), grid=lens)
        np.testing.assert_allclose(views.shift_and_add(unknown, 0.2).values, 1, atol=1e-5)


class TestDepth:
    @pytest.mark.slow
    @pytest.mark.needs_extension("raw")
    @pytest.mark.filterwarnings("ignore:white")
    def test_behind_a_falling_white_of_lftoolbox(self, tmp_path, slope=0.6):
        camera = of_square_lenses(10, 20)
        distance = float(views.distance_of(mp.decode(views.white_image(camera), camera=camera), slope))
        picture = straight_rays(camera, blobs(distance, 2 * camera.mla_pitch * distance / camera.mla_distance))
        dim = fall_off_of(camera, 0.2)
        lf = mp.decode(picture * dim, white=views.white_image(camera) * dim, camera=camera)
        savemat(tmp_path / "a.mat", {"LF": np.stack([lf.values, lf.white.values / lf.white.values.max()], axis=-1)})
        found = views.depth_map(mp.exchange.read_lftoolbox(tmp_path / "a.mat"))
        error = views.distance_of(mp.decode(picture, camera=camera), found.disparity.values) / distance - 1
        for region in (np.s_[3:-3, 3:-3], np.s_[2:7, 2:7]):
            assert abs(np.median(error[region])) < 0.003
            assert found.confidence.values[region].mean() > 0.9

    def test_views_are_as_noisy_at_any_disparity(self, blank):
        noise = np.random.default_rng(0).normal(0, 0.1, blank.shape)
        lf = blank.copy(data=np.where(blank.weight.values > 0, 0.5 + noise, 0).astype(np.float32))
        found = [ViewComparison(lf).disagreement(slope)[:2] for slope in (0, 0.02, 0.37, 0.5, 0.98, 1)]
        left = [float((ratio * whole)[8:-8, 8:-8].mean()) for ratio, whole in found]
        assert left == pytest.approx([left[0]] * len(left), rel=0.02)

    def test_two_planes(self, blank):
        # The left half at 212 mm in front of the right half at 265 mm, by their place in the middle view.
        near, far = flat_scene(blank, 212.0, texture(1)), flat_scene(blank, 265.0, texture(2))
        edge = 20 + views.disparity(blank, 212.0) * view_steps(blank, "u")
        in_front = np.arange(40)[None, :] < edge[:, None]
        lf = blank.copy(data=np.where(in_front[None, :, None, :], near.values, far.values))
        found = views.depth_map(lf, 195, 310, planes=32)
        left, right = found.isel(s=slice(2, 16)), found.isel(s=slice(23, 38))
        assert float(abs(left.depth - 212).median()) < 0.5
        assert float(abs(right.depth - 265).median()) < 1
        assert min(float(part.confidence.median()) for part in (left, right)) > 0.8
        # Next to the edge the background is not mistaken for the object.
        assert float(found.isel(s=slice(22, 24)).depth.median()) > 240
        place = np.arange(40.0), np.arange(40.0)[:, None]
        sharp = np.where(place[0] < 20, texture(1)(*place), texture(2)(*place))
        assert np.median(np.abs(found.image.values - sharp)) < 0.02
        known = np.isfinite(found.depth.values)
        assert known.mean() > 0.6 and np.all(found.confidence.values[known] >= 0.5)
        expected = [views.disparity(lf, g) for g in found.depth.values[known]]
        np.testing.assert_allclose(found.disparity.values[known], expected, atol=1e-9)

    # Pixels a lens; lenses that the card moves from view to view; photons; size of its blobs in lenses; contrast.
    @pytest.mark.slow
    @pytest.mark.parametrize("case", [(10, 0, 50, 1.6, 0.18), (9, -0.5, 100, 0.8, 0.3)])
    def test_noise_does_not_move_the_depth(self, case):
        pixels, slope, photons, blob, contrast = case
        camera = noisy_camera(pixels)
        seen = mp.Capture(card(camera, slope, blob, contrast), camera)
        lf = mp.decode(mp.expose(seen, mp.Detector(), photons=photons, seed=1))
        # Few views see the bins at the border.
        inner = views.depth_map(lf).isel(s=slice(2, -2), t=slice(2, -2))
        error = views.distance_of(lf, inner.disparity.values) / views.distance_of(lf, slope) - 1
        assert abs(np.median(error)) < 0.003
        right = float((abs(error) < 0.01).mean())
        assert right > 0.95 and float(inner.confidence.mean()) == pytest.approx(right, abs=0.1)

    @pytest.mark.slow
    def test_confidence_falls_with_the_rate_of_right_depths(self):
        # So few photons that noise decides in every other bin.
        camera = noisy_camera(10)
        seen = mp.Capture(card(camera, 0.5, 1.6, 0.08), camera)
        rates, stated = [], []
        for seed in range(4):
            lf = mp.decode(mp.expose(seen, mp.Detector(), photons=25, seed=seed))
            inner = views.depth_map(lf).isel(s=slice(6, -6), t=slice(6, -6))
            error = views.distance_of(lf, inner.disparity.values) / views.distance_of(lf, 0.5) - 1
            rates.append(np.mean(np.abs(error) < 0.01))
            stated.append(float(inner.confidence.mean()))
        # Single captures scatter by 0.1, and confidences are on average 0.1 too low.
        assert 0.2 < np.mean(rates) < 0.8
        assert np.mean(stated) == pytest.approx(np.mean(rates), abs=0.15)

    def test_focused_cameras_compare_micro_images(self):
        # Stripes finer than the lenses, which alias from lens to lens: the value of a sample at its exact place.
        camera = small_camera(24, mla_focal_length=0.66, detector_distance=0.512, aperture_radius=4.9)
        lf = mp.decode(views.white_image(camera), camera=camera)
        function = texture(waves=40)
        # Where its lenses are in focus, samples near the rims of micro-images show their exact places.
        sharp = best_distances(camera)[0]
        lf = flat_scene(lf, sharp, lambda x, y: function(6 * x, 6 * y))
        inner = views.depth_map(lf, 220, 236, planes=40).isel(s=slice(3, -3), t=slice(3, -3))
        assert float(np.isfinite(inner.depth).mean()) > 0.9
        assert float(abs(inner.depth - sharp).max()) < 0.5
        # The views themselves agree about nothing.
        by_views = [
            float(np.nanmedian(ViewComparison(lf).disagreement(views.disparity(lf, g))[0])) for g in (sharp, 222.0)
        ]
        lenses = LensComparison(micro_images_of(lf))
        by_lenses = [float(np.nanmedian(lenses.disagreement(views.disparity(lf, g))[0])) for g in (sharp, 222.0)]
        assert by_lenses[0] < 0.1 * by_lenses[1]
        assert by_views[0] > 0.3 * by_views[1]
        with pytest.raises(mp.InputError, match="nothing in common"):
            views.depth_map(lf, 239, 241)

    @pytest.mark.slow
    def test_stripes_that_agree_at_several_distances_are_not_sure(self, blank, period=1.3):
        # Lenses average over their width.
        height = 0.45 * np.sinc(1 / period)
        lf = flat_scene(blank, 246.0, lambda x, y: 0.5 + height * np.sin(2 * np.pi * x / period + 0.7) + 0 * y)
        found = views.depth_map(lf, 205, 290)
        wrong = ~(np.abs(found.depth.values / 246 - 1) < 0.01)
        assert np.count_nonzero(wrong & (found.confidence.values > 0.9)) < 5
        assert float((found.confidence.values[wrong] > 0.5).mean()) < 0.1

    def test_an_even_field_with_few_photons_has_no_depth(self):
        white = mp.Capture(0.5 * views.white_image(CAMERA), CAMERA)
        found = views.depth_map(mp.decode(mp.expose(white, mp.Detector(), photons=500)), planes=24)
        assert float(np.isfinite(found.depth).mean()) < 0.02
        assert float(found.confidence.max()) < 0.9
