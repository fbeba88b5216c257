"""Captures and reconstructions as functions of JAX's arrays: values, differences, transforms, sums not repeated."""

import gc
import importlib
import weakref
from functools import partial

import mitsuba as mi
import numpy as np
import pytest
from cameras import WAVELENGTH, letters, scattered, small_camera

from mitsuba_plenoptic import CaptureOperator, InputError, StoredOperator, load_scene
from mitsuba_plenoptic.refocus import CoherentRefocus, RayRefocus

jax = pytest.importorskip("jax")
bridge = importlib.import_module("mitsuba_plenoptic.jax")

CAMERA = small_camera(2)
POINTS = scattered(3, image=0.05)


def computing(camera):
    return CaptureOperator(camera, POINTS, wavelength=WAVELENGTH, accuracy=0)


def stored(camera=CAMERA):
    return StoredOperator(camera, POINTS, wavelength=WAVELENGTH, dtype="float64")


def random(*shape, low=-1.0):
    return np.random.default_rng(len(shape)).uniform(low, 1, shape)


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


def require_derivatives(function, given, change, step, limit):
    """Compare a random product of a change by forward mode with those by reverse mode and by central differences."""
    _, made = jax.jvp(function, given, change)
    felt = np.random.default_rng(9).normal(size=made.shape).cumsum(-1).cumsum(-2).astype(made.dtype)
    ahead, back = (function(*(a + sign * step * c for a, c in zip(given, change, strict=True))) for sign in (1, -1))
    assert float((made * felt).sum()) == pytest.approx(float(((ahead - back) * felt).sum() / (2 * step)), rel=limit)
    gradients = jax.vjp(function, *given)[1](felt)
    reverse = sum((gradient * part).sum() for gradient, part in zip(gradients, change, strict=True))
    assert float(reverse) == pytest.approx(float((made * felt).sum()), rel=1e-4)


def test_values_and_gradients_of_points():
    operator, weights, images = stored(), random(2, 3), random(*CAMERA.shape)
    made = bridge.forward(operator, weights)
    assert made.dtype == np.float64
    np.testing.assert_allclose(made[1], operator.forward(weights[1]))
    np.testing.assert_allclose(bridge.adjoint(operator, images), operator.adjoint(images))
    cubes = lambda w: bridge.forward(operator, w) ** 3  # noqa: E731
    require_derivatives(cubes, (weights,), (random(2, 3)[::-1],), 1e-4, 1e-6)
    # The derivative of a gradient is one more product in each direction.
    require_derivatives(jax.grad(lambda w: cubes(w).sum()), (weights,), (random(2, 3),), 1e-4, 1e-6)


def test_compiled_and_mapped():
    operator, weights = stored(), random(4, 3)
    squares = lambda w: (bridge.forward(operator, w) ** 2).sum()  # noqa: E731
    expected = 2 * operator.adjoint(np.moveaxis(operator.forward(weights.T), -1, -1)).T
    np.testing.assert_allclose(jax.jit(jax.grad(squares))(weights), expected)
    np.testing.assert_allclose(jax.vmap(jax.grad(squares))(weights), expected)


def test_cameras():
    made = []

    def make(camera):
        made.append(computing(camera))
        return made[-1]

    def captured(distance, weights):
        return bridge.capture(make, CAMERA, {"mla_distance": distance}, weights)

    start, weights = np.array(CAMERA.mla_distance), np.array([1.0, 0.5, 2.0])
    jax.grad(lambda *given: captured(*given).sum(), (0, 1))(start, weights)
    assert len(made) == 2  # one for the shape, none for the reverse pass
    require_derivatives(captured, (start, weights), (np.array(1.0), 0.3 * weights), 0.01, 1e-3)
    # What does not change takes no derivative.
    only = jax.jvp(lambda d: captured(d, weights), (start,), (np.array(1.0),))[1]
    np.testing.assert_allclose(only, jax.jvp(captured, (start, weights), (np.array(1.0), 0 * weights))[1])


OPTIONS = {RayRefocus: {}, CoherentRefocus: {"wavelength": WAVELENGTH}}


@pytest.mark.parametrize("kind", OPTIONS)
def test_refocusing(kind, monkeypatch):
    by = kind(CAMERA, 225.0, **OPTIONS[kind])
    captures, calls = np.moveaxis(stored().forward(random(3, 2, low=0.5)), -1, 0) + 1e-4, []
    if kind is not RayRefocus:
        at = by.at
        monkeypatch.setattr(by, "at", lambda capture: calls.append(1) or at(capture))
    expected = by.forward(np.moveaxis(captures, 0, -1))
    np.testing.assert_allclose(bridge.refocus(by, captures)[1], expected[..., 1], rtol=1e-6)
    calls.clear()
    jax.grad(lambda c: bridge.refocus(by, c).sum())(captures)
    assert len(calls) == (kind is not RayRefocus)
    change = random(2, *CAMERA.shape, low=0) * captures
    require_derivatives(lambda c: bridge.refocus(by, c), (captures,), (change,), 1e-3, 1e-3)
    # Captures one by one are those of a batch.
    mapped = jax.vmap(lambda c, d: jax.jvp(lambda x: bridge.refocus(by, x), (c,), (d,))[1])(captures, change)
    np.testing.assert_allclose(mapped, jax.jvp(lambda c: bridge.refocus(by, c), (captures,), (change,))[1], rtol=1e-5)


def test_gradients_that_are_not_needed_are_not_computed(monkeypatch):
    operator = computing(CAMERA)
    monkeypatch.setattr(operator, "adjoint", lambda image: pytest.fail("the gradient by the weights was computed"))
    figure = lambda d: (bridge.capture(lambda _: operator, CAMERA, {"mla_distance": d}, np.ones(3)) ** 2).sum()  # noqa: E731
    assert np.isfinite(jax.grad(figure)(np.array(CAMERA.mla_distance)))


def test_compiled_and_mapped_derivatives_of_cameras():
    weights, distances = np.array([1.0, 0.5, 2.0]), CAMERA.mla_distance + np.array([0.0, 0.1])
    figure = lambda d: (bridge.capture(computing, CAMERA, {"mla_distance": d}, weights) ** 2).sum()  # noqa: E731
    expected = [jax.grad(figure)(each) for each in distances]
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.grad(figure)))(distances), expected, rtol=1e-5)
    with pytest.raises(InputError, match=r"^derivatives of derivatives: "):
        jax.grad(jax.grad(figure))(distances[0])


def test_captures_of_scenes():
    scene, integrator = load_scene("letters", parameters=letters(1)), mi.load_dict({"type": "plenoptic_wave"})
    names = [f"{one}.emitter.radiance.value" for one in ("f", "hash")]
    start = [np.array(mi.traverse(scene)[name], np.float64) for name in names]

    def image(*values, seed=0):
        return bridge.render(scene, dict(zip(names, values, strict=True)), integrator=integrator, spp=8, seed=seed)

    made, forward = jax.jvp(image, start, [np.ones(1), 0.5 * np.ones(1)])
    assert made.shape == (32, 32, 1) and made.dtype == np.float64
    # Derivatives draw from another seed, which Mitsuba derives from the first.
    other = int(mi.sample_tea_32(0, 1)[0])
    ahead, back = (image(start[0] + step, start[1] + step / 2, seed=other) for step in (0.1, -0.1))
    felt = random(32, 32, 1, low=0)
    assert float((forward * felt).sum()) == pytest.approx(float(((ahead - back) * felt).sum()) / 0.2, rel=1e-3)
    first, second = jax.grad(lambda *values: (image(*values) * felt).sum(), (0, 1))(*start)
    (again,) = jax.jit(jax.grad(lambda value: (image(value, start[1]) * felt).sum(), (0,)))(start[0])
    np.testing.assert_allclose(again, first, rtol=1e-5)
    assert float(first[0] + 0.5 * second[0]) == pytest.approx(float((forward * felt).sum()), rel=1e-4)


def test_steps_of_a_loop_keep_nothing():
    """Each step makes new functions, whose values and operators must be gone some steps later."""
    operators = []

    def make(camera):
        made = computing(camera)
        operators.append(weakref.ref(made))
        return made

    def figure(distance):
        return (bridge.capture(make, CAMERA, {"mla_distance": distance}, np.ones(3)) ** 2).sum()

    gradient = jax.grad(figure)
    for step in range(bridge._VALUES + 2):
        gradient(np.array(CAMERA.mla_distance + 1e-4 * step))
    gc.collect()
    assert sum(each() is not None for each in operators) <= bridge._VALUES


def test_types():
    operator = stored()
    half = bridge.forward(operator, np.ones(3, np.float16))
    assert half.dtype == np.float16
    np.testing.assert_allclose(half, operator.forward(np.ones(3)), rtol=1e-3, atol=1e-6)
    with pytest.raises(InputError, match=r"^weights: its type is int64"):
        bridge.forward(operator, [1, 2, 3])


@pytest.mark.parametrize("compiled", [lambda function: function, jax.jit], ids=["called", "compiled"])
def test_wrong_shapes_are_refused_before_anything_runs_on_the_host(compiled):
    """In one line: what is raised on the host comes back within an error of JAX."""
    for words, function, given in (
        (r"^weights of shape \(2, 4\): ", partial(bridge.forward, stored()), random(2, 4)),
        (r"^images of shape \(64, 63\): ", partial(bridge.adjoint, stored()), random(64, 63)),
        (r"^weights of shape \(0, 3\): ", partial(bridge.capture, stored, CAMERA, {}), random(0, 3)),
        ("^parameters: wavelength: ", partial(bridge.capture, stored, CAMERA, {"wavelength": 633.0}), random(3)),
        # Colours are axes before the rows.
        (r"^captures of shape \(64, 64, 3\)", partial(bridge.refocus, RayRefocus(CAMERA, 225.0)), random(64, 64, 3)),
    ):
        with pytest.raises(InputError, match=words):
            compiled(function)(given)
