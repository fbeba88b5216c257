"""Refocusing by rays as a differentiable function: the transpose, and gradients from Dr.Jit and PyTorch."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cameras import small_camera

from mitsuba_plenoptic import InputError, reconstruct
from mitsuba_plenoptic.refocus import RayRefocus

CAMERAS = {
    "square": ({}, {}),
    "points": ({}, {"footprint": "point", "oversample": 2}),
    "cropped, to infinity": ({"crop_offset": (20, 40), "crop_size": (90, 70)}, {"distance": float("inf")}),
    "hexagonal, turned": ({"mla_lattice": "hexagonal", "mla_rotation": 7.0, "mla_fill": 0.9}, {"oversample": 2}),
    "three focal lengths": ({"mla_lattice": "hexagonal", "mla_focal_length": (0.44, 0.512, 0.6)}, {"distance": 150.0}),
    "focused": ({"mla_distance": 112.0, "detector_distance": 0.6}, {"oversample": 3}),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * name.startswith("three")) for name in CAMERAS]
)
def test_transpose_and_values(name):
    """<A x, y> = <x, A' y> to 1e-5, and A x is what `reconstruct` makes."""
    numbers, options = CAMERAS[name]
    camera, options = small_camera(4, **numbers), {"distance": 225.0} | options
    refocus, rng = RayRefocus(camera, **options), np.random.default_rng(0)
    x = rng.uniform(0, 1, (*camera.shape, 2)).astype(np.float32)
    made = refocus.forward(x)
    expected = reconstruct(x[..., 0], camera=camera, **options).image
    np.testing.assert_allclose(made[..., 0], np.nan_to_num(expected), rtol=1e-6, atol=1e-6)
    assert (made == 0).mean() < 0.9
    y = rng.normal(size=made.shape).astype(np.float32)
    back = refocus.adjoint(y)
    difference = np.vdot(made.astype(np.float64), y) - np.vdot(x.astype(np.float64), back)
    assert abs(difference) < 1e-5 * np.linalg.norm(made) * np.linalg.norm(y)


def test_gradients_of_drjit():
    camera = small_camera(3)
    refocus, rng = RayRefocus(camera, 225.0), np.random.default_rng(1)
    x, change = (rng.uniform(0, 1, camera.shape).astype(np.float32) for _ in range(2))
    capture = mi.TensorXf(x)
    dr.enable_grad(capture)
    image = refocus(capture)
    dr.set_grad(capture, mi.TensorXf(change))
    np.testing.assert_allclose(np.array(dr.forward_to(image)), refocus.forward(change), rtol=1e-5, atol=1e-6)
    capture = mi.TensorXf(x)
    dr.enable_grad(capture)
    image = refocus(capture)
    dr.backward(dr.sum(image * image, axis=None))
    expected = 2 * refocus.adjoint(refocus.forward(x))
    np.testing.assert_allclose(np.array(dr.grad(capture)), expected, rtol=1e-4, atol=1e-6)


def test_gradients_of_pytorch():
    torch = pytest.importorskip("torch")
    camera = small_camera(3)
    refocus = RayRefocus(camera, 225.0)
    function = dr.wrap(source="torch", target="drjit")(lambda capture: refocus(capture))
    x = torch.rand(camera.shape, requires_grad=True)
    image = function(x)
    (image * image).sum().backward()
    pixels = x.detach().numpy()
    expected = 2 * refocus.adjoint(refocus.forward(pixels))
    np.testing.assert_allclose(x.grad.numpy(), expected, rtol=1e-4, atol=1e-6)


def test_mistakes():
    camera = small_camera(3)
    with pytest.raises(InputError, match="distance"):
        RayRefocus(camera, 50.0)
    with pytest.raises(InputError, match="footprint"):
        RayRefocus(camera, 225.0, footprint="disc")
    with pytest.raises(InputError, match="capture of shape"):
        RayRefocus(camera, 225.0).forward(np.zeros((3, 3)))
    with pytest.raises(InputError, match="bins of shape"):
        RayRefocus(camera, 225.0).adjoint(np.zeros((5, 3)))
