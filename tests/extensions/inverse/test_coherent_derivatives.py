"""Refocusing by waves as a differentiable function: values, adjoints of every step, differences, Dr.Jit, PyTorch."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cameras import WAVELENGTH, error, small_camera

from mitsuba_plenoptic import InputError, reconstruct
from mitsuba_plenoptic.light.optical_system import OpticalSystem
from mitsuba_plenoptic.refocus import CoherentRefocus, planning
from mitsuba_plenoptic.refocus.conjugates import ThinConjugates
from mitsuba_plenoptic.refocus.passages import BinSums, Integrals
from mitsuba_plenoptic.refocus.radiance import LensSpread
from mitsuba_plenoptic.refocus.wave_methods import BackwardFields

CAMERAS = {
    "square": ({}, {}),
    "subsets, finer bins": ({}, {"interleave": 2, "oversample": 2}),
    "cropped, to infinity": ({"crop_offset": (20, 40), "crop_size": (60, 50)}, {"distance": float("inf")}),
    "hexagonal, turned, gaps": ({"mla_lattice": "hexagonal", "mla_rotation": 7.0, "mla_fill": 0.9}, {}),
    "focused": ({"mla_distance": 112.0, "detector_distance": 0.6}, {"oversample": 2}),
}


def off(one, other, *norms):
    """Return the difference of two products over those of the norms."""
    return abs(one - other) / np.prod([np.linalg.norm(norm) for norm in norms])


def lit(camera):
    """Return a capture that a camera may have made: smooth micro-images of a pupil, with some noise."""
    rng = np.random.default_rng(0)
    x, y = (camera.pixel_coordinates(axis) for axis in (0, 1))
    chief = camera.mla_distance / (camera.mla_distance + camera.detector_distance)
    cx, cy = camera.lattice.centre(*camera.lattice.cell(*np.meshgrid(x * chief, y * chief)))
    pupil = np.hypot(x - cx / chief, (y[:, None] - cy / chief)) / (camera.micro_image_diameter / 2)
    return (rng.uniform(0.5, 1.5, camera.shape) / (1 + np.exp(20 * (pupil - 0.8)))).astype(np.float32)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name in ("square", "subsets, finer bins", "focused")))
        for name in CAMERAS
    ],
)
def test_values_transpose_and_differences(name):
    """The image is that of `reconstruct`, <J x, y> = <x, J' y> to 1e-5, and J x is what differences give."""
    numbers, options = CAMERAS[name]
    camera, options = small_camera(3, **numbers), {"distance": 225.0} | options
    refocus, rng = CoherentRefocus(camera, wavelength=WAVELENGTH, **options), np.random.default_rng(1)
    x = lit(camera)
    method = "partial" if "interleave" in options else "coherent"
    expected = reconstruct(x, camera=camera, wavelength=WAVELENGTH, method=method, **options).image
    at = refocus.at(x)
    assert error(at.image, np.nan_to_num(expected)) < 1e-5
    change, y = x * rng.uniform(-1, 1, x.shape), rng.normal(size=at.image.shape)
    moved, back = at.jvp(change).astype(np.float64), at.vjp(y).astype(np.float64)
    assert off(np.vdot(moved, y), np.vdot(change, back), moved, y) < 1e-5
    sides = [refocus.forward(x + side * change).astype(np.float64) for side in (0.01, -0.01)]
    assert error(moved, (sides[0] - sides[1]) / 0.02) < 1e-3


def test_pixels_below_zero_and_dark_ones():
    """The magnitude of a negative pixel is subtracted, so its derivative is that of its magnitude; of a dark one 0."""
    camera = small_camera(3)
    refocus, x = CoherentRefocus(camera, 225.0, WAVELENGTH), lit(camera)
    x[::7] *= -0.3
    x[::5] = 0
    expected = reconstruct(x, 225.0, camera=camera, wavelength=WAVELENGTH, method="coherent").image
    assert error(refocus.forward(x), expected) < 1e-5
    change = x * np.random.default_rng(2).uniform(-1, 1, x.shape)
    sides = [refocus.forward(x + side * change).astype(np.float64) for side in (0.01, -0.01)]
    assert error(refocus.derivative(x, change), (sides[0] - sides[1]) / 0.02) < 1e-3
    gradient = refocus.gradient(x, np.ones(expected.shape))
    assert (gradient[::5] == 0).all() and (gradient[x != 0] != 0).all()


@pytest.mark.parametrize(
    ("name", "strips"),
    [
        ("square", 1),
        pytest.param("hexagonal, turned, gaps", 3, marks=pytest.mark.slow),
        pytest.param("square", 3, marks=pytest.mark.slow),
        pytest.param("hexagonal, turned, gaps", 1, marks=pytest.mark.slow),
    ],
)
def test_adjoint_of_the_field_chain(name, strips):
    """<A x, y> = <x, Re A' y> to 1e-5 from amplitudes to the directions of the object plane, and on to the bins."""
    camera, rng = small_camera(3, **CAMERAS[name][0]), np.random.default_rng(3)
    columns, rows = camera.resolution
    grids = planning._plan(camera, WAVELENGTH, [225.0], ((0, columns), (0, rows)), 1, strips)
    (last,) = grids.to_objects
    (whole,) = ThinConjugates(OpticalSystem(camera, WAVELENGTH)).zones(225.0)
    chain = BackwardFields(camera, WAVELENGTH, grids, interleave=2, with_vjp=True)
    x = rng.normal(size=camera.shape).astype(np.float32)
    there = [
        np.concatenate([part.copy() for _, part in chain.to_object(field, whole, last)]) for field in chain.at_pupil(x)
    ]
    y = [complex_noise(rng, field.shape) for field in there]
    back = chain.vjp(y, whole, last)
    forward = sum(np.vdot(one, other).real for one, other in zip(y, there, strict=True))
    assert np.linalg.norm(there[0]) > 0
    assert off(forward, np.vdot(back, x), np.array(there), np.array(y)) < 1e-5

    sums, spread = BinSums(last, camera, WAVELENGTH, 2), LensSpread(camera, 1, 2)
    power = rng.uniform(0.5, 1, (last.x.new_padded, last.y.new_padded))
    change = rng.normal(size=power.shape)
    bins = sums.forward([(slice(None), power)])
    y = rng.normal(size=bins.shape)
    assert off(np.vdot(sums.jvp(change), y), np.vdot(change, sums.vjp(y)), sums.jvp(change), y) < 1e-10
    spread_bins = spread.forward(bins)
    y = rng.normal(size=spread_bins.shape)
    assert off(np.vdot(spread_bins, y), np.vdot(bins, spread.vjp(y)), spread_bins, y) < 1e-10


def complex_noise(rng, shape):
    """Return random fields."""
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)).astype(np.complex64)


def test_integrals_of_cubics_are_exact():
    """Between its samples a parabola is what Keys's cubic makes of it; edges beyond all samples leave the ends dark."""
    place = np.arange(-10, 11)
    edges = np.array([[7.3, 4.0, -0.25, -6.9]])
    values = np.roll(3 + 0.5 * place + 0.2 * place**2, -10)[None].astype(np.float64)
    exact = np.polynomial.Polynomial([3, 0.5, 0.2]).integ()(edges[0])
    np.testing.assert_allclose(
        Integrals(lambda lines: edges[lines], 1, 3, 21).forward(values)[0], exact[:-1] - exact[1:], rtol=1e-12
    )
    beyond = np.array([[500.0, 400.0, -500.0]])
    assert Integrals(lambda lines: beyond[lines], 1, 2, 21).forward(values)[0, 0] == 0


@pytest.mark.slow
def test_gradients_of_drjit_by_waves():
    camera = small_camera(2)
    refocus, x = CoherentRefocus(camera, 225.0, WAVELENGTH), np.repeat(lit(camera)[..., None], 2, 2)
    change = x * np.random.default_rng(4).uniform(-1, 1, x.shape).astype(np.float32)
    capture = mi.TensorXf(x)
    dr.enable_grad(capture)
    image = refocus(capture)
    dr.set_grad(capture, mi.TensorXf(change))
    np.testing.assert_allclose(np.array(dr.forward_to(image)), refocus.derivative(x, change), rtol=1e-5, atol=1e-6)
    capture = mi.TensorXf(x)
    dr.enable_grad(capture)
    image = refocus(capture)
    dr.backward(dr.sum(image * image, axis=None))
    expected = refocus.gradient(x, 2 * refocus.forward(x))
    np.testing.assert_allclose(np.array(dr.grad(capture)), expected, rtol=1e-4, atol=1e-6)


def test_gradients_of_pytorch_by_waves():
    torch = pytest.importorskip("torch")
    camera = small_camera(2)
    refocus = CoherentRefocus(camera, 225.0, WAVELENGTH)
    function = dr.wrap(source="torch", target="drjit")(lambda capture: refocus(capture))
    x = torch.tensor(lit(camera), requires_grad=True)
    image = function(x)
    (image * image).sum().backward()
    pixels = x.detach().numpy()
    expected = refocus.gradient(pixels, 2 * refocus.forward(pixels))
    np.testing.assert_allclose(x.grad.numpy(), expected, rtol=1e-4, atol=1e-6)


def test_mistakes_by_waves():
    camera = small_camera(2)
    for options, message in (
        ({"distance": 50.0}, "distance"),
        ({"interleave": 0}, "interleave"),
        ({"wavelength": -1.0}, "wavelength"),
    ):
        with pytest.raises(InputError, match=message):
            CoherentRefocus(camera, **({"distance": 225.0, "wavelength": WAVELENGTH} | options))
    refocus = CoherentRefocus(camera, 225.0, WAVELENGTH)
    with pytest.raises(InputError, match="capture of shape"):
        refocus.forward(np.zeros((3, 3)))
    with pytest.raises(InputError, match="image_gradient of 2 channels: the capture has 1"):
        refocus.gradient(lit(camera), np.zeros((2, 2, 2)))
    with pytest.raises(InputError, match="change of shape"):
        refocus.derivative(lit(camera), np.zeros((9, 9)))
