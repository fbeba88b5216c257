"""Refocusing as a differentiable function: dark and negative pixels, channels, integrals, and Dr.Jit."""

import drjit as dr
import mitsuba as mi
import numpy as np
from cameras import WAVELENGTH, error, small_camera

from mitsuba_plenoptic import reconstruct
from mitsuba_plenoptic.refocus import CoherentRefocus, DeconvolvedRefocus, RayRefocus
from mitsuba_plenoptic.refocus.bins import Integrals


def lit(camera):
    """Return a capture that a camera may have made: smooth micro-images of a pupil, with some noise."""
    rng = np.random.default_rng(0)
    x, y = (camera.pixel_coordinates(axis) for axis in (0, 1))
    chief = camera.mla_distance / (camera.mla_distance + camera.detector_distance)
    cx, cy = camera.lattice.centre(*camera.lattice.cell(*np.meshgrid(x * chief, y * chief)))
    pupil = np.hypot(x - cx / chief, (y[:, None] - cy / chief)) / (camera.micro_image_diameter / 2)
    return (rng.uniform(0.5, 1.5, camera.shape) / (1 + np.exp(20 * (pupil - 0.8)))).astype(np.float32)


def test_pixels_below_zero_and_dark_ones():
    """The magnitude of a negative pixel is subtracted, so its derivative is that of its magnitude; of a dark one 0."""
    camera = small_camera(3)
    refocus, x, rng = CoherentRefocus(camera, 225.0, WAVELENGTH), lit(camera), np.random.default_rng(1)
    x[::7] *= -0.3
    x[::5] = 0
    expected = reconstruct(x, 225.0, camera=camera, wavelength=WAVELENGTH, method="coherent").image
    at, change, y = refocus.at(x), x * rng.uniform(-1, 1, x.shape), rng.normal(size=expected.shape)
    assert error(at.image, np.nan_to_num(expected)) < 1e-5
    moved = at.jvp(change).astype(np.float64)
    assert abs(np.vdot(moved, y) - np.vdot(change, at.vjp(y))) < 1e-5 * np.linalg.norm(moved) * np.linalg.norm(y)
    sides = [refocus.forward(x + side * change).astype(np.float64) for side in (0.01, -0.01)]
    assert error(moved, (sides[0] - sides[1]) / 0.02) < 1e-3
    gradient = refocus.gradient(x, np.ones(expected.shape))
    assert (gradient[::5] == 0).all() and (gradient[x != 0] != 0).all()


def test_integrals_of_cubics_are_exact():
    """Between its samples a parabola is what Keys's cubic makes of it; edges beyond all samples leave the ends dark."""
    place = np.arange(-10, 11)
    edges = np.array([[7.3, 4.0, -0.25, -6.9]])
    values = np.roll(3 + 0.5 * place + 0.2 * place**2, -10)[None].astype(np.float64)
    exact = np.polynomial.Polynomial([3, 0.5, 0.2]).integ()(edges[0])
    found = Integrals(lambda lines: edges[lines], 1, 3, 21).forward(values)[0]
    np.testing.assert_allclose(found, exact[:-1] - exact[1:], rtol=1e-12)
    assert Integrals(lambda lines: np.array([[500.0, 400.0, -500.0]])[lines], 1, 2, 21).forward(values)[0, 0] == 0


def test_channels_are_solved_one_by_one_and_the_reverse_pass_repeats_no_sum(monkeypatch):
    camera = small_camera(3)
    refocus, capture, calls = DeconvolvedRefocus(camera, 250.0, iterations=2), lit(camera) + 0.02, []
    both, felt = np.stack([capture, capture[::-1]], axis=-1), np.random.default_rng(2).normal(size=(*refocus.shape, 2))
    at = refocus.at(both)
    np.testing.assert_array_equal(at.image[..., 1], refocus.forward(capture[::-1]))
    np.testing.assert_array_equal(at.vjp(felt)[..., 1], refocus.at(capture[::-1]).vjp(felt[..., 1]))
    for name in ("forward", "adjoint"):
        function = getattr(refocus.response, name)
        monkeypatch.setattr(refocus.response, name, lambda x, f=function, n=name: calls.append(n) or f(x))
    at = refocus.at(capture)
    assert [calls.count(name) for name in ("forward", "adjoint")] == [2, 3]  # and the light of bins
    calls.clear()
    at.vjp(np.ones(refocus.shape))
    assert [calls.count(name) for name in ("forward", "adjoint")] == [2, 2]


def test_gradients_of_drjit():
    refocus, x = RayRefocus(small_camera(3), 225.0), np.repeat(lit(small_camera(3))[..., None], 2, 2)
    change = x * np.random.default_rng(4).uniform(-1, 1, x.shape).astype(np.float32)
    capture = mi.TensorXf(x)
    dr.enable_grad(capture)
    image = refocus(capture)
    dr.set_grad(capture, mi.TensorXf(change))
    np.testing.assert_allclose(np.array(dr.forward_to(image)), refocus.forward(change), rtol=1e-5, atol=1e-6)
    capture = mi.TensorXf(x)
    dr.enable_grad(capture)
    image = refocus(capture)
    dr.backward(dr.sum(image * image, axis=None))
    gradient = refocus.adjoint(2 * refocus.forward(x))
    np.testing.assert_allclose(np.array(dr.grad(capture)), gradient, rtol=1e-4, atol=1e-6)
