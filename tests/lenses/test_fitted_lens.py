"""A real main lens fitted over pupil, field and distance: against single points, traced rays and the thin lens."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from cameras import thin_as_real

from mitsuba_plenoptic import LensSystem, PlenopticCamera
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.lenses.common import inverse_distance, path_change
from mitsuba_plenoptic.lenses.fitted_lens import open_area
from mitsuba_plenoptic.lenses.pupil import Pupil
from mitsuba_plenoptic.lenses.pupil_fit import ExitPupil
from mitsuba_plenoptic.lenses.thin import ThinLens
from mitsuba_plenoptic.points.accuracy import band_for
from mitsuba_plenoptic.points.field_grid import Grid, place
from mitsuba_plenoptic.points.patch import PatchBatch
from mitsuba_plenoptic.points.patch_factors import Fields
from mitsuba_plenoptic.points.tile import Copies, PatchTile

WAVELENGTH = 633.0


def points_before(count=12, seed=1):
    """Points from 200 to 300 mm whose images fill the paper's detector and a little more."""
    rng = np.random.default_rng(seed)
    return np.column_stack([*rng.uniform(-11, 11, (2, count)), rng.uniform(200, 300, count)])


@pytest.fixture(scope="module", params=[("double_gauss", 10), ("cooke_triplet", 7)])
def camera(request):
    name, radius = request.param
    return PlenopticCamera(main_lens=name, focal_length=80, aperture_radius=radius, focus_distance=240)


def test_its_light_is_that_which_is_fitted_to_one_point(camera):
    """Path to a hundredth of a wave and much better, amplitude, and the edges near them."""
    points = points_before()
    lens = OpticalSystem(camera, WAVELENGTH).waves_of(points)
    assert 0 < lens.fitted.error < 0.01
    for point in points[:4]:
        one = ExitPupil.of(LensSystem.of(camera, WAVELENGTH), tuple(point))
        pupil = one.bundle[0].T[:, ::5]
        light, own = lens.bind(point[None]), tuple(P[None] for P in pupil)
        assert np.std(light.path(own, None, WAVELENGTH)[0] - one.path(tuple(pupil), None, WAVELENGTH)) < 2e-3
        amplitude = light.amplitude(own, None)[0] / one.amplitude(tuple(pupil), None)
        assert np.std(amplitude) / np.mean(amplitude) < 1e-5
        theirs = one.inside(tuple(pupil))
        near = np.abs(theirs) < 0.5
        assert near.any()
        assert np.allclose(light.inside(own)[0][near], theirs[near], atol=1e-3)


def test_light_lands_where_rays_come_from_and_ends_where_they_are_stopped(camera):
    """Rays from the array through places anywhere in the pupil's circle lead back, or are stopped by an edge."""
    points, rng = points_before(), np.random.default_rng(2)
    lens = OpticalSystem(camera, WAVELENGTH).waves_of(points)
    light, P = lens.bind(points), lens.pupil.radius * rng.uniform(-1, 1, (2, len(points), 400))
    point, slope, is_open = lens.ray((P[0], P[1]), light.land((P[0], P[1]), None))
    inside = light.inside((P[0], P[1]))
    assert ((inside > 0) == light.is_open((P[0], P[1]))).all()
    assert np.abs(inside[is_open != (inside > 0)]).max(initial=0) < 1e-3
    for axis in (0, 1):
        met = point[axis] + (points[:, 2:] - point[2]) * slope[axis]
        assert np.abs(met - points[:, axis, None])[is_open].max() < 3e-4


def test_points_are_found_from_their_images(camera):
    points = points_before()
    lens = OpticalSystem(camera, WAVELENGTH).waves_of(points)
    assert np.allclose(lens.points(lens.images(points), inverse_distance(lens, points)), points, atol=1e-9)


THIN = ThinLens(80.0, Pupil(5.0, 120.0), "parabolic")


@pytest.fixture(scope="module")
def fitted_thin_lens():
    return thin_as_real(PlenopticCamera(), 0.06, (1 / 290, 1 / 205))


def test_the_thin_lens_by_the_way_of_real_ones_is_the_thin_lens(fitted_thin_lens):
    mi.set_variant("llvm_ad_mono")
    camera = PlenopticCamera(lens_model="parabolic")
    for point in np.array([(0.3, -0.2, 240.0), (5.6, -5.5, 210.0), (-8.0, 3.0, 280.0)]):
        grid = Grid.of(OpticalSystem(camera, WAVELENGTH), band_for(0.01, 1), point[None])
        placement = place(grid, point[None])
        copies = [Copies(np.zeros((1, 2), np.int64), np.ones((1, 1), np.float32))]
        own, other = (
            PatchTile(PatchBatch(Fields(g, placement, point[None], None), np.ones(1)), copies)
            .sum()
            .sums.astype(np.float64)
            for g in (grid, replace(grid, lens=fitted_thin_lens))
        )
        assert np.linalg.norm(other - own) < 1e-6 * np.linalg.norm(own)


def test_wavefronts_change_over_the_field_as_the_thin_lens_tells(fitted_thin_lens):
    """Its closed form is of the third order, and that of images in focus: the bounds of sharing go by it."""
    radius = np.array([0.0, 2.0, 5.0])
    found = path_change(fitted_thin_lens, radius, 0.064, WAVELENGTH)
    assert np.all(found < 1.6 * path_change(THIN, radius, 0.064, WAVELENGTH))
    assert np.all(found > 0.5 * path_change(THIN, radius, 0.064, WAVELENGTH))


HEIGHTS = np.array([0.0, 4.0, 8.0, 10.0])
POINTS = np.column_stack([0 * HEIGHTS, -HEIGHTS * 118 / 60, 118.0 + 0 * HEIGHTS])
LINE_D = 587.5618

TRIPLET = PlenopticCamera(
    main_lens="cooke_triplet", focal_length=40.0, aperture_radius=3.5, mla_distance=60.0, detector_width=16.0
)
"""A lens that lets through the less the farther from the axis."""


def test_area_against_rays():
    lens = OpticalSystem(TRIPLET, LINE_D).waves_of(POINTS)
    images = np.hypot(*lens.images(POINTS).T)
    counted = lens.open_fraction(0 * images, images) * np.pi * lens.reach**2
    # From a place in focus the array sees the part of the pupil that the point lights.
    area = open_area(lens, POINTS)
    assert area == pytest.approx(counted, rel=0.005)
    assert area[-1] < 0.97 * area[0]


@pytest.mark.parametrize("apart", [0.0, 1.0], ids=["one place", "many places"])
def test_many_points_are_interpolated(apart):
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-12, 12, (80, 2)), rng.uniform(100, 140, 80)])
    points = points[:1] + apart * (points - points[:1])
    lens = OpticalSystem(TRIPLET, LINE_D).waves_of(points)
    single = np.concatenate([open_area(lens, points[at : at + 1]) for at in range(0, 80, 10)])
    assert open_area(lens, points)[::10] == pytest.approx(single, rel=2e-3)
