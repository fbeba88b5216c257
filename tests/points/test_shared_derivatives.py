"""Derivatives of sums of many points, which share spreads: against those with a spread for each point."""

import numpy as np
import pytest
from cameras import HALF, LATTICES, WAVELENGTH, error, in_every_lens, small_camera

from mitsuba_plenoptic import CaptureOperator
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.points import accuracy
from mitsuba_plenoptic.points.derivatives import DIFFERENTIABLE, plan

MOVING = {"mla_pitch": (1.0, -0.5), "mla_distance": 1.0, "mla_rotation": 1.0, "detector_distance": 1.0}
"""Numbers by which copies change otherwise than their spreads."""


@pytest.fixture
def many(monkeypatch):
    """Let a few points count as many."""
    monkeypatch.setattr(accuracy, "_FEW", 8)


def operator_of(lattice):
    camera = small_camera(2, **(HALF | lattice))
    points = in_every_lens(camera, 4, 118.0)
    return CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=0.1), np.linspace(0.3, 1, len(points))


@pytest.mark.parametrize(
    "lattice", [{}, pytest.param(LATTICES["stretched"], marks=pytest.mark.slow)], ids=["square", "hexagonal, turned"]
)
def test_copies_change_as_points_of_their_own(many, monkeypatch, lattice):
    """Without what tells copies from their spreads the derivative by the pitch is off by more than itself."""
    operator, weights = operator_of(lattice)
    shared = operator.jacobian(weights, [{name: change} for name, change in MOVING.items()])
    assert len(
        plan.DerivativePlan(OpticalSystem(operator.camera, WAVELENGTH), operator.points, None, 0.1)._positions
    ) < len(weights)
    monkeypatch.setattr(plan, "derivatives_share", lambda accuracy, count: False)
    alone, _ = operator_of(lattice)
    own = alone.jacobian(weights, [{name: change} for name, change in MOVING.items()])
    for name, found, expected in zip(MOVING, shared, own, strict=True):
        assert error(found, expected) < 0.07, name


@pytest.mark.slow
def test_reverse_equals_forward(many):
    operator, weights = operator_of(LATTICES["turned"])
    rng = np.random.default_rng(3)
    gradient = rng.normal(size=operator.camera.shape).astype(np.float32)
    found = operator.gradient(weights, gradient)
    assert set(found) == set(DIFFERENTIABLE)
    change = {key: rng.choice([-1, 1]) * given / np.vdot(given, given) for key, given in found.items()}
    for some in ({key: change[key]} for key in (*MOVING, "wavelength", "wavefront")):
        (name,) = some
        forward = operator.derivative(weights, some).astype(np.float64)
        difference = abs(np.vdot(forward, gradient.astype(np.float64)) - np.vdot(change[name], found[name]))
        assert difference < 1e-4 * np.linalg.norm(forward) * np.linalg.norm(gradient), name
