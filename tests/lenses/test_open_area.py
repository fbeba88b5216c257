"""The open part of a real main lens's exit pupil, against rays that are counted."""

import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.lenses.fitted_lens import open_area

HEIGHTS = np.array([0.0, 4.0, 8.0, 10.0])
POINTS = np.column_stack([0 * HEIGHTS, -HEIGHTS * 118 / 60, 118.0 + 0 * HEIGHTS])
WAVELENGTH = 587.5618


def triplet(**numbers):
    """A lens that lets through the less the farther from the axis."""
    given = {"focal_length": 40.0, "aperture_radius": 3.5, "mla_distance": 60.0} | numbers
    return PlenopticCamera(main_lens="cooke_triplet", detector_width=16.0, resolution=(64, 64), **given)


def area(**numbers):
    return open_area(OpticalSystem(triplet(**numbers), WAVELENGTH).waves_of(POINTS), POINTS)


def test_area_against_rays():
    camera = triplet()
    lens = OpticalSystem(camera, WAVELENGTH).waves_of(POINTS)
    images = np.hypot(*lens.images(POINTS).T)
    counted = lens.open_fraction(0 * images, images) * np.pi * lens.reach**2
    # From a place in focus the array sees the part of the pupil that the point lights.
    assert area() == pytest.approx(counted, rel=0.005)
    assert area()[-1] < 0.97 * area()[0]


@pytest.mark.parametrize("apart", [0.0, 1.0], ids=["one place", "many places"])
def test_many_points_are_interpolated(apart):
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-12, 12, (80, 2)), rng.uniform(100, 140, 80)])
    points = points[:1] + apart * (points - points[:1])
    lens = OpticalSystem(triplet(), WAVELENGTH).waves_of(points)
    single = np.concatenate([open_area(lens, points[at : at + 1]) for at in range(0, 80, 10)])
    assert open_area(lens, points)[::10] == pytest.approx(single, rel=2e-3)
