"""The operator that stores its spreads: the same numbers as the one that computes them, and a matrix of them."""

import numpy as np
import pytest
from cameras import HALF, WAVELENGTH, error, in_every_lens, scattered, small_camera
from scipy.sparse.linalg import lsqr, svds

from mitsuba_plenoptic import CaptureOperator, PhysicsError, Spectrum, StoredOperator
from mitsuba_plenoptic.points.patch_plan import PatchPlan

SMALL = small_camera(4)
RED_AND_GREEN = Spectrum((633.0, 532.0), ((1.0, 0.1), (0.0, 1.0), (0.8, 0.2)))


def both(camera, points, **options):
    return CaptureOperator(camera, points, **options), StoredOperator(camera, points, **options)


def require_equal(computed, stored, columns=None):
    """Compare products with random weights and images, within the rounding of single precision."""
    rng, count = np.random.default_rng(0), len(computed.points)
    weights = rng.normal(size=count if columns is None else (count, columns))
    image = computed.forward(weights)
    assert np.ptp(image) > 0
    made = stored.forward(weights)
    assert made.shape == image.shape
    assert made.dtype == np.float32
    assert error(made, image) < 5e-6
    given = rng.normal(size=image.shape)
    products = stored.adjoint(given)
    assert error(products, computed.adjoint(given)) < 2e-5
    # <A w, y> = <w, A' y>
    scale = np.linalg.norm(image) * np.linalg.norm(given)
    assert abs(np.vdot(made, given) - np.vdot(weights, products)) < 1e-5 * scale


BAND = Spectrum(tuple(np.linspace(520, 560, 5).tolist()), (tuple(np.hanning(7)[1:-1].tolist()),), nodes=(525.0, 555.0))
ALIKE = np.concatenate([in_every_lens(SMALL, 3, 240.0, per_lens=3), scattered(2)])
NEAR = [(0.02, -0.03, 120.0), (0.01, 0.04, 112.5)]
CELLS = [np.indices((8, 8)).sum(0) < 6, np.ones((8, 8))]


@pytest.mark.parametrize(
    ("camera", "points", "options", "columns"),
    [
        (SMALL, ALIKE, {"accuracy": 0.1}, 5),
        (SMALL, scattered(2), {"accuracy": 0, "pupil_weights": CELLS}, None),
        (small_camera(2, **HALF), NEAR, {"method": "full_field"}, None),
        (SMALL, scattered(2), {"accuracy": 0, "wavelength": None, "spectrum": BAND}, 5),
    ],
    ids=["shared spreads", "pupil weights", "full fields", "nodes"],
)
def test_products_are_those_of_spreads_that_are_computed(camera, points, options, columns):
    require_equal(*both(camera, points, **{"wavelength": WAVELENGTH} | options), columns)


def test_points_beyond_the_window_have_empty_columns():
    points = np.array([(1.9, 1.9, 240.0), (-1.9, -1.9, 240.0)])
    computed, stored = both(small_camera(32, crop_offset=(0, 0), crop_size=(20, 20)), points, wavelength=WAVELENGTH)
    filled = np.diff(stored.to_sparse().indptr) > 0
    assert sorted(filled) == [False, True]
    assert [computed.forward(one).any() for one in np.eye(2)] == filled.tolist()


def test_wavelengths_are_stored_once_and_mixed_into_channels(monkeypatch):
    planned, plan = [], PatchPlan.__init__

    def counted(self, system, *arguments, **options):
        planned.append(system.wavelength)
        plan(self, system, *arguments, **options)

    computed, stored = both(SMALL, scattered(3), spectrum=RED_AND_GREEN, accuracy=0)
    computed.forward(np.ones(3))
    monkeypatch.setattr(PatchPlan, "__init__", counted)
    require_equal(computed, stored, columns=2)
    assert planned == [633.0, 532.0]
    weights = np.random.default_rng(1).normal(size=(3, 2))
    matrix = stored.to_sparse()
    assert matrix.shape == (SMALL.shape[0] * SMALL.shape[1] * 3, 6)
    assert error(matrix @ weights.ravel(), stored.forward(weights).ravel()) < 1e-6


def test_matrix_is_the_operator_and_scipy_solves_it_to_double_precision():
    stored = StoredOperator(SMALL, scattered(4), wavelength=WAVELENGTH, dtype="float64")
    weights = np.array([1.0, -0.5, 2.0, 0.25])
    image = stored.forward(weights)
    assert image.dtype == np.float64
    dense = stored.to_dense()
    assert error(dense @ weights, image.ravel()) < 1e-14
    assert error(stored.to_sparse() @ weights, image.ravel()) < 1e-14
    assert error(stored.adjoint(image), dense.T @ image.ravel()) < 1e-14
    stored.to_sparse().data[:] = 0
    assert error(stored.forward(weights), image) == 0
    assert error(lsqr(stored, image.ravel(), atol=1e-13, btol=1e-13)[0], weights) < 1e-10
    (largest,) = svds(stored, k=1, return_singular_vectors=False, tol=1e-13)
    assert largest == pytest.approx(np.linalg.norm(dense, 2), rel=1e-12)


@pytest.mark.parametrize("kind", [CaptureOperator, StoredOperator])
def test_scipy_multiplies_several_columns_at_once(kind, monkeypatch):
    calls, operator = [], kind(SMALL, scattered(2), wavelength=WAVELENGTH)
    for name in ("forward", "adjoint"):
        function = getattr(operator, name)
        monkeypatch.setattr(operator, name, lambda array, f=function: calls.append(np.shape(array)) or f(array))
    rng = np.random.default_rng(0)
    weights, pixels = rng.normal(size=(2, 3)), rng.normal(size=(operator.shape[0], 2))
    made, back = operator @ weights, operator.T @ pixels
    assert calls == [(2, 3), (*SMALL.shape, 2)]
    assert error(made, np.stack([operator @ one for one in weights.T], -1)) < 1e-6
    assert error(back, np.stack([operator.T @ one for one in pixels.T], -1)) < 1e-6
    one = kind(SMALL, scattered(2), spectrum=Spectrum((WAVELENGTH,), ((2.0,),)))
    assert error(one @ weights, 2 * made) < 1e-6


def test_light_that_is_lost_is_refused(monkeypatch):
    stored = StoredOperator(SMALL, scattered(2), wavelength=WAVELENGTH, accuracy=0)
    monkeypatch.setattr(PatchPlan, "_sent", lambda *_: 1e12)
    with pytest.raises(PhysicsError):
        stored.forward([1, 1])
