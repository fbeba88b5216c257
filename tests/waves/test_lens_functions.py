"""The functions over a lens, and points that are drawn about lenses, against explicit sums."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.waves.phase_space import PhaseSpace, coefficients_of
from mitsuba_plenoptic.waves.ray_sampler import LensPoints

CAMERAS = {
    "hexagonal": PlenopticCamera(mla_lattice="hexagonal", mla_rotation=7.0),
    "discs": PlenopticCamera(mla_aperture="circle", mla_fill=0.5),
    "three focal lengths": PlenopticCamera(mla_lattice="hexagonal", mla_focal_length=(0.48, 0.512, 0.55)),
}


@pytest.mark.parametrize("name", ["discs", "three focal lengths"])
def test_functions_have_duals_and_the_symmetry_that_is_stated(name):
    plan = PhaseSpace(CAMERAS[name], 633.0)
    functions = plan.functions
    u, v, inside = plan.aperture_grid(200)
    polynomials = functions.values(u[inside], v[inside])
    products = (polynomials @ functions.duals).T @ (polynomials @ functions.functions) / inside.sum()
    assert products == pytest.approx(np.eye(functions.count), abs=0.02)
    assert 12 <= functions.count <= 15
    u, v = np.random.default_rng(0).uniform(-0.01, 0.01, (2, 50))
    own, across, up = (functions.values(s * u, t * v) @ functions.functions for s, t in ((1, 1), (-1, 1), (1, -1)))
    signs = 1 - 2 * np.array(functions.odd)
    assert across == pytest.approx(own * signs[:, 0], abs=1e-6)
    assert up == pytest.approx(own * signs[:, 1], abs=1e-6)


def test_symmetric_lenses_have_the_kernels_that_all_lags_give(monkeypatch):
    plan = PhaseSpace(CAMERAS["discs"], 550.0, degree=2)
    found = plan.kernels(0.002, 0.08)
    monkeypatch.setattr(PhaseSpace, "_symmetry", lambda *_: None)
    expected = plan.moved(plan.camera).kernels(0.002, 0.08)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6 * np.abs(expected).max())


def test_kernels_turn_with_the_lattice():
    """A hexagon whose corners are on x, where the samples of its lags end, has the kernels of one with them on y."""
    cameras = (CAMERAS["hexagonal"].replace(mla_rotation=angle) for angle in (0.0, 90.0))
    upright, turned = (PhaseSpace(camera, 633.0, degree=0) for camera in cameras)
    found = turned.kernels(0.004, 0.12)[0]
    assert found == pytest.approx(np.rot90(upright.kernels(0.004, 0.12)[0]), abs=1e-6 * found.max())


COUNT = 1 << 19


@pytest.fixture(scope="module", params=[{}, {"mla_aperture": "circle", "mla_fill": 0.5}], ids=["cells", "discs"])
def plan(request):
    return PhaseSpace(PlenopticCamera(**request.param), 633.0, degree=1, radial=8)


@pytest.fixture(scope="module")
def points(plan, mono):
    return LensPoints(plan)


@pytest.fixture(scope="module")
def mono():
    mi.set_variant("llvm_ad_mono")


def drawn(points, plan, radius, angle):
    """Return points by random numbers, their weights, the pupil's point and the chances."""
    rng = np.random.default_rng(1)
    random, chance = ([mi.Float(rng.random(COUNT).astype(np.float32)) for _ in range(n)] for n in (2, 4))
    pupil = [
        dr.full(mi.Float, plan.camera.pupil_radius * radius * part, COUNT) for part in (np.cos(angle), np.sin(angle))
    ]
    return *points.draw(pupil, chance, random), pupil, chance


@pytest.mark.parametrize(("radius", "angle"), [(0.6, 2.1), (0.99, 0.785)])
def test_drawn_points_carry_all_light_with_weights_near_the_least_variance(points, plan, radius, angle):
    point, weight, pupil, chance = drawn(points, plan, radius, angle)
    values = [np.asarray(value * weight) for value in coefficients_of([plan])[0](point, pupil, chance, mi.Bool(True))]
    # The known integrals, in the corners of windows, too.
    assert values[0].mean() == pytest.approx(1, abs=0.01)
    assert [value.mean() for value in values[1:]] == pytest.approx([0, 0], abs=0.02)
    # No density does better than the coefficient's own size.
    assert np.mean(values[0] ** 2) <= 1.5 * np.mean(np.abs(values[0])) ** 2


def test_weights_are_one_over_the_density(points, plan):
    (x, y), weight, _, _ = drawn(points, plan, 0.8, 0.4)
    x, y, area = np.asarray(x), np.asarray(y), np.asarray(weight) * float(plan.lattice.lens_area)
    half = 0.3 * plan.camera.mla_pitch
    for inside, wanted in (
        ((np.abs(x) < half) & (np.abs(y) < half), 4 * half * half),
        ((x > half) & (x < 3 * half) & (y < -half) & (y > -2 * half), 2 * half * half),
    ):
        assert np.mean(area * inside) == pytest.approx(wanted, rel=0.03)
