"""Points through every kind of camera: patches are full fields, sums have adjoints, derivatives are differences."""

import numpy as np
import pytest
from cameras import CAMERAS, WAVELENGTH, error, scattered, seen_by

from mitsuba_plenoptic import CaptureOperator, Spectrum
from mitsuba_plenoptic.camera import shortest_parts
from mitsuba_plenoptic.points.derivatives import DIFFERENTIABLE
from tools.bench.cases.derivatives import STEP, difference

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


QUICK = ("sphere", "vignetted", "coded", "microscope")
LIMITS = {"warped": 0.015, "unequal lenses": 0.015}


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n not in QUICK)) for n in CAMERAS])
def test_patches_are_full_fields(name):
    weights = np.array([1.0, 2.0])
    patch, full = (
        CaptureOperator(CAMERAS[name], seen_by(name), wavelength=WAVELENGTH, accuracy=accuracy, method=method).forward(
            weights
        )
        for method, accuracy in (("patch", 0), ("full_field", None))
    )
    assert patch.shape == full.shape == CAMERAS[name].shape
    assert patch.dtype == np.float32 and patch.min() >= 0
    assert error(patch, full) < LIMITS.get(name, 0.005)


SLOPES = {
    "aperture_radius": 0.015,
    # Differences of full fields round the edges of hexagonal lenses: 0.03, and 0.006 for circles and squares.
    "mla_fill": 0.035,
}
FAST = [("turned", "mla_pitch")]
SLOW = [
    ("square", "aperture_radius"), ("cropped", "detector_width"), ("square", "focal_length"), ("square", "wavefront"),
    ("gaps", "detector_distance"), ("medium", "mla_distance"),
    ("circles", "mla_fill"), ("stretched", "mla_rotation"), ("three focal lengths", "mla_focal_length"),
    ("three focal lengths", "mla_offset"), ("medium", "detector_distance"), ("real", "focal_length"),
    ("real", "aperture_radius"),
]  # fmt: skip


def small(name):
    """Return a camera with half as many lenses across."""
    camera = CAMERAS[name]
    if name in ("cropped", "microscope"):
        return camera
    halved = tuple(count // 2 for count in camera.resolution)
    return camera.replace(detector_width=camera.detector_width / 2, resolution=halved)


@pytest.mark.parametrize(("camera", "name"), [*FAST, *(pytest.param(*pair, marks=pytest.mark.slow) for pair in SLOW)])
def test_points(camera, name):
    """Differences of the operator's own images miss by up to 14 %, as its grids of samples follow the camera.

    They jump with sizes of transforms, and light that they fold back changes as fast as the pitch and the rotation.
    Derivatives keep the grids, and have twice as many samples; differences of the full field hold its grids, too.
    """
    start, (point, _) = small(camera), seen_by(camera)
    if name == "mla_fill":
        # Lenses that touch can not grow.
        start = start.replace(mla_fill=min(start.mla_fill, 0.95))
    last = np.eye(15 if name == "wavefront" else len(shortest_parts(start, name)))[-1]
    operator = CaptureOperator(start, [point], wavelength=WAVELENGTH, accuracy=0)
    change = operator.derivative([1.0], {name: last})
    step = STEP * np.linalg.norm(operator.forward([1.0])) / np.linalg.norm(change)
    expected = difference(start, point, name, last, step, finer=1.0, window=1.5)
    assert error(change, expected) < SLOPES.get(name, 0.008)
