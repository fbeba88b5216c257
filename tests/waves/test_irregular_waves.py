"""Irregular arrays by waves: displaced lenses and figure errors, against explicit sums over all lenses."""

import mitsuba as mi
import numpy as np
import pytest
from cameras import HALF, error, small_camera

from mitsuba_plenoptic import PlenopticCamera, point_spread_function
from tools.bench.cases.arrays import GREEN, SHAPES, propagated

POINT = np.array([0.03, -0.02, 114.0])


@pytest.mark.parametrize(
    "changes",
    [
        {"mla_jitter": (0.002, 0.03), "mla_seed": 3, "mla_cra": (0, 0, 0.04, 0.5, 0.1, 0.8)},
        pytest.param({"mla_jitter": (0.002, 0.0), "mla_shape": SHAPES["sphere"]}, marks=pytest.mark.slow),
        pytest.param({"mla_figure_error": (5e-5, 0.02)}, marks=pytest.mark.slow),
    ],
    ids=["parabolic", "spherical", "figure error"],
)
def test_full_fields_of_irregular_arrays_against_explicit_sums(changes):
    camera = small_camera(2, **HALF, **changes)

    def path(x, y):
        lens = camera.lenslet(*camera.lattice.cell(x, y))
        r2 = (x - lens.centre[0]) ** 2 + (y - lens.centre[1]) ** 2
        own = 0.5 * (np.sqrt(0.25**2 - r2) - 0.25) if camera.mla_shape else -r2 / (2 * 0.512)
        wrong = camera.figure_error
        return own * camera.mla_focal_length / lens.focal_length + (0 if wrong is None else wrong.path(x, y))

    found = point_spread_function(camera, POINT, wavelength=GREEN, method="full_field")
    regular = camera.replace(mla_jitter=(0.0, 0.0), mla_figure_error=(0.0, 0.0), mla_cra=())
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
