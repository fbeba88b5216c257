"""Wavefronts from captures of stars, judged by the terms that made them and by the noise that was added."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refuses
from wavefront_cases import ACCURACY, STAR, WAVELENGTH, captured, telescope

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera
from mitsuba_plenoptic import wavefront as wf
from mitsuba_plenoptic.extensions.inverse.point_rays import PointRays
from mitsuba_plenoptic.far_sources import star
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.lenses.thin import Wavefront


@pytest.fixture
def rng():
    """Return random numbers that do not depend on which tests are run before."""
    return np.random.default_rng(7)


def test_terms_are_those_of_their_slopes(rng):
    terms = np.r_[0.0, rng.normal(size=14)]
    radius, angle = 5 * np.sqrt(rng.random(200)), 2 * np.pi * rng.random(200)
    pupil = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)
    wavefront = Wavefront(terms, 5.0)
    step = 1e-4
    sides = [[wavefront.path(*(pupil + sign * move).T) for sign in (1, -1)] for move in step * np.eye(2)]
    slope = np.stack([(high - low) / (2 * step) for high, low in sides], -1)
    np.testing.assert_allclose(wf.modes_from_slopes(wf.Slopes(pupil, slope, np.ones(200)), 5.0, 15), terms, atol=1e-6)
    refuses("modes", wf.modes_from_slopes, wf.Slopes(pupil[:3], slope[:3], np.ones(3)), 5.0, 15)


def test_slopes_count_by_their_light():
    # Two views of one pupil point, which differ in slope and light.
    slopes = wf.Slopes(np.array([(1.0, 2.0)] * 2), np.array([(4e-5, 0.0), (8e-5, 0.0)]), np.array([3.0, 1.0]))
    tilt = wf.modes_from_slopes(slopes, 5.0, 3)
    # A tilt of a waves root mean square has the slope 2 a / radius.
    np.testing.assert_allclose(tilt, [0, 5e-5 * 5.0 / (2 * WAVELENGTH * 1e-6), 0], atol=1e-9)


@pytest.mark.parametrize("star", [STAR, (3e5, -2e5, 1e9)], ids=["on the axis", "beside it"])
def test_views_show_the_slopes_of_a_strong_wavefront(star):
    # Of rays, of which several lenses receive some from each pupil point and its neighbours.
    camera, terms = telescope(width=3.0, lenses=24, pixels=12), (0.0, 0.8, -0.5, 2.0, 0.3)
    bent, point = camera.replace(wavefront=terms), np.array([star])
    image = PointRays(bent, point, WAVELENGTH).image(OpticalSystem(bent, WAVELENGTH), np.ones(1))
    np.testing.assert_allclose(wf.modes_from_slopes(wf.view_slopes(camera, image, star), 5.0, 5), terms, atol=0.1)
    refuses("black", wf.view_slopes, camera, 0 * image, star)


def test_spots_show_the_slopes():
    # One photon in one pixel of each of 4 x 3 lenses, moved by one pixel to the right.
    image = np.zeros((15, 20))
    image[2::5, 3::5] = 1
    found = wf.spot_slopes(image, pixels_per_lens=5, pixel_size=0.01, focal_length=2.0, magnification=0.5)
    np.testing.assert_allclose(found.slope, np.tile([0.01 / 2 * 0.5, 0.0], (12, 1)), atol=1e-12)
    np.testing.assert_allclose(found.pupil[[0, -1]], [(-0.15, -0.1), (0.15, 0.1)])
    refuses("multiples of 4", wf.spot_slopes, image, pixels_per_lens=4, pixel_size=0.01, focal_length=2.0)


def test_spots_behind_a_collimator_show_the_terms_with_their_signs():
    sensor, terms = PlenopticCamera.preset("shack_hartmann"), np.array([0.0, 0.2, -0.1, 0.15, 0.1, -0.1, 0.12, -0.08])

    def slopes(wavefront=()):
        points, weights = star()
        seen = sensor.replace(wavefront=wavefront)
        image = CaptureOperator(seen, points, wavelength=WAVELENGTH, method="full_field").forward(weights)
        options = {"pixel_size": 0.01, "magnification": -sensor.main_lens.magnification(sensor.focal_length)}
        return wf.spot_slopes(image, pixels_per_lens=32, focal_length=16.0, **options)

    flat, found = slopes(), slopes(tuple(terms))
    bent = replace(found, slope=found.slope - flat.slope)
    np.testing.assert_allclose(wf.modes_from_slopes(bent, 5.0, 8), terms, atol=0.001)
    # A tilt, of which all lenses see the same.
    within = flat.light > 0.95 * flat.light.max()
    moved = (slopes((0.0, 0.5)).slope - flat.slope)[within] / (0.5 * 2 / 5.0 * WAVELENGTH * 1e-6)
    np.testing.assert_allclose(moved.mean(0), (1, 0), atol=0.002)


def test_a_slope_over_a_lens_is_its_mean_in_the_pupil():
    # That of spherical aberration over squares, from differences of the path along their edges.
    terms, width = np.r_[np.zeros(10), 0.2], 1.25
    wavefront, places = Wavefront(terms, 5.0), (np.arange(6) - 2.5) * width
    pupil = np.stack(np.meshgrid(places, places), -1).reshape(-1, 2)
    # Squares that are whole in the pupil.
    pupil = pupil[np.hypot(*(np.abs(pupil) + width / 2).T) < 5]
    along, steps = (np.arange(400) + 0.5) / 400 * width - width / 2, np.array([-1, 1]) * width / 2
    x, y = pupil[:, 0, None], pupil[:, 1, None]
    right, left = (wavefront.path(x + s, y + along).mean(1) for s in steps[::-1])
    above, below = (wavefront.path(x + along, y + s).mean(1) for s in steps[::-1])
    slope = np.stack([right - left, above - below], -1) / width
    found = wf.modes_from_slopes(wf.Slopes(pupil, slope, np.ones(len(pupil)), width), 5.0, 11)
    np.testing.assert_allclose(found, terms, atol=2e-3)
    # Taken for slopes at the middles, a part of the spherical aberration is defocus.
    assert abs(wf.modes_from_slopes(wf.Slopes(pupil, slope, np.ones(len(pupil))), 5.0, 11)[3]) > 5e-3


def test_small_wavefronts_are_linear(rng):
    camera, terms = telescope(), np.r_[0.0, rng.normal(size=9) * 0.01]
    matrix = wf.InteractionMatrix.of(camera, wf.Zone([STAR]), modes=10, accuracy=ACCURACY)
    assert matrix.responses.shape == (9, *camera.shape)
    image = captured(camera, [STAR], 1e6, tuple(terms))
    assert np.linalg.norm(matrix.estimate(image) - terms) < 0.15 * np.linalg.norm(terms)
    # Few photons: what is known beforehand helps.
    few = captured(camera, [STAR], 100, tuple(terms))
    errors = [np.linalg.norm(matrix.estimate(few, **given) - terms) for given in ({}, {"prior": 0.01}, {"rank": 4})]
    assert errors[1] < 0.5 * errors[0]
    assert errors[2] < errors[0]
    refuses("one of the two", matrix.estimate, image, prior=0.01, rank=4)


def test_linear_estimates_of_photons_scatter_by_the_cramer_rao_bound(rng):
    matrix, photons = wf.InteractionMatrix.of(telescope(), wf.Zone([STAR]), modes=6, accuracy=ACCURACY), 1e5
    lit = matrix.reference > 1 / photons
    rows = (matrix.responses / np.sqrt(np.maximum(matrix.reference, 1e-12)))[:, lit] * np.sqrt(photons)
    bound = np.sqrt(np.trace(np.linalg.inv(rows @ rows.T)))
    mean = photons * np.maximum(matrix.reference, 0)
    found = np.array([matrix.estimate(rng.poisson(mean)) for _ in range(100)])
    assert np.sqrt((found**2).sum(1).mean()) == pytest.approx(bound, rel=0.15)


def test_a_matrix_is_of_all_points_by_their_weights():
    points, weights = [STAR, (4e5, 0.0, 1e9)], [1.0, 3.0]
    matrix = wf.InteractionMatrix.of(telescope(), wf.Zone(points, weights), modes=2, accuracy=ACCURACY)
    image = CaptureOperator(telescope(), points, wavelength=WAVELENGTH, accuracy=ACCURACY).forward(weights)
    np.testing.assert_allclose(matrix.reference, image / image.sum(), atol=1e-4 * matrix.reference.max())


@pytest.mark.slow
def test_a_strong_wavefront_is_found_within_its_deviations(rng):
    camera, terms = telescope(), np.r_[0.0, 0.3, -0.2, rng.normal(size=3) * 0.2]
    image = captured(camera, [STAR], 20000, tuple(terms))
    found = wf.fit_wavefronts(camera, image, wf.Zone([STAR]), modes=6, accuracy=ACCURACY)
    errors = np.array(found.camera.wavefront)[1:] - terms[1:]
    # Chi-squared of five numbers: a hundredth lies beyond 15.1.
    assert errors @ np.linalg.solve(found.covariance, errors) < 15.1
    assert np.linalg.norm(errors) < 0.03


def test_a_star_beside_the_detector_is_warned_of():
    """A shift of the image by d is a tilt of d radius / 2 b wavelengths, root mean square."""
    camera, beside = telescope(lenses=4), 1.0
    place = camera.detector_width / 2 + beside
    tilt = place * camera.aperture_radius / camera.mla_distance / (2 * WAVELENGTH * 1e-6)
    # Stars upside down: an image at x has its star at -x g / b.
    image, zone = captured(camera, [STAR], 20000), wf.Zone([(-place * 1e9 / camera.mla_distance, 0, 1e9)])
    # The margin is the lens that receives diffracted light.
    with pytest.warns(UserWarning, match=f"is {beside - camera.mla_pitch:.3g} mm .*tilt of {tilt:.3g} waves"):
        found = wf.fit_wavefronts(camera, image, zone, modes=3, accuracy=ACCURACY)
    assert abs(found.camera.wavefront[1]) == pytest.approx(tilt, abs=0.02)


@pytest.mark.slow
def test_fits_of_two_stars_keep_the_terms_that_are_not_fitted():
    known, terms = (0.0, 0.1, 0.0, 0.2, 0.0, 0.0, 0.15), (0.0, 0.15, -0.1, 0.25, 0.0, 0.0, 0.15)
    stars, weights = [STAR, (1e5, 0.0, 1e9)], [1.0, 4.0]
    light = [captured(telescope(), [star], 50000 * w, terms) for star, w in zip(stars, weights, strict=True)]
    zone = wf.Zone(stars, weights)
    found = wf.fit_wavefronts(telescope(wavefront=known), sum(light), zone, modes=4, accuracy=ACCURACY)
    assert found.camera.wavefront[4:] == known[4:]
    np.testing.assert_allclose(found.camera.wavefront[:4], terms[:4], atol=0.006)


def test_bad_zones_lenses_and_slopes_are_refused():
    camera = telescope()
    refuses("weights", wf.Zone, [STAR], [-1.0])
    refuses("the camera records", wf.fit_wavefronts, camera, np.ones((3, 3)), wf.Zone([STAR]))
    refuses("zone of type list", wf.fit_wavefronts, camera, np.ones(camera.shape), [wf.Zone([STAR])])
    beside = wf.Zone([(50 * camera.mla_pitch / 500 * 1e9, 0.0, 1e9)])
    refuses("no light", wf.InteractionMatrix.of, camera, beside, modes=3, accuracy=ACCURACY)

    camera = PlenopticCamera(main_lens={"collimator_focal_length": 160.0})
    refuses("^main_lens = ", wf.fit_wavefronts, camera, np.ones(camera.shape), wf.Zone([STAR]))
    refuses("^main_lens = ", wf.view_slopes, camera, np.ones(camera.shape), STAR)
    some = np.ones((9, 2))
    for slope, light in ((some * np.nan, np.ones(9)), (some, np.zeros(9))):
        refuses("finite", wf.modes_from_slopes, wf.Slopes(some, slope, light), 5.0, 4)
    options = {"pixels_per_lens": 2, "pixel_size": 0.01, "focal_length": 2.0, "magnification": 0}
    refuses("magnification = 0", wf.spot_slopes, np.ones((4, 4)), **options)
