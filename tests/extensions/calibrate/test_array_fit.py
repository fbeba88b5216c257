"""Warps of fifth degree, found in places of lenses and in white pictures, and not found where there are none."""

import numpy as np
import pytest
import scipy.ndimage

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.calibration import fit_white
from mitsuba_plenoptic.extensions.calibrate.array_fit import fit_array, places
from mitsuba_plenoptic.views import lens_grid, white_image

STRAIGHT = PlenopticCamera(
    focal_length=50, aperture_radius=3.0, focus_distance=400, mla_focal_length=0.8, mla_pitch=0.1, mla_rotation=0.2,
    mla_offset=(0.013, -0.021), detector_width=3.0, resolution=(300, 260),
)  # fmt: skip
"""30 x 26 lenses of ten pixels."""

# Up to 0.3 pixels along x and along y, by Chebyshev's 16 t^5 - 20 t^3 + 5 t, which no lower degree resembles.
SIZE = 0.3 * STRAIGHT.pixel_size / STRAIGHT.image_growth
FIFTH = np.zeros((2, 18))
FIFTH[0, [3, 12]] = SIZE * np.array([-20 / 1.5**3, 16 / 1.5**5])
FIFTH[1, [6, 17]] = SIZE * np.array([-20 / 1.3**3, 16 / 1.3**5])
WARPED = STRAIGHT.replace(mla_warp=tuple(FIFTH.ravel()))


@pytest.mark.parametrize(
    ("camera", "lenses", "terms", "most"),
    [(STRAIGHT, 25, 0, 0.01), (WARPED, 25, 18, 0.03), (WARPED, 17, 7, 0.6), (WARPED, 11, 0, 0.6)],
)
def test_withheld_places_choose_the_degree(camera, lenses, terms, most):
    """Of centres with noise of 0.02 pixels, where lenses suffice: 20 for each term; 17 x 17 are too few for 18."""
    index = np.stack(np.meshgrid(*2 * [np.linspace(-12.0, 12.0, lenses).round()]), axis=-1).reshape(-1, 2)
    centre = np.stack(camera.lattice.centre(*index.T), axis=-1)
    true = centre * camera.image_growth / camera.pixel_size + (np.array(camera.resolution) - 1) / 2
    noise = np.random.default_rng(1).normal(0, 0.02, true.shape)
    fit = fit_array(true + noise, index, STRAIGHT)
    assert np.flatnonzero(fit.warp.reshape(2, -1).any(0)).max(initial=-1) + 1 == terms
    assert np.hypot(*(places(fit, index, camera) - true).T).max() < most


@pytest.mark.slow
def test_a_warp_of_fifth_degree_is_found_in_a_white_picture():
    light = scipy.ndimage.gaussian_filter(white_image(WARPED), 0.8) * 0.97 + 0.03
    generator = np.random.default_rng(0)
    white, dark = generator.poisson(20000 * light), generator.normal(0, 2, light.shape)
    fit = fit_white(white, STRAIGHT, dark=dark, wavelength=None)
    assert len(fit.camera.mla_warp) == 36
    off = places(fit.array, fit.lens, fit.camera)[:, None] + 0.5 - lens_grid(WARPED).centres().reshape(-1, 2)
    assert np.hypot(*off.transpose(2, 0, 1)).min(1).max() < 0.03
