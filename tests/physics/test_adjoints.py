"""<Ax, y> = <x, A'y> for sums of point spreads and for their derivatives, for every kind of camera."""

import numpy as np
import pytest
from cameras import CAMERAS, WAVELENGTH, scattered, seen_by

from mitsuba_plenoptic import CaptureOperator, Spectrum
from mitsuba_plenoptic.points.derivatives import DIFFERENTIABLE

RANDOM = np.random.default_rng(4)


def dot(x, y):
    return np.vdot(np.asarray(x, np.float64), np.asarray(y, np.float64))


def require_adjoint(operator):
    """Check to 1e-5 of |x| |A'y|, for three channels of mixed signs."""
    x = RANDOM.normal(size=(len(operator.points), 3))
    y = RANDOM.normal(size=(*operator.camera.shape, 3)).astype(np.float32)
    forward, adjoint = operator.forward(x), operator.adjoint(y)
    assert forward.shape == y.shape and adjoint.shape == x.shape
    assert abs(dot(forward, y) - dot(x, adjoint)) < 1e-5 * np.linalg.norm(x) * np.linalg.norm(adjoint)


@pytest.mark.parametrize(("accuracy", "cells"), [(0, None), (0.01, 4)], ids=["whole pupils", "weighted pupils"])
def test_points_that_share_spreads(accuracy, cells):
    points = scattered(6, distances=(112.0, 128.0), image=0.05)
    points[-1] = points[0] + (1e-4, 0, 0)
    weights = None if cells is None else RANDOM.uniform(0, 1, (6, cells, cells))
    options = {"wavelength": WAVELENGTH, "accuracy": accuracy, "pupil_weights": weights}
    require_adjoint(CaptureOperator(CAMERAS["turned"], points, **options))


def test_derivatives():
    """<A' t, y> = <t, A'* y> to 1e-4 of |A' t| |y|, with every number changed so that it counts as much as another."""
    operator = CaptureOperator(
        CAMERAS["square"].replace(crop_offset=(40, 35), crop_size=(50, 51)),
        seen_by("square"),
        spectrum=Spectrum.lines(633),
        accuracy=0.02,
        pupil_weights=RANDOM.uniform(0.2, 1, (2, 3, 3)),
    )
    weights = RANDOM.normal(size=(2, 1))
    gradient = RANDOM.normal(size=(*operator.camera.shape, 1)).astype(np.float32)
    found = operator.gradient(weights, gradient)
    assert set(found) == set(DIFFERENTIABLE)
    assert len(found["wavefront"]) == 36 and len(found["mla_pitch"]) == 2
    change = {key: RANDOM.choice([-1, 1]) * given / np.vdot(given, given) for key, given in found.items()}
    forward = operator.derivative(weights, change)
    back = sum(np.vdot(change[key], given) for key, given in found.items())
    assert abs(dot(forward, gradient) - back) < 1e-4 * np.linalg.norm(forward) * np.linalg.norm(gradient)
