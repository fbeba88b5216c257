"""Captures and reconstructions as functions of JAX's arrays: values, differences, transforms, sums not repeated."""

import importlib
import sys

import numpy as np
import pytest
from wave_cases import WAVELENGTH, scattered, small_camera

from mitsuba_plenoptic import CaptureOperator, InputError, StoredOperator
from mitsuba_plenoptic.reconstruction import CoherentRefocus, DeconvolvedRefocus, RayRefocus

jax = pytest.importorskip("jax")
bridge = importlib.import_module("mitsuba_plenoptic.jax")

CAMERA = small_camera(2)
POINTS = scattered(3, image=0.05)


def stored(camera=CAMERA):
    return StoredOperator(camera, POINTS, wavelength=WAVELENGTH, dtype="float64")


def random(*shape, low=-1.0):
    return np.random.default_rng(len(shape)).uniform(low, 1, shape)


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


def directional(function, given, change, step):
    """Return the derivative of a scalar from the reverse pass, and from central differences."""
    reverse = (jax.grad(function)(given) * change).sum()
    difference = (function(given + step * change) - function(given - step * change)) / (2 * step)
    return float(reverse), float(difference)


def test_values_and_gradients_of_points():
    operator, weights, images = stored(), random(2, 3), random(*CAMERA.shape)
    made = bridge.forward(operator, weights)
    assert made.dtype == np.float64
    np.testing.assert_allclose(made[1], operator.forward(weights[1]))
    np.testing.assert_allclose(bridge.adjoint(operator, images), operator.adjoint(images))
    cubes = lambda w: (bridge.forward(operator, w) ** 3).sum()  # noqa: E731
    reverse, difference = directional(cubes, weights, random(2, 3), 1e-4)
    assert reverse == pytest.approx(difference, rel=1e-6)
    # The derivative of a gradient is one more product in each direction.
    squares = lambda w: (jax.grad(cubes)(w) ** 2).sum()  # noqa: E731
    reverse, difference = directional(squares, weights, random(2, 3), 1e-4)
    assert reverse == pytest.approx(difference, rel=1e-6)


def test_compiled_and_mapped():
    operator, weights = stored(), random(4, 3)
    squares = lambda w: (bridge.forward(operator, w) ** 2).sum()  # noqa: E731
    expected = 2 * operator.adjoint(np.moveaxis(operator.forward(weights.T), -1, -1)).T
    np.testing.assert_allclose(jax.jit(jax.grad(squares))(weights), expected)
    np.testing.assert_allclose(jax.vmap(jax.grad(squares))(weights), expected)


def test_cameras():
    felt, made = random(*CAMERA.shape).cumsum(0).cumsum(1), []

    def make(camera):
        made.append(CaptureOperator(camera, POINTS, wavelength=WAVELENGTH, accuracy=0))
        return made[-1]

    def figure(distance, weights):
        return (bridge.capture(make, CAMERA, {"mla_distance": distance}, weights) * felt).sum()

    start, weights = np.array(CAMERA.mla_distance), np.array([1.0, 0.5, 2.0])
    value, (by_distance, by_weights) = jax.value_and_grad(figure, (0, 1))(start, weights)
    assert len(made) == 2  # one for the shape, none for the reverse pass
    difference = (figure(start + 0.02, weights) - figure(start - 0.02, weights)) / 0.04
    assert float(by_distance) == pytest.approx(float(difference), rel=2e-3)
    assert float((by_weights * weights).sum()) == pytest.approx(float(value), rel=1e-5)


OPTIONS = {RayRefocus: {}, CoherentRefocus: {"wavelength": WAVELENGTH}, DeconvolvedRefocus: {"iterations": 3}}


@pytest.mark.parametrize("kind", OPTIONS)
def test_refocusing(kind, monkeypatch):
    by = kind(CAMERA, 225.0, **OPTIONS[kind])
    captures, calls = np.moveaxis(stored().forward(random(3, 2, low=0.5)), -1, 0) + 1e-4, []
    if kind is not RayRefocus:
        at = by.at
        monkeypatch.setattr(by, "at", lambda capture: calls.append(1) or at(capture))
    figure = lambda c: (bridge.refocus(by, c) ** 2).sum()  # noqa: E731
    expected = by.forward(np.moveaxis(captures, 0, -1))
    np.testing.assert_allclose(bridge.refocus(by, captures)[1], expected[..., 1], rtol=1e-6)
    calls.clear()
    jax.grad(figure)(captures)
    assert len(calls) == (kind is not RayRefocus)
    reverse, difference = directional(figure, captures, random(2, *CAMERA.shape, low=0) * captures, 1e-2)
    assert reverse == pytest.approx(difference, rel=1e-3)


def test_mistakes():
    with pytest.raises(Exception, match=r"weights of shape \(2, 4\): it must not be empty, and its last axes"):
        bridge.forward(stored(), random(2, 4))
    with pytest.raises(InputError, match=r"^parameters: wavelength: it is not one of"):
        bridge.capture(stored, CAMERA, {"wavelength": 633.0}, random(3))


def test_jax_that_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "jax", None)
    monkeypatch.delitem(sys.modules, "mitsuba_plenoptic.jax")
    with pytest.raises(InputError, match=r"^mitsuba_plenoptic\.jax needs the package jax: pip install"):
        importlib.import_module("mitsuba_plenoptic.jax")
