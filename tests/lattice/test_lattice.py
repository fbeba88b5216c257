"""Microlens lattices: cells, centres, apertures and neighbours."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.lattice import APERTURES, LATTICES, make_lattice

PITCH = 0.064

STRETCHES = pytest.mark.parametrize("aspect", [1.0, 0.9, 1.3])

ANY_LATTICE = st.builds(
    lambda name, pitch, aspect, **numbers: make_lattice(name, (pitch, aspect * pitch), **numbers),
    name=st.sampled_from(list(LATTICES)),
    pitch=st.floats(0.01, 1),
    aspect=st.sampled_from([1.0, 0.9, 1.3]),
    rotation=st.floats(-180, 180),
    offset=st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
    aperture=st.sampled_from(list(APERTURES)),
    fill=st.floats(0.1, 1),
)


@settings(max_examples=60, deadline=None)
@given(ANY_LATTICE, st.floats(-20, 20), st.floats(-20, 20))
def test_a_cell_is_what_is_nearest_to_its_centre(lattice, x, y):
    x, y = x * lattice.pitch, y * lattice.pitch
    i, j = lattice.cell(x, y)
    index = np.mgrid[-3:4, -3:4].reshape(2, -1).T + np.array([i, j])
    around = np.hypot(*(np.array(lattice.centre(*index.T)).T - [x, y]).T)
    here = np.hypot(*(np.array(lattice.centre(i, j)) - [x, y]))
    assert here <= around.min() + 1e-9
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
        assert math.hypot(*step) == pytest.approx(lattice.pitch)
    (ax, ay), (bx, by) = lattice.basis
    assert ax * by - ay * bx == pytest.approx(lattice.cell_area)


def test_the_default_has_a_corner_on_the_axis_and_is_the_same_along_each_axis():
    lattice = PlenopticCamera().lattice
    assert lattice.separable
    index = np.arange(-64.0, 64)
    np.testing.assert_array_equal(lattice.axis_centre(index, 0), (index + 0.5) * PITCH)
    np.testing.assert_array_equal(lattice.axis_cell((index + 0.5) * PITCH, 1), index)
    x, y = lattice.centre(index, index[:, None])
    # Separable in shape too.
    assert (x.shape, y.shape) == ((128,), (128, 1))
    assert lattice.cell(0.0639, -0.0001) == (0, -1)


def test_a_hexagonal_lattice_has_a_lens_on_the_axis_and_six_neighbours_at_one_pitch():
    lattice = Lattice("hexagonal", PITCH)
    assert lattice.centre(0.0, 0.0) == (0, 0)
    ring = lattice.neighbours(0.6 * PITCH)
    np.testing.assert_array_equal(ring[0], 0)
    x, y = lattice.centre(*ring[1:].T.astype(float))
    np.testing.assert_allclose(np.hypot(x, y), PITCH)
    np.testing.assert_allclose(np.sort(np.degrees(np.arctan2(y, x)) % 360), np.arange(0, 360, 60), atol=1e-9)


def test_rotation_is_from_x_towards_y_about_the_axis_and_the_offset_comes_after():
    lattice = Lattice("hexagonal", PITCH, rotation=30, offset=(0.01, -0.02))
    np.testing.assert_allclose(lattice.centre(0.0, 0.0), (0.01, -0.02))
    np.testing.assert_allclose(lattice.centre(1.0, 0.0), (0.01 + PITCH * math.cos(math.pi / 6), -0.02 + PITCH / 2))


def test_neighbours_are_of_three_kinds():
    lattice = Lattice("hexagonal", PITCH)
    for i, j in ((0, 0), (3, -7), (-11, 4)):
        kinds = [float(lattice.lens_type(float(i + di), float(j + dj))) for di, dj in lattice.neighbours(0.6 * PITCH)]
        assert kinds[0] == (i - j) % 3
        assert sorted(kinds[1:]) == sorted(3 * [k for k in (0, 1, 2) if k != kinds[0]])


@pytest.mark.parametrize("lattice", SHAPES, ids=lambda lattice: f"{lattice.kind}, {lattice.aperture}")
@pytest.mark.parametrize("fill", [1.0, 0.7])
def test_apertures_have_their_area_and_are_filled_evenly(lattice, fill):
    lattice = Lattice(lattice.kind, PITCH, lattice.rotation, (0.0, 0.0), lattice.aperture, fill)
    side = (np.arange(600) + 0.5) / 600
    # Share of a square of two pitches that is aperture.
    x, y = np.meshgrid(2 * PITCH * (side - 0.5), 2 * PITCH * (side - 0.5))
    inside = lattice.in_aperture(x, y)
    assert inside.mean() * (2 * PITCH) ** 2 == pytest.approx(lattice.lens_area, rel=2e-3)
    assert np.hypot(x, y)[inside].max() <= lattice.aperture_reach
    # An even map has the aperture's area in every part of it, and its moments.
    s, t = (axis.ravel() for axis in np.meshgrid(side, side))
    dx, dy = lattice.aperture_point(s, t)
    assert lattice.in_aperture(dx * (1 - 1e-9), dy * (1 - 1e-9)).all()
    bins = np.linspace(-PITCH, PITCH, 31)
    mapped = np.histogram2d(dx, dy, bins=bins)[0] / s.size
    expected = np.histogram2d(x[inside], y[inside], bins=bins)[0] / inside.sum()
    assert np.abs(mapped - expected).max() < 0.04 * expected.max()
    # The same in Dr.Jit.
    points = lattice.aperture_point(mi.Float(s), mi.Float(t))
    assert np.abs(np.array(points) - [dx, dy]).max() < 1e-6
    assert dr.mean(mi.Float(lattice.in_aperture(points[0] * 0.999, points[1] * 0.999)))[0] == 1


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_neighbours_within_reach_of_a_cell(kind):
    lattice = Lattice(kind, PITCH, rotation=-7, offset=(0.3, 0.1))
    reach = 1.3 * PITCH
    s, t = (axis.ravel() for axis in np.meshgrid(*[np.linspace(0, 1, 400)] * 2))
    points = np.array(lattice.cell_point(s, t)) + np.array(lattice.centre(0.0, 0.0))[:, None]
    found = set(map(tuple, lattice.neighbours(reach)))
    for i in range(-3, 4):
        for j in range(-3, 4):
            x, y = lattice.centre(float(i), float(j))
            nearest = np.hypot(points[0] - x, points[1] - y).min()
            if abs(nearest - reach) > 0.01 * PITCH:
                assert ((i, j) in found) == (nearest < reach)


def test_lenses_within_a_rectangle():
    lattice = Lattice("hexagonal", PITCH, rotation=20, offset=(0.01, 0.02))
    found = lattice.lenses_within((-0.5, -0.2), (0.3, 0.4))
    assert len(found) == pytest.approx(0.8 * 0.6 / lattice.cell_area, rel=0.05)
    x, y = lattice.centre(*found.T.astype(float))
    assert ((x >= -0.5) & (x <= 0.3) & (y >= -0.2) & (y <= 0.4)).all()
    assert len(set(map(tuple, found))) == len(found)
