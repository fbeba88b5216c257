"""Microlens lattices: cells, centres, apertures and neighbours, and what it takes to add one."""

import itertools
import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cases import scene_of
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsuba_plenoptic import design, reconstruct, render_capture
from mitsuba_plenoptic.array import APERTURES, LATTICES, Lattice, make_lattice
from mitsuba_plenoptic.array.arrangement import regular_corners
from mitsuba_plenoptic.runtime.backend import floor
from mitsuba_plenoptic.views import white_image

PITCH = 0.064
PITCHES = {"equal": (PITCH, PITCH), "flat": (PITCH, 0.9 * PITCH), "tall": (PITCH, 1.3 * PITCH)}

ANY_LATTICE = st.builds(
    make_lattice,
    name=st.sampled_from(list(LATTICES)),
    pitches=st.sampled_from(list(PITCHES.values())),
    rotation=st.floats(-180, 180),
    offset=st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
    aperture=st.sampled_from(list(APERTURES)),
    fill=st.floats(0.1, 1),
)
EACH_LATTICE = pytest.mark.parametrize("name", LATTICES)
EACH_PITCHES = pytest.mark.parametrize("pitches", PITCHES.values(), ids=PITCHES)


@settings(max_examples=20, deadline=None)
@given(ANY_LATTICE, st.floats(-20, 20), st.floats(-20, 20))
def test_a_cell_is_what_is_nearest_to_its_centre_but_for_the_stretch(lattice, x, y):
    x, y = x * PITCH, y * PITCH
    i, j = lattice.cell(x, y)
    index = np.mgrid[-3:4, -3:4].reshape(2, -1).T + np.array([i, j])

    def distance(i, j):
        u, v = lattice.to_frame(*(np.array(lattice.centre(i, j)).T - [x, y]).T)
        return np.hypot(u, v / lattice.aspect)

    assert distance(i, j) <= distance(*index.T).min() + 1e-9
    # The three forms of numbers agree.
    for ours in (lattice.cell(np.array([x]), np.array([y])), lattice.cell(mi.Float64([x]), mi.Float64([y]))):
        np.testing.assert_array_equal(np.ravel(ours), [i, j])


@settings(max_examples=40, deadline=None)
@given(ANY_LATTICE, st.integers(-50, 50), st.integers(-50, 50))
def test_a_centre_is_in_its_own_cell_and_basis_vectors_lead_to_the_next(lattice, i, j):
    x, y = lattice.centre(float(i), float(j))
    assert tuple(map(float, lattice.cell(x, y))) == (i, j)
    for step, (di, dj) in zip(lattice.basis, ((1, 0), (0, 1)), strict=True):
        np.testing.assert_allclose(np.array(lattice.centre(i + di, j + dj)) - [x, y], step, atol=1e-9)
    (ax, ay), (bx, by) = lattice.basis
    assert math.hypot(ax, ay) == pytest.approx(PITCH)
    assert ax * by - ay * bx == pytest.approx(lattice.cell_area)
    di, dj = np.mgrid[-2:3, -2:3].reshape(2, -1)
    around = np.hypot(*np.array(lattice.centre(i + di, j + dj)) - [[x], [y]])
    assert np.sort(around)[1] == pytest.approx(lattice.nearest_distance)


@settings(max_examples=20, deadline=None)
@given(ANY_LATTICE, st.integers(-9, 9), st.integers(-9, 9))
def test_a_lattice_repeats_after_its_period_and_stands_on_its_grid(lattice, i, j):
    u, v = lattice.to_frame(*np.array(lattice.centre(float(i), float(j))) - lattice.centre(0.0, 0.0))
    for place, step in zip((u, v), lattice.grid_step, strict=True):
        assert abs(place / step - round(place / step)) < 1e-9
    width, height = lattice.period(lattice.lens_types)
    for step in ((width, 0.0), (0.0, height)):
        x, y = np.array(lattice.centre(float(i), float(j))) + lattice.from_frame(*step)
        there = lattice.cell(x, y)
        np.testing.assert_allclose(lattice.centre(*there), (x, y), atol=1e-9)
        assert lattice.lens_type(*there) == lattice.lens_type(float(i), float(j))


def test_a_hexagonal_lattice_has_a_lens_on_the_axis_and_six_neighbours_at_one_pitch():
    lattice = make_lattice("hexagonal", (PITCH, PITCH))
    assert lattice.centre(0.0, 0.0) == (0, 0)
    ring = lattice.neighbours(0.6 * PITCH)
    np.testing.assert_array_equal(ring[0], 0)
    x, y = lattice.centre(*ring[1:].T.astype(float))
    np.testing.assert_allclose(np.hypot(x, y), PITCH)
    np.testing.assert_allclose(np.sort(np.degrees(np.arctan2(y, x)) % 360), np.arange(0, 360, 60), atol=1e-9)
    # Stretched, it is the affine image.
    stretched = make_lattice("hexagonal", (PITCH, 2 * PITCH))
    np.testing.assert_allclose(stretched.centre(*ring[1:].T.astype(float)), (x, 2 * y))
    turned = make_lattice("hexagonal", (PITCH, PITCH), rotation=30, offset=(0.01, -0.02))
    np.testing.assert_allclose(turned.centre(0.0, 0.0), (0.01, -0.02))
    np.testing.assert_allclose(turned.centre(1.0, 0.0), (0.01 + PITCH * math.cos(math.pi / 6), -0.02 + PITCH / 2))


def test_neighbours_are_of_three_types():
    lattice = make_lattice("hexagonal", (PITCH, PITCH))
    for i, j in ((0, 0), (3, -7), (-11, 4)):
        types = [float(lattice.lens_type(float(i + di), float(j + dj))) for di, dj in lattice.neighbours(0.6 * PITCH)]
        assert types[0] == (i - j) % 3
        assert sorted(types[1:]) == sorted(3 * [k for k in (0, 1, 2) if k != types[0]])


@EACH_LATTICE
@EACH_PITCHES
@pytest.mark.parametrize("aperture", APERTURES)
def test_apertures_have_their_area_and_are_filled_evenly(name, pitches, aperture, fill=0.7):
    lattice = make_lattice(name, pitches, rotation=12, aperture=aperture, fill=fill)
    side = (np.arange(600) + 0.5) / 600
    # Fraction of a square of two and a half pitches that is aperture.
    width = 2.5 * PITCH
    x, y = np.meshgrid(width * (side - 0.5), width * (side - 0.5))
    inside = lattice.in_aperture(x, y)
    assert inside.mean() * width**2 == pytest.approx(lattice.lens_area, rel=3e-3)
    assert np.hypot(x, y)[inside].max() <= lattice.aperture_reach
    u, v = lattice.to_frame(x[inside], y[inside])
    if aperture == "circle" or name == "square":
        assert (2 * u.max(), 2 * v.max()) == pytest.approx(lattice.aperture_widths, rel=0.02)
    # An even map has the aperture's area in every part of it, and its moments.
    s, t = (axis.ravel() for axis in np.meshgrid(side, side))
    dx, dy = lattice.aperture_point(s, t)
    assert lattice.in_aperture(dx * (1 - 1e-9), dy * (1 - 1e-9)).all()
    # Where an aperture ends its cell does not.
    i, j = lattice.cell(*(np.array(lattice.centre(0.0, 0.0))[:, None] + [0.999 * dx, 0.999 * dy]))
    assert not (i.any() or j.any())
    bins = np.linspace(-width / 2, width / 2, 31)
    mapped = np.histogram2d(dx, dy, bins=bins)[0] / s.size
    expected = np.histogram2d(x[inside], y[inside], bins=bins)[0] / inside.sum()
    assert np.abs(mapped - expected).max() < 0.04 * expected.max()
    # The same in Dr.Jit.
    # Points of a grid have the mean of all, and nearly their mean square.
    grid = lattice.aperture_grid(32)
    assert np.allclose(grid.mean(1), 0, atol=1e-4 * PITCH)
    assert np.allclose((grid**2).mean(1), [np.mean(dx**2), np.mean(dy**2)], rtol=0.02)
    points = lattice.aperture_point(mi.Float(s), mi.Float(t))
    assert np.abs(np.array(points) - [dx, dy]).max() < 1e-6
    assert dr.mean(mi.Float(lattice.in_aperture(points[0] * 0.999, points[1] * 0.999)))[0] == 1


@EACH_LATTICE
@EACH_PITCHES
def test_neighbours_within_reach_of_a_cell(name, pitches, smear=0.4):
    lattice = make_lattice(name, pitches, rotation=-7, offset=(0.3, 0.1), fill=0.8)
    reach = 1.3 * PITCH
    s, t = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(0, 1, 200)]))
    # A cell and an aperture of its shape add to a larger one.
    points = np.array(lattice.cell_point(s, t, 1 + 0.8 * smear)) + np.array(lattice.centre(0.0, 0.0))[:, None]
    found = set(map(tuple, lattice.neighbours(reach, smear)))
    for i, j in itertools.product(range(-4, 5), repeat=2):
        x, y = lattice.centre(float(i), float(j))
        nearest = np.hypot(points[0] - x, points[1] - y).min()
        if abs(nearest - reach) > 0.02 * PITCH:
            assert ((i, j) in found) == (nearest < reach)


@EACH_LATTICE
@EACH_PITCHES
def test_lenses_within_a_rectangle(name, pitches):
    lattice = make_lattice(name, pitches, rotation=20, offset=(0.01, 0.02))
    found = lattice.lenses_within((-0.5, -0.2), (0.3, 0.4))
    assert len(found) == pytest.approx(0.8 * 0.6 / lattice.cell_area, rel=0.06)
    x, y = lattice.centre(*found.T.astype(float))
    assert ((x >= -0.5) & (x <= 0.3) & (y >= -0.2) & (y <= 0.4)).all()
    assert len(set(map(tuple, found))) == len(found)


class BrickLattice(Lattice):
    """Rectangles of which every second row is offset by half a pitch, as in a wall."""

    name = "brick"
    row_ratio = 1.0
    stagger = 2
    lens_types = 1
    rectangular = True
    unit_corners = regular_corners(4)

    @staticmethod
    def unit_cell(u, v):
        j = floor(v)
        return floor(u - j / 2), j

    @staticmethod
    def unit_centre(i, j):
        return i + j / 2 + 0.5, j + 0.5

    cell_width = staticmethod(LATTICES["square"].cell_width)
    point_in_cell = staticmethod(LATTICES["square"].point_in_cell)


def test_a_new_lattice_is_one_class(monkeypatch, camera_dict):
    monkeypatch.setitem(LATTICES, "brick", BrickLattice)
    sensor = camera_dict(mla_lattice="brick", mla_pitch="0.064, 0.058", resolution=128, detector_width=0.512)
    capture = render_capture(scene_of(sensor, sky={"type": "constant"}), spp=64)
    camera = capture.camera
    assert not camera.lattice.axis_aligned and camera.mla_pitches == (0.064, 0.058)
    assert design.white_mean(camera) == pytest.approx(math.pi * (5 * 0.512 / 120.512) ** 2 / (0.064 * 0.058))
    assert np.sqrt(np.mean((white_image(camera) - capture.image)[10:-10, 10:-10] ** 2)) < 0.05
    np.testing.assert_allclose(reconstruct(capture, 250, camera=camera).image[2:-2, 2:-2], 1, atol=0.02)
