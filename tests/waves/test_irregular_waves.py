"""Irregular and warped arrays by rays and waves: explicit sums, displaced micro-images, figure errors."""

import mitsuba as mi
import numpy as np
import pytest
from cameras import HALF, error, small_camera, warped

from mitsuba_plenoptic import InputError, PlenopticCamera, point_spread_function
from mitsuba_plenoptic.views import lens_grid, white_image
from tools.bench.cases.arrays import GREEN, centroids, propagated

POINT = np.array([0.03, -0.02, 114.0])


@pytest.mark.slow
def test_full_fields_of_irregular_arrays_against_explicit_sums():
    camera = small_camera(2, **HALF, mla_jitter=(0.002, 0.03), mla_seed=3, mla_cra=(0, 0, 0.04, 0.5, 0.1, 0.8))

    def path(x, y):
        lens = camera.lenslet(*camera.lattice.cell(x, y))
        return -((x - lens.centre[0]) ** 2 + (y - lens.centre[1]) ** 2) / (2 * lens.focal_length)

    found = point_spread_function(camera, POINT, wavelength=GREEN, method="full_field")
    regular = camera.replace(mla_jitter=(0.0, 0.0), mla_cra=())
    expected = propagated(camera, path, POINT, GREEN)
    assert error(found, expected) < 0.01
    assert error(point_spread_function(regular, POINT, wavelength=GREEN, method="full_field"), expected) > 0.05


def test_a_figure_error_has_its_size_and_correlation():
    x, sizes, products = np.array([0.0, 0.02]), [], []
    for seed in range(400):
        wrong = PlenopticCamera(mla_figure_error=(5e-5, 0.02), mla_seed=seed).figure_error
        first, second = wrong.path(x, 0 * x + 0.1)
        sizes.append(first * first)
        products.append(first * second)
    assert np.mean(sizes) == pytest.approx(25e-10, rel=0.15)
    assert np.mean(products) / np.mean(sizes) == pytest.approx(np.exp(-0.5), abs=0.12)
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 50))
    for axis, found in enumerate(wrong.slopes(x, y)):
        a, b = ((1e-6, 0), (0, 1e-6))[axis]
        assert np.allclose(found, (wrong.path(x + a, y + b) - wrong.path(x - a, y - b)) / 2e-6, atol=1e-8)


@pytest.mark.parametrize("lens_model", ["ideal", "parabolic"])
def test_a_figure_error_deflects_rays(lens_model):
    mi.set_variant("llvm_ad_mono")
    film, lens = np.random.default_rng(1).random((2, 2, 500)).astype(np.float32)
    origins = []
    for size in (0.0, 5e-5):
        camera = small_camera(2, lens_model=lens_model, mla_figure_error=(size, 0.02))
        ray, _ = mi.load_dict(camera.to_sensor()).sample_ray(0.0, 0.5, mi.Point2f(film), mi.Point2f(lens))
        origins.append(np.array(ray.o)[:2])
    p = (film - 0.5) * camera.detector_width
    centre = np.stack(camera.lattice.centre(*camera.lattice.cell(*(p * 120 / 120.512))))
    offset = np.stack(camera.lattice.aperture_point(*lens.astype(float)))
    expected = 120 * np.stack(camera.figure_error.slopes(*(centre + offset)))
    within = np.abs(origins[0]).max(0) < 5
    assert np.abs(origins[1] - origins[0] - expected)[:, within].max() < 0.02 * np.abs(expected).max()


def test_micro_images_are_displaced_by_the_polynomial():
    """To 0.02 pixels, of up to 3; the centres are c (b + z) / b. White images are those of rays by a relation."""
    camera, moved = warped(small_camera(8, crop_offset=(32, 0), crop_size=(224, 256)), 2.7, 18)
    regular = (np.array([(i, j) for i in range(-3, 3) for j in range(-3, 3)]) + 0.5) * camera.mla_pitch
    aside = moved(*regular.T).T
    expected = (regular + aside) * (1 + 0.512 / 120) / camera.pixel_size + 128 - camera.crop_offset
    assert np.hypot(*aside.T).max() > 0.6 * camera.pixel_size
    found = lens_grid(camera).centres().reshape(-1, 2)
    assert np.hypot(*(found[:, None] - expected).transpose(2, 0, 1)).min(0).max() < 1e-9
    assert np.abs(centroids(white_image(camera), expected) - expected).max() < 0.02


def test_polynomials_turn_with_their_frame():
    camera, _ = warped(PlenopticCamera(), 3.0, 18)
    shifts, (x, y) = camera.lattice.displacement, np.random.default_rng(0).uniform(-4, 4, (2, 20))
    angle = np.radians(25)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    # A place of the turned frame, brought to the camera's, displaced and brought back.
    assert np.allclose(shifts.turned(25).smooth(x, y), turn.T @ np.array(shifts.smooth(*(turn @ [x, y]))), atol=1e-12)
    assert np.allclose(shifts.regular(*np.add([x, y], shifts.smooth(x, y))), [x, y], atol=1e-6)


def test_a_steep_warp_is_refused_and_zeros_are_none():
    with pytest.raises(InputError, match=r"0\.1[0-9]* mm per mm"):
        small_camera(10).replace(mla_warp=(0.125, 0.125))
    assert PlenopticCamera(mla_warp=[0.0] * 9) == PlenopticCamera()
    assert [len(PlenopticCamera(mla_warp=(1e-6,) * count).mla_warp) for count in (1, 14, 36)] == [14, 14, 36]


def test_lenses_in_a_rectangle_are_those_whose_displaced_centres_lie_in_it():
    camera, _ = warped(small_camera(20), 5.0, 18)
    low, high = (-0.288, -0.2), (0.416, 0.48)
    found = {tuple(index) for index in camera.lattice.lenses_within(low, high)}
    i, j = (index.ravel() for index in np.mgrid[-15:15, -15:15])
    x, y = camera.lattice.centre(i.astype(float), j.astype(float))
    inside = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
    assert found == set(zip(i[inside].tolist(), j[inside].tolist(), strict=True))
    assert found != {tuple(index) for index in camera.lattice.regular.lenses_within(low, high)}
