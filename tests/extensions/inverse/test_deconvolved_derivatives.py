"""Steps of deconvolution as a differentiable function: values, adjoint, differences, sums that are not repeated."""

import numpy as np
import pytest
from cameras import WAVELENGTH, error, small_camera

from mitsuba_plenoptic import CaptureOperator, InputError, reconstruct
from mitsuba_plenoptic.refocus import DeconvolvedRefocus

CAMERA = small_camera(3)
WAYS = {"ray model": None, "wave model": WAVELENGTH}


@pytest.fixture(scope="module")
def capture():
    points = [(0.05, 0.02, 250.0), (-0.06, 0.0, 250.0)]
    image = CaptureOperator(CAMERA, points, wavelength=WAVELENGTH, accuracy=0).forward([1.0, 0.5])
    return image / image.max() + 0.02


@pytest.mark.parametrize("model", [pytest.param("ray model", marks=pytest.mark.slow), "wave model"])
def test_values_transpose_and_differences(model, capture):
    """The image is that of `reconstruct`, <J x, y> = <x, J' y> to 1e-5, and J x is what differences give."""
    wavelength, rng = WAYS[model], np.random.default_rng(1)
    refocus = DeconvolvedRefocus(CAMERA, 250.0, wavelength, iterations=6, oversample=2)
    expected = reconstruct(
        capture, 250.0, camera=CAMERA, wavelength=wavelength, method="deconvolved", iterations=6, accelerate=False,
        oversample=2,
    ).image  # fmt: skip
    at = refocus.at(capture)
    assert at.image.shape == refocus.shape
    assert error(at.image, np.nan_to_num(expected)) < 1e-6
    change, y = capture * rng.uniform(-1, 1, capture.shape), rng.normal(size=at.image.shape)
    moved, back = at.jvp(change).astype(np.float64), at.vjp(y).astype(np.float64)
    size = np.linalg.norm(moved) * np.linalg.norm(y)
    assert abs(np.vdot(moved, y) - np.vdot(change, back)) / size < 1e-5
    sides = [refocus.forward(capture + side * change).astype(np.float64) for side in (0.003, -0.003)]
    assert error(moved, (sides[0] - sides[1]) / 0.006) < 1e-3


def test_channels_are_solved_one_by_one(capture):
    refocus = DeconvolvedRefocus(CAMERA, 250.0, iterations=2)
    both = np.stack([capture, capture[::-1]], axis=-1)
    at, felt = refocus.at(both), np.random.default_rng(2).normal(size=(*refocus.shape, 2))
    np.testing.assert_array_equal(at.image[..., 1], refocus.forward(capture[::-1]))
    np.testing.assert_array_equal(at.vjp(felt)[..., 1], refocus.at(capture[::-1]).vjp(felt[..., 1]))


def test_the_reverse_pass_repeats_no_sum(capture, monkeypatch):
    refocus, calls = DeconvolvedRefocus(CAMERA, 250.0, iterations=4), []
    for name in ("forward", "adjoint"):
        function = getattr(refocus.response, name)
        monkeypatch.setattr(refocus.response, name, lambda x, f=function, n=name: calls.append(n) or f(x))
    at = refocus.at(capture)
    assert [calls.count(name) for name in ("forward", "adjoint")] == [5, 5]  # and the light of pixels and bins
    calls.clear()
    at.vjp(np.ones(refocus.shape))
    assert [calls.count(name) for name in ("forward", "adjoint")] == [4, 4]


def test_mistakes(capture, monkeypatch):
    refocus = DeconvolvedRefocus(CAMERA, 250.0, iterations=4)
    with pytest.raises(InputError, match=r"^capture: none of its pixels is lit"):
        refocus.forward(np.zeros(CAMERA.shape))
    with pytest.raises(InputError, match=r"^capture of shape \(3, 3\): it must have 96 rows and 96 columns$"):
        refocus.forward(np.zeros((3, 3)))
    with pytest.raises(InputError, match=r"^iterations = 0: "):
        DeconvolvedRefocus(CAMERA, 250.0, iterations=0)
    monkeypatch.setattr("mitsuba_plenoptic.runtime.limits.MEMORY_LIMIT", 1e5)
    with pytest.raises(InputError, match=r"^derivatives of 4 steps in 1 channels[^\n]*$"):
        refocus.forward(capture)
