"""The functions over a lens against explicit sums, and against as many polynomials."""

import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.waves.lens_functions import LensFunctions
from mitsuba_plenoptic.waves.phase_space import PhaseSpace

CAMERAS = {
    "square": PlenopticCamera(),
    "hexagonal": PlenopticCamera(mla_lattice="hexagonal", mla_rotation=7.0),
    "discs": PlenopticCamera(mla_aperture="circle", mla_fill=0.5),
    "three focal lengths": PlenopticCamera(mla_lattice="hexagonal", mla_focal_length=(0.48, 0.512, 0.55)),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_integrals_with_the_duals_give_the_coefficients(name):
    plan = PhaseSpace(CAMERAS[name], 633.0)
    functions = plan.functions
    u, v, inside = plan.aperture_grid(200)
    polynomials = functions.values(u[inside], v[inside])
    products = (polynomials @ functions.duals).T @ (polynomials @ functions.functions) / inside.sum()
    assert products == pytest.approx(np.eye(functions.count), abs=0.02)
    assert 12 <= functions.count <= 15


@pytest.mark.parametrize("name", CAMERAS)
def test_functions_have_the_symmetry_that_is_stated(name):
    plan = PhaseSpace(CAMERAS[name], 633.0)
    u, v = np.random.default_rng(0).uniform(-0.01, 0.01, (2, 50))
    own, across, up = (
        plan.functions.values(s * u, t * v) @ plan.functions.functions for s, t in ((1, 1), (-1, 1), (1, -1))
    )
    signs = 1 - 2 * np.array(plan.functions.odd)
    assert across == pytest.approx(own * signs[:, 0], abs=1e-6)
    assert up == pytest.approx(own * signs[:, 1], abs=1e-6)


def test_images_of_edges_are_better_than_by_as_many_polynomials():
    # A square lens without neighbours: the density between m and p is a product of sinc functions, which are the wider
    # the closer m is to the border.
    count = 20
    along = (np.arange(count) + 0.5) / count - 0.5
    detector = np.arange(-8, 8.01, 0.25)
    lag = np.linspace(-1, 1, 401)
    open_ = np.abs(lag) < 1 - 2 * np.abs(along[:, None])
    line = (open_ @ np.cos(2 * np.pi * np.outer(lag, detector))) * (lag[1] - lag[0]) * 0.25
    v, u = (each.ravel() for each in np.meshgrid(along, along, indexing="ij"))
    exact = np.einsum("ap,bq->abpq", line, line).reshape(count * count, -1)
    polynomials = LensFunctions.polynomials(u, v, 8, 0.5)
    values = polynomials.values(u, v)
    best = polynomials.best(15, 0.0, (u, v), values.T @ exact / len(u))
    few = LensFunctions.polynomials(u, v, 4, 0.5)
    generator = np.random.default_rng(1)
    turns, places = generator.uniform(0, 2 * np.pi, 200), generator.uniform(-0.6, 0.6, 200)
    light = np.array([np.cos(t) * u + np.sin(t) * v > p for t, p in zip(turns, places, strict=True)]) / len(u)
    images = light @ exact
    errors = []
    for each in (best, few):
        of_each = each.values(u, v)
        kernels = (of_each @ each.duals).T @ exact / len(u)
        errors.append(np.linalg.norm(light @ (of_each @ each.functions) @ kernels - images) / np.linalg.norm(images))
    assert errors[0] < 0.6 * errors[1]
    # Even light has no error.
    even = np.full((1, len(u)), 1 / len(u))
    kernels = (values @ best.duals).T @ exact / len(u)
    assert even @ (values @ best.functions) @ kernels == pytest.approx(even @ exact, abs=1e-9)


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name != "discs")) for name in CAMERAS])
def test_symmetric_lenses_have_the_kernels_that_all_lags_give(name, monkeypatch):
    plan = PhaseSpace(CAMERAS[name], 550.0, degree=2)
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
