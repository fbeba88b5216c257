"""The open part of a real main lens's exit pupil, against rays that are counted."""

import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.lenses.fitted_lens import open_area, open_area_slopes

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


@pytest.mark.parametrize(
    ("name", "step"), [pytest.param("aperture_radius", 0.02, marks=pytest.mark.slow), ("focal_length", 0.2)]
)
def test_slopes_against_areas_of_other_lenses(name, step):
    found = open_area_slopes(OpticalSystem(triplet(), WAVELENGTH).waves_of(POINTS), name, POINTS)
    value = getattr(triplet(), name)
    more, less = (area(**{name: value + side * step}) for side in (1, -1))
    expected = np.log(more / less) / (2 * step)
    assert found == pytest.approx(expected, rel=0.03, abs=1e-4)
    if name == "aperture_radius":
        assert found[0] == pytest.approx(2 / 3.5, rel=0.03)
        assert found[-1] < 0.75 * found[0]


def test_numbers_that_move_no_edge():
    assert (open_area_slopes(OpticalSystem(triplet(), WAVELENGTH).waves_of(POINTS), "mla_distance", POINTS) == 0).all()


@pytest.mark.parametrize("apart", [0.0, 1.0], ids=["one place", "many places"])
def test_many_points_are_interpolated(apart):
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-12, 12, (80, 2)), rng.uniform(100, 140, 80)])
    points = points[:1] + apart * (points - points[:1])
    lens = OpticalSystem(triplet(), WAVELENGTH).waves_of(points)
    single = np.concatenate([open_area(lens, points[at : at + 1]) for at in range(0, 80, 10)])
    assert open_area(lens, points)[::10] == pytest.approx(single, rel=2e-3)
