"""Captures and reconstructions as functions of PyTorch's tensors, by gradcheck and by differences."""

import importlib
import sys

import mitsuba as mi
import numpy as np
import pytest
from wave_cases import WAVELENGTH, scattered, small_camera

from mitsuba_plenoptic import CaptureOperator, InputError, Spectrum, StoredOperator, load_scene
from mitsuba_plenoptic.reconstruction import CoherentRefocus, DeconvolvedRefocus, RayRefocus

torch = pytest.importorskip("torch")
bridge = importlib.import_module("mitsuba_plenoptic.torch")
forward_ad = importlib.import_module("torch.autograd.forward_ad")

CAMERA = small_camera(2)
POINTS = scattered(3, image=0.05)

# Of central differences, and relative differences: derivatives and captures cut light at different angles.
STEPS = [("mla_distance", 0.02, 2e-3), ("mla_offset", 2e-4, 0.02)]


def stored(**options):
    return StoredOperator(CAMERA, POINTS, dtype="float64", **(options or {"wavelength": WAVELENGTH}))


def computing(camera):
    return CaptureOperator(camera, POINTS, wavelength=WAVELENGTH, accuracy=0)


def random(*shape, low=-1.0):
    """Return a tensor in double precision of which derivatives are taken."""
    values = np.random.default_rng(len(shape)).uniform(low, 1, shape)
    return torch.tensor(values, requires_grad=True)


def directional(function, given, change, step):
    """Return the derivative of a scalar from the reverse pass, and from central differences."""
    given = given.detach().requires_grad_()
    (gradient,) = torch.autograd.grad(function(given), given)
    with torch.no_grad():
        difference = (function(given + step * change) - function(given - step * change)) / (2 * step)
    return float((gradient * change).sum()), float(difference)


# -- weights and images ------------------------------------------------------------------------------


def test_gradients_of_weights_and_images_in_double_precision():
    operator = stored()
    once = {"check_forward_ad": True, "fast_mode": True}
    assert torch.autograd.gradcheck(lambda w: bridge.forward(operator, w), random(2, 3), **once)
    assert torch.autograd.gradcheck(
        lambda y: bridge.adjoint(operator, y)[..., :2], random(*CAMERA.shape), fast_mode=True
    )
    assert torch.autograd.gradgradcheck(lambda w: bridge.forward(operator, w) ** 2, random(3), fast_mode=True)


def test_batches_are_the_operator_one_by_one():
    operator, weights = stored(), random(2, 4, 3)
    images = bridge.forward(operator, weights)
    assert images.shape == (2, 4, *CAMERA.shape)
    assert images.dtype == torch.float64 and images.is_contiguous()
    np.testing.assert_allclose(images[1, 2].detach(), operator.forward(weights[1, 2].detach().numpy()))
    np.testing.assert_allclose(bridge.adjoint(operator, images)[1, 2].detach(), operator.adjoint(images[1, 2].detach()))


def test_spectra_have_channels_before_rows():
    operator = stored(spectrum=Spectrum((633.0, 532.0), ((1.0, 0.1), (0.0, 1.0), (0.5, 0.5))))
    weights = random(2, 2, 3)
    images = bridge.forward(operator, weights)
    assert images.shape == (2, 3, *CAMERA.shape)
    expected = operator.forward(weights[1].detach().numpy().T)
    np.testing.assert_allclose(images[1].detach(), np.moveaxis(expected, -1, 0))
    assert bridge.adjoint(operator, images).shape == weights.shape
    assert torch.autograd.gradcheck(lambda w: bridge.forward(operator, w), weights, fast_mode=True)


def test_a_step_of_richardson_and_lucy():
    """Unrolled in PyTorch, through both directions of the operator."""
    operator, white = stored(), torch.ones(CAMERA.shape, dtype=torch.float64)
    image = bridge.forward(operator, torch.tensor([1.0, 2.0, 0.5], dtype=torch.float64))

    def step(weights, image):
        ratio = image / bridge.forward(operator, weights).clamp(min=1e-9)
        return weights * bridge.adjoint(operator, ratio) / bridge.adjoint(operator, white)

    assert torch.autograd.gradcheck(step, (random(3, low=0.5), image.requires_grad_()), fast_mode=True, atol=1e-4)


def test_spreads_are_computed_once(monkeypatch):
    operator, weights, calls = stored(), random(3), []
    compute = operator._matrix
    monkeypatch.setattr(operator, "_matrix", lambda spreads: calls.append(1) or compute(spreads))
    for _ in range(2):
        bridge.forward(operator, weights).square().sum().backward()
    assert len(calls) == 1


def test_single_precision_without_copies():
    operator = computing(CAMERA)
    weights = torch.ones(3, requires_grad=True)
    image = bridge.forward(operator, weights)
    assert image.dtype == torch.float32
    assert np.shares_memory(bridge._array(image), image.detach().numpy())
    image.square().sum().backward()
    np.testing.assert_allclose(weights.grad, 2 * operator.adjoint(image.detach().numpy()), rtol=1e-5)


def test_operators_get_the_memory_of_tensors(monkeypatch):
    operator, given = stored(), []
    for name in ("forward", "adjoint"):
        function = getattr(operator, name)
        monkeypatch.setattr(operator, name, lambda array, f=function: given.append(array) or f(array))
    weights, images = torch.ones(2, 3), torch.ones(2, *CAMERA.shape)
    made = bridge.forward(operator, weights), bridge.adjoint(operator, images)
    for array, tensor in zip(given, (weights, images), strict=True):
        assert np.shares_memory(array, tensor.numpy())
    assert np.shares_memory(np.from_dlpack(made[0]), made[0].numpy())


def test_tensors_of_other_types_and_layouts():
    operator = stored()
    weights = random(2, 3).detach()
    expected = bridge.forward(operator, weights)
    # Every second entry of a larger tensor, transposed.
    strided = torch.zeros(6, 4, dtype=torch.float64)
    strided[::2, ::2] = weights.T
    np.testing.assert_allclose(bridge.forward(operator, strided[::2, ::2].T), expected)
    by = RayRefocus(CAMERA, 225.0)
    np.testing.assert_allclose(bridge.refocus(by, expected.mT.contiguous().mT), bridge.refocus(by, expected))
    assert not bridge.forward(operator, weights).requires_grad
    for kind, limit in ((torch.float16, 1e-3), (torch.bfloat16, 1e-2)):
        made = bridge.forward(operator, weights.to(kind))
        assert made.dtype == kind
        torch.testing.assert_close(made.double(), expected, rtol=limit, atol=limit * float(expected.abs().max()))


def test_exchange_with_other_libraries_by_dlpack():
    """Without copies: what NumPy owns, a tensor made of it, and the results."""
    operator, owned = stored(), np.ones(3)
    weights = torch.from_dlpack(owned)
    image = bridge.forward(operator, weights)
    owned[:] = 2
    torch.testing.assert_close(bridge.forward(operator, weights), 2 * image)
    assert np.from_dlpack(image).__array_interface__["data"][0] == image.data_ptr()


# -- cameras -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "step", "limit"), STEPS)
def test_gradients_of_the_camera(name, step, limit):
    start = np.array(getattr(CAMERA, name))
    felt = torch.tensor(np.random.default_rng(2).normal(size=CAMERA.shape).cumsum(0).cumsum(1))
    weights = torch.tensor([1.0, 0.5, 2.0], dtype=torch.float64)

    def figure(value):
        return (bridge.capture(computing, CAMERA, {name: value}, weights) * felt).sum()

    reverse, difference = directional(figure, torch.tensor(start), torch.ones(start.shape), step)
    assert reverse == pytest.approx(difference, rel=limit)


def test_weights_and_camera_together():
    weights, made = random(2, 3), []
    pitch, offset = torch.tensor(0.064, requires_grad=True), torch.tensor([1e-3, 0.0], requires_grad=True)

    def make(camera):
        made.append(StoredOperator(camera, POINTS, wavelength=WAVELENGTH, accuracy=0))
        return made[-1]

    image = bridge.capture(make, CAMERA, {"mla_pitch": pitch, "mla_offset": offset}, weights)
    image.square().sum().backward()
    (operator,), given = made, 2 * np.moveaxis(image.detach().numpy(), 0, -1)
    expected = operator.gradient(weights.detach().numpy().T, given, ["mla_pitch", "mla_offset"])
    assert float(pitch.grad) == pytest.approx(float(expected["mla_pitch"].sum()), rel=1e-5)
    np.testing.assert_allclose(offset.grad, expected["mla_offset"], rtol=1e-5)
    np.testing.assert_allclose(weights.grad, operator.adjoint(given).T, rtol=1e-5)


def test_cameras_in_forward_mode():
    felt = torch.tensor(np.random.default_rng(2).normal(size=CAMERA.shape).cumsum(0).cumsum(1))
    start, weights = torch.tensor(120.0, dtype=torch.float64), torch.tensor([1.0, 0.5, 2.0], dtype=torch.float64)

    def figure(distance, weights):
        return (bridge.capture(computing, CAMERA, {"mla_distance": distance}, weights) * felt).sum()

    with forward_ad.dual_level():
        changing = forward_ad.make_dual(start, torch.ones_like(start)), forward_ad.make_dual(weights, 0.3 * weights)
        forward = forward_ad.unpack_dual(figure(*changing)).tangent
    step = 0.02
    ahead, back = (figure(start + one, weights * (1 + 0.3 * one)) for one in (step, -step))
    assert float(forward) == pytest.approx(float(ahead - back) / (2 * step), rel=1e-3)


def test_tensors_that_were_overwritten_are_refused():
    weights = torch.ones(3, requires_grad=True)
    distance = torch.tensor(120.0, requires_grad=True)
    image = bridge.capture(computing, CAMERA, {"mla_distance": distance}, weights)
    with torch.no_grad():
        weights += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        image.sum().backward()


# -- reconstructions ---------------------------------------------------------------------------------


def test_refocusing_by_rays():
    by = RayRefocus(CAMERA, 225.0)
    captures = random(2, *CAMERA.shape, low=0.1)
    images = bridge.refocus(by, captures)
    np.testing.assert_allclose(images[1].detach(), by.forward(captures[1].detach()), rtol=1e-6)
    change = torch.tensor(np.random.default_rng(5).normal(size=captures.shape))
    reverse, difference = directional(lambda c: bridge.refocus(by, c).square().sum(), captures, change, 0.01)
    assert reverse == pytest.approx(difference, rel=1e-3)


def test_refocusing_by_waves(monkeypatch):
    by = CoherentRefocus(CAMERA, 225.0, WAVELENGTH)
    captures = bridge.forward(stored(), random(2, 3, low=0.5)) + 1e-4
    change = torch.tensor(np.random.default_rng(5).normal(size=captures.shape)) * captures.detach()
    calls, at = [], by.at
    monkeypatch.setattr(by, "at", lambda capture: calls.append(1) or at(capture))
    reverse, difference = directional(lambda c: bridge.refocus(by, c).square().sum(), captures, change, 1e-2)
    assert reverse == pytest.approx(difference, rel=1e-3)
    assert len(calls) == 3


def test_steps_of_deconvolution():
    by = DeconvolvedRefocus(CAMERA, 225.0, iterations=3)
    captures = bridge.forward(stored(), random(2, 3, low=0.5)).detach() + 1e-4
    np.testing.assert_allclose(bridge.refocus(by, captures)[1], by.forward(captures[1]), rtol=1e-6)
    change = torch.tensor(np.random.default_rng(5).uniform(size=captures.shape)) * captures
    reverse, difference = directional(lambda c: bridge.refocus(by, c).square().sum(), captures, change, 1e-2)
    assert reverse == pytest.approx(difference, rel=1e-3)


# -- scenes ------------------------------------------------------------------------------------------


def test_captures_of_scenes():
    mi.set_variant("llvm_ad_mono")
    scene = load_scene(
        "letters", parameters={"resolution": "32", "detector_width": "0.064", "letter_scale": "0.0078125"}
    )
    integrator, key = mi.load_dict({"type": "plenoptic_wave"}), "f.emitter.radiance.value"
    start = torch.tensor(np.array(mi.traverse(scene)[key]))

    def image(value, seed=0):
        return bridge.render(scene, {key: value}, integrator=integrator, spp=8, seed=seed)

    felt = torch.tensor(np.random.default_rng(3).uniform(size=(32, 32, 1)), dtype=torch.float32)
    value = start.clone().requires_grad_()
    (image(value) * felt).sum().backward()
    # The reverse pass draws from another seed, which Mitsuba derives from the first.
    other = int(mi.sample_tea_32(0, 1)[0])
    with torch.no_grad():
        difference = ((image(start + 0.1, other) - image(start - 0.1, other)) * felt).sum() / 0.2
    assert float(value.grad.sum()) == pytest.approx(float(difference), rel=1e-3)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, "^values: give at least one parameter of the scene$"),
        (
            {"f.emitter.radiance.value": torch.ones(3)},
            r"^f\.emitter\.radiance\.value of shape \(3,\): it must be \(1,\)$",
        ),
        ({"f.faces": torch.ones(18)}, "^f.faces: it is UInt: give floating-point numbers"),
        ({"f.emitter.radiance": torch.ones(1)}, "^values: f.emitter.radiance: it is not one of"),
    ],
)
def test_values_that_the_scene_does_not_have(values, message):
    mi.set_variant("llvm_ad_mono")
    with pytest.raises(InputError, match=message):
        bridge.render(load_scene("letters"), values)


# -- mistakes ----------------------------------------------------------------------------------------


def test_mistakes():
    with pytest.raises(InputError, match=r"^weights of shape \(2, 4\): it must not be empty, and its last axes"):
        bridge.forward(stored(), random(2, 4))
    with pytest.raises(InputError, match=r"^\[1, 2, 3\]: it must be a tensor of PyTorch$"):
        bridge.forward(stored(), [1, 2, 3])
    for wrong in (torch.tensor([1, 2, 3]), torch.ones(3).to_sparse(), torch.ones(3, device="meta")):
        with pytest.raises(
            InputError, match=r"^tensor of shape \(3,\), .*: it must be a dense tensor of floating point"
        ):
            bridge.forward(stored(), wrong)
    with pytest.raises(InputError, match=r"^parameters: wavelength: it is not one of"):
        bridge.capture(lambda camera: stored(), CAMERA, {"wavelength": torch.tensor(633.0)}, random(3))
    for shape in ((3,), (0, *CAMERA.shape)):
        with pytest.raises(
            InputError, match=r"^captures of shape \(.*\): it must not be empty, and its last axes must be"
        ):
            bridge.refocus(RayRefocus(CAMERA, 225.0), random(*shape))


def test_torch_that_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "mitsuba_plenoptic.torch")
    with pytest.raises(InputError, match=r"^mitsuba_plenoptic\.torch needs the package torch: pip install"):
        importlib.import_module("mitsuba_plenoptic.torch")
