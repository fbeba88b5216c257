"""Wavefronts from captures of stars, judged by the terms that made them and by the noise that was added."""

import numpy as np
import pytest
from wavefront_cases import ACCURACY, STAR, WAVELENGTH, captured, telescope

from mitsuba_plenoptic import InputError
from mitsuba_plenoptic.fitting.model import PointRays
from mitsuba_plenoptic.lenses.thin import Wavefront
from mitsuba_plenoptic.system.optical_system import OpticalSystem
from mitsuba_plenoptic.wavefront import (
    InteractionMatrix,
    Slopes,
    Zone,
    fit_wavefronts,
    modes_from_slopes,
    spot_slopes,
    view_slopes,
)

RNG = np.random.default_rng(7)


def test_terms_are_those_of_their_slopes():
    terms = np.r_[0.0, RNG.normal(size=14)]
    radius, angle = 5 * np.sqrt(RNG.random(200)), 2 * np.pi * RNG.random(200)
    pupil = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)
    wavefront = Wavefront(terms, 5.0)
    step = 1e-4
    slope = np.stack(
        [
            (wavefront.path(*(pupil + move).T) - wavefront.path(*(pupil - move).T)) / (2 * step)
            for move in step * np.eye(2)
        ],
        -1,
    )
    found = modes_from_slopes(Slopes(pupil, slope, np.ones(200)), 5.0, 15)
    np.testing.assert_allclose(found, terms, atol=1e-6)
    with pytest.raises(InputError, match="modes"):
        modes_from_slopes(Slopes(pupil[:3], slope[:3], np.ones(3)), 5.0, 15)


def test_views_show_the_slopes_of_a_strong_wavefront():
    # Of rays, of which several lenses receive some from each pupil point and its neighbours.
    camera, terms = telescope(width=3.0, lenses=24, pixels=12), (0.0, 0.8, -0.5, 2.0, 0.3)
    bent, point = camera.replace(wavefront=terms), np.array([STAR])
    image = PointRays(bent, point, WAVELENGTH).image(OpticalSystem(bent, WAVELENGTH), np.ones(1))
    found = modes_from_slopes(view_slopes(camera, image, STAR), 5.0, 5)
    np.testing.assert_allclose(found, terms, atol=0.1)
    with pytest.raises(InputError, match="black"):
        view_slopes(camera, 0 * image, STAR)


def test_spots_show_the_slopes():
    # One photon in one pixel of each of 4 x 3 lenses, moved by one pixel to the right.
    image = np.zeros((15, 20))
    image[2::5, 3::5] = 1
    found = spot_slopes(image, pixels_per_lens=5, pixel_size=0.01, focal_length=2.0, magnification=0.5)
    np.testing.assert_allclose(found.slope, np.tile([0.01 / 2 * 0.5, 0.0], (12, 1)), atol=1e-12)
    np.testing.assert_allclose(found.pupil[[0, -1]], [(-0.15, -0.1), (0.15, 0.1)])
    with pytest.raises(InputError, match="multiples of 4"):
        spot_slopes(image, pixels_per_lens=4, pixel_size=0.01, focal_length=2.0)


def test_small_wavefronts_are_linear():
    camera, terms = telescope(), np.r_[0.0, RNG.normal(size=9) * 0.01]
    zone = Zone([STAR])
    matrix = InteractionMatrix.of(camera, zone, modes=10, accuracy=ACCURACY)
    assert matrix.responses.shape == (9, *camera.shape)
    image = captured(camera, [STAR], 1e6, tuple(terms))
    found = matrix.estimate(image)
    assert np.linalg.norm(found - terms) < 0.15 * np.linalg.norm(terms)
    # Few photons: what is known beforehand helps.
    few = captured(camera, [STAR], 100, tuple(terms))
    errors = [np.linalg.norm(matrix.estimate(few, **given) - terms) for given in ({}, {"prior": 0.01}, {"rank": 4})]
    assert errors[1] < 0.5 * errors[0]
    assert errors[2] < errors[0]
    with pytest.raises(InputError, match="one of the two"):
        matrix.estimate(image, prior=0.01, rank=4)


def test_a_strong_wavefront_is_found_within_its_deviations():
    camera, terms = telescope(), np.r_[0.0, 0.3, -0.2, RNG.normal(size=3) * 0.2]
    image = captured(camera, [STAR], 20000, tuple(terms))
    (found,) = fit_wavefronts(camera, image, Zone([STAR]), modes=6, accuracy=ACCURACY)
    errors = np.array(found.camera.wavefront)[1:] - terms[1:]
    # Chi-squared of five numbers: a hundredth lies beyond 15.1.
    assert errors @ np.linalg.solve(found.covariance, errors) < 15.1
    assert np.linalg.norm(errors) < 0.03


def test_each_zone_has_its_wavefront():
    camera = telescope(lenses=12)
    angle = 2.5 * camera.mla_pitch / 500 * 1e9
    stars = [(angle, 0.0, 1e9), (-angle, 0.0, 1e9)]
    true = [np.r_[0.0, 0.1, 0.0, 0.3], np.r_[0.0, 0.0, -0.1, -0.2]]
    image = sum(captured(camera, [star], 50000, tuple(terms)) for star, terms in zip(stars, true, strict=True))
    found = fit_wavefronts(camera, image, [Zone([star]) for star in stars], modes=4, accuracy=ACCURACY)
    for each, terms in zip(found, true, strict=True):
        np.testing.assert_allclose(each.camera.wavefront, terms, atol=0.02)


def test_bad_zones_are_refused():
    camera = telescope()
    with pytest.raises(InputError, match="weights"):
        Zone([STAR], [-1.0])
    with pytest.raises(InputError, match="zones"):
        fit_wavefronts(camera, np.ones(camera.shape), [])
    with pytest.raises(InputError, match="the camera records"):
        fit_wavefronts(camera, np.ones((3, 3)), Zone([STAR]))
