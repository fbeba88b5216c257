"""The exit pupil of a real main lens: its path against traced directions, its edge against rays that get through."""

import numpy as np
import pytest

from mitsuba_plenoptic import LensSystem, PlenopticCamera, point_spread_function
from mitsuba_plenoptic.lenses.pupil_fit import ExitPupil

POINT, WAVELENGTH = (20.0, -60.0, 300.0), 633.0


def camera_with(name, **numbers):
    return PlenopticCamera(main_lens=name, focal_length=80, aperture_radius=7, **numbers)


def slopes_of_path(pupil, places, step=1e-3):
    """Return the direction cosines of light by differences of the path."""
    cosines = []
    for axis in (0, 1):
        low, high = ([p + sign * step * (k == axis) for k, p in enumerate(places)] for sign in (-1, 1))
        change = pupil.path(high, POINT, WAVELENGTH) - pupil.path(low, POINT, WAVELENGTH)
        cosines.append(change * WAVELENGTH * 1e-6 / (2 * step))
    return cosines


@pytest.fixture(scope="module", params=["double_gauss", "cooke_triplet", "tessar", "singlet"])
def lens(request):
    return LensSystem.of(camera_with(request.param), WAVELENGTH)


def test_rays_along_its_light_lead_back_to_the_point(lens):
    pupil = ExitPupil.of(lens, POINT)
    assert pupil.error < 0.01
    places = tuple(pupil.bundle[0][::7].T)
    start, slope, is_open = lens.ray(places, pupil.land(places, None))
    assert is_open.mean() > 0.95
    for axis in (0, 1):
        met = start[axis] + (POINT[2] - start[2]) * slope[axis]
        assert np.abs(met - POINT[axis])[is_open].max() < 1e-3


def test_the_gradient_of_the_path_is_the_direction_of_its_light(lens):
    pupil = ExitPupil.of(lens, POINT)
    places, cosines = (values[::7].T for values in pupil.bundle)
    assert np.allclose(slopes_of_path(pupil, places), cosines, atol=2e-7)


def test_light_ends_where_surfaces_end_it(lens):
    """Rays from the array through places of the pupil to the scene are let through inside the edge only."""
    pupil = ExitPupil.of(lens, POINT)
    places = pupil.bundle[0].T
    assert pupil.inside(tuple(places)).min() > -0.02
    # Along a line through the middle the way back through the lens tells the same edge.
    middle = places.mean(1)
    for angle in np.linspace(0, np.pi, 5):
        away = np.linspace(0, 9, 181)
        line = [m + away * t for m, t in zip(middle, (np.cos(angle), np.sin(angle)), strict=True)]
        slope = slopes_of_path(pupil, line)
        with np.errstate(invalid="ignore"):
            # Far beyond the edge the polynomials mean nothing.
            scale = 1 / np.sqrt(1 - slope[0] ** 2 - slope[1] ** 2)
            slope = [s * scale for s in slope]
            place = tuple(p + lens.pupil.distance * t for p, t in zip(line, slope, strict=True))
            # The camera looks the other way along the same line.
            _, _, is_open = lens.trace(place, tuple(-t for t in slope))
        edge = away[np.argmin(is_open)]
        assert away[np.argmin(pupil.inside(tuple(line)) > 0)] == pytest.approx(edge, abs=0.051)


@pytest.mark.slow
def test_a_full_field_goes_through_it():
    camera = camera_with("double_gauss", detector_width=0.256, resolution=(128, 128))
    spread = point_spread_function(camera, (0.0, 0.0, 240.0), wavelength=WAVELENGTH, method="full_field")
    assert 0.97 < spread.sum() <= 1
    # It is as symmetric as lens and lattice are.
    assert np.allclose(spread, spread[::-1], atol=1e-3 * spread.max())
