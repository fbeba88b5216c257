"""Captures and reconstructions as functions of PyTorch's tensors, by gradcheck and by differences."""

import gc
import importlib
import weakref

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cameras import WAVELENGTH, scattered, small_camera
from refusals import refused, refuses

from mitsuba_plenoptic import CaptureOperator, InputError, Spectrum, StoredOperator, load_scene
from mitsuba_plenoptic.refocus import CoherentRefocus, DeconvolvedRefocus, RayRefocus

torch = pytest.importorskip("torch")
bridge = importlib.import_module("mitsuba_plenoptic.torch")
forward_ad = importlib.import_module("torch.autograd.forward_ad")

CAMERA = small_camera(2)
POINTS = scattered(3, image=0.05)


def stored(**options):
    return StoredOperator(CAMERA, POINTS, dtype="float64", **(options or {"wavelength": WAVELENGTH}))


def computing(camera):
    return CaptureOperator(camera, POINTS, wavelength=WAVELENGTH, accuracy=0)


def random(*shape, low=-1.0):
    return torch.tensor(np.random.default_rng(len(shape)).uniform(low, 1, shape), requires_grad=True)


def test_gradients_of_weights_and_images_in_double_precision():
    operator, options = stored(), {"check_forward_ad": True, "fast_mode": True}
    gradcheck, second = torch.autograd.gradcheck, torch.autograd.gradgradcheck
    assert gradcheck(lambda w: bridge.forward(operator, w), random(2, 3), **options)
    assert gradcheck(lambda y: bridge.adjoint(operator, y)[..., :2], random(*CAMERA.shape), **options)
    assert second(lambda w: bridge.forward(operator, w) ** 2, random(3), fast_mode=True)


def test_batches_of_spectra_have_channels_before_rows():
    operator = stored(spectrum=Spectrum((633.0, 532.0), ((1.0, 0.1), (0.0, 1.0), (0.5, 0.5))))
    weights = random(4, 2, 2, 3)
    images = bridge.forward(operator, weights)
    assert images.shape == (4, 2, 3, *CAMERA.shape) and images.dtype == torch.float64 and images.is_contiguous()
    expected = operator.forward(weights[3, 1].detach().numpy().T)
    np.testing.assert_allclose(images[3, 1].detach(), np.moveaxis(expected, -1, 0))
    products = bridge.adjoint(operator, images)
    assert products.shape == weights.shape
    np.testing.assert_allclose(products[3, 1].detach(), operator.adjoint(expected).T)
    assert torch.autograd.gradcheck(lambda w: bridge.forward(operator, w), weights[0], fast_mode=True)


def test_operators_get_the_memory_of_tensors_and_of_what_dlpack_brings(monkeypatch):
    operator, given, owned = stored(), [], np.ones((2, 3))
    for name in ("forward", "adjoint"):
        function = getattr(operator, name)
        monkeypatch.setattr(operator, name, lambda array, f=function: given.append(array) or f(array))
    weights, images = torch.from_dlpack(owned), torch.ones(2, *CAMERA.shape)
    made = bridge.forward(operator, weights), bridge.adjoint(operator, images)
    for array, tensor in zip(given, (weights, images), strict=True):
        assert np.shares_memory(array, tensor.numpy())
    assert np.shares_memory(np.from_dlpack(made[0]), made[0].numpy())
    owned[:] = 2
    torch.testing.assert_close(bridge.forward(operator, weights), 2 * made[0])


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
    limits = {torch.float32: 1e-6, torch.float16: 1e-3, torch.bfloat16: 1e-2, torch.float8_e5m2: 0.13}
    for kind, limit in limits.items():
        made = bridge.forward(operator, weights.to(kind))
        assert made.dtype == kind
        torch.testing.assert_close(made.double(), expected, rtol=limit, atol=limit * float(expected.abs().max()))


def along(function, given, change, step):
    """Return a function's change by forward mode, by differences, and both sides of a dot test with the reverse."""
    _, made = torch.func.jvp(function, given, change)
    ahead, back = (function(*(a + sign * step * c for a, c in zip(given, change, strict=True))) for sign in (1, -1))
    felt = torch.tensor(np.random.default_rng(9).uniform(size=made.shape), dtype=made.dtype)
    leaves = [each.clone().requires_grad_() for each in given]
    gradients = torch.autograd.grad((function(*leaves) * felt).sum(), leaves)
    reverse = sum(float((g.double() * c).sum()) for g, c in zip(gradients, change, strict=True))
    return made, (ahead - back) / (2 * step), float((made.double() * felt).sum()), reverse


def require_close(made, expected, limit):
    assert float((made - expected).norm() / expected.norm()) < limit


OPTIONS = {RayRefocus: {}, CoherentRefocus: {"wavelength": WAVELENGTH}, DeconvolvedRefocus: {"iterations": 3}}


@pytest.mark.parametrize("kind", OPTIONS)
def test_refocusing_and_its_derivatives(kind, monkeypatch):
    by, calls = kind(CAMERA, 225.0, **OPTIONS[kind]), []
    captures = bridge.forward(stored(), random(2, 3, low=0.5)).detach() + 1e-4
    change = random(2, *CAMERA.shape, low=0).detach() * captures
    refocus = lambda c: bridge.refocus(by, c)  # noqa: E731
    np.testing.assert_allclose(refocus(captures)[1], by.forward(captures[1]), rtol=1e-6)
    made, difference, *products = along(refocus, (captures,), (change,), 1e-2)
    if kind is not RayRefocus:
        at = by.at
        monkeypatch.setattr(by, "at", lambda capture: calls.append(1) or at(capture))
        refocus(captures.clone().requires_grad_()).sum().backward()
        assert len(calls) == 1
    require_close(made, difference, 1e-3)
    assert products[0] == pytest.approx(products[1], rel=1e-5)
    # Rows that `torch.vmap` takes one by one are those of a batch.
    rows = torch.vmap(lambda c, d: torch.func.jvp(refocus, (c,), (d,))[1])(captures, change)
    torch.testing.assert_close(rows, made, rtol=1e-5, atol=1e-6 * float(made.abs().max()))


def test_transforms_of_derivatives():
    start, weights = torch.tensor(120.0, dtype=torch.float64), torch.tensor([0.5], dtype=torch.float64)
    make = lambda camera: CaptureOperator(camera, POINTS[:1], wavelength=WAVELENGTH, accuracy=0)  # noqa: E731

    def halves(distance, weights):
        return bridge.capture(make, CAMERA, {"mla_distance": distance}, weights).reshape(2, -1).square().sum(-1)

    ahead, back = (mode(halves, (0, 1))(start, weights) for mode in (torch.func.jacfwd, torch.func.jacrev))
    for one, other in zip(ahead, back, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=0)
    slope = torch.func.grad(lambda distance, weights: halves(distance, weights).sum())
    rows = torch.vmap(slope, (0, None))(torch.stack([start + 0.1, start]), weights)
    torch.testing.assert_close(rows[1], ahead[0].sum(), rtol=1e-4, atol=0)
    assert float(rows[0]) != float(rows[1])
    operator, many = stored(), random(4, 2, 3).detach()
    mapped = torch.vmap(lambda w: bridge.forward(operator, w), 1, 1)(many)
    torch.testing.assert_close(mapped, bridge.forward(operator, many))


def derived_twice():
    """Yield functions that have first derivatives only, and a tensor for them."""
    one = lambda camera: CaptureOperator(camera, POINTS[:1], wavelength=WAVELENGTH, accuracy=0)  # noqa: E731
    weights, refocus = torch.ones(3, dtype=torch.float64), CoherentRefocus(CAMERA, 225.0, WAVELENGTH)
    yield lambda d: bridge.capture(one, CAMERA, {"mla_distance": d}, weights[:1]).sum(), torch.tensor(120.0)
    yield lambda c: bridge.refocus(refocus, c).sum(), bridge.forward(computing(CAMERA), weights).float() + 1e-4


@pytest.mark.parametrize(("function", "at"), list(derived_twice()), ids=["capture", "refocus"])
def test_derivatives_of_derivatives_are_refused(function, at):
    """Also where the gradient that comes from above is constant, which PyTorch would take for a constant result."""
    given = at.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(given), given, create_graph=True)
    with pytest.raises(InputError, match=r"^derivatives of derivatives: "):
        (gradient.square().sum() + given.square().sum()).backward()
    once = torch.func.grad(function)
    refuses(r"^derivatives of derivatives: ", torch.func.grad(lambda x: once(x).sum()), at)
    refuses(r"^derivatives of derivatives: ", torch.func.jvp, once, (at,), (at,))


def test_derivatives_by_the_camera():
    felt = torch.tensor(np.random.default_rng(2).normal(size=CAMERA.shape).cumsum(0).cumsum(1))

    def figure(value, weights):
        return (bridge.capture(computing, CAMERA, {"mla_distance": value}, weights) * felt).sum()

    start, weights = torch.tensor(np.array(CAMERA.mla_distance)), torch.tensor([1.0, 0.5, 2.0], dtype=torch.float64)
    change = torch.ones_like(start), 0.3 * weights
    made, difference, *products = along(figure, (start, weights), change, 0.02)
    assert float(made) == pytest.approx(float(difference), rel=1e-3)
    assert products[0] == pytest.approx(products[1], rel=1e-4)
    with forward_ad.dual_level():
        changing = forward_ad.make_dual(start, change[0]), forward_ad.make_dual(weights, change[1])
        assert float(forward_ad.unpack_dual(figure(*changing)).tangent) == pytest.approx(float(made), rel=1e-6)


def test_steps_of_a_loop_keep_nothing():
    operators = []

    def make(camera):
        made = CaptureOperator(camera, POINTS, wavelength=WAVELENGTH, accuracy=0)
        operators.append(weakref.ref(made))
        return made

    for step in range(2):
        distance = torch.tensor(CAMERA.mla_distance + 1e-4 * step, dtype=torch.float64, requires_grad=True)
        image = bridge.capture(make, CAMERA, {"mla_distance": distance}, torch.ones(3, dtype=torch.float64))
        (image**2).sum().backward()
    del image
    gc.collect()
    assert not any(each() for each in operators)


def test_a_list_of_one_number_for_all_parts():
    """As of both pitches; of aberrations it is the first."""
    weights = torch.tensor([0.5], dtype=torch.float64)
    make = lambda camera: CaptureOperator(camera, POINTS[:1], wavelength=WAVELENGTH, accuracy=0)  # noqa: E731
    pitch, phases = torch.tensor([CAMERA.mla_pitch], dtype=torch.float64), torch.tensor([0.1, 0.2, 0.3])
    for name, value in (("mla_pitch", pitch), ("wavefront", phases[:1]), ("wavefront", phases)):
        captured = lambda value, name=name: bridge.capture(make, CAMERA, {name: value}, weights)  # noqa: E731
        _, _, forward, reverse = along(captured, (value,), (torch.ones_like(value),), 1e-5)
        assert forward == pytest.approx(reverse, rel=1e-5, abs=1e-6)


RADIANCES = ("f.emitter.radiance.value", "hash.emitter.radiance.value")


@pytest.fixture(scope="module")
def letters():
    """Return the capture of two letters as a function of values and the seed, with their names and first values."""
    mi.set_variant("llvm_ad_mono")
    small = {"resolution": "32", "detector_width": "0.064", "letter_scale": "0.0078125"}
    scene, integrator = load_scene("letters", parameters=small), mi.load_dict({"type": "plenoptic_wave"})

    def image(*values, names=RADIANCES, seed=0):
        return bridge.render(scene, dict(zip(names, values, strict=True)), integrator=integrator, spp=8, seed=seed)

    image.scene = scene
    return image


def test_captures_of_scenes(letters):
    start, change = [torch.ones(1), torch.ones(1)], [torch.ones(1), 0.5 * torch.ones(1)]
    # Derivatives draw from another seed, which Mitsuba derives from the first.
    other = int(mi.sample_tea_32(0, 1)[0])
    made, _, forward, reverse = along(letters, tuple(start), tuple(change), 0.02)
    ahead, back = (letters(start[0] + step, start[1] + step / 2, seed=other) for step in (0.02, -0.02))
    require_close(made, (ahead - back) / 0.04, 1e-3)
    assert forward == pytest.approx(reverse, rel=1e-5)


def test_captures_of_scenes_keep_their_values_for_the_reverse_pass(letters):
    """Though the scene has others by then; and the scene keeps no gradients."""
    felt = torch.tensor(np.random.default_rng(3).uniform(size=(32, 32, 1)), dtype=torch.float32)
    names = ("camera.mla_distance", RADIANCES[0])

    def leaves(scale):
        return [torch.tensor([120.0 * scale], requires_grad=True), torch.tensor([scale], requires_grad=True)]

    def gradients(values):
        return [each.grad for each in values]

    alone = []
    for scale in (1.0, 1.005):
        values = leaves(scale)
        (letters(*values, names=names) * felt).sum().backward()
        alone += gradients(values)
    first, second = leaves(1.0), leaves(1.005)
    images = letters(*first, names=names), letters(*second, names=names)
    ((images[0] + images[1]) * felt).sum().backward()
    torch.testing.assert_close(gradients(first) + gradients(second), alone, rtol=1e-5, atol=0)
    assert not any(dr.grad_enabled(mi.traverse(letters.scene)[name]) for name in names)
    (gradient, _) = torch.autograd.grad(letters(*first, names=names).sum(), first, create_graph=True)
    refuses(r"^derivatives of derivatives: ", (gradient + first[1] ** 2).sum().backward)
    image = letters(*first, names=names)
    with torch.no_grad():
        first[0] += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        image.sum().backward()


def test_values_that_are_refused_leave_the_scene_as_it_was(letters):
    """In one line, which `mi.render` hides: values by the camera, and those that the integrator refuses."""
    parameters, kept = mi.traverse(letters.scene), ("camera.mla_distance", RADIANCES[0])
    before, image = [np.array(parameters[name]) for name in kept], letters(torch.ones(1), torch.ones(1))
    refuses("^mla_distance = -5: ", letters, torch.tensor([-5.0]), torch.ones(1), names=kept)
    with pytest.raises(InputError, match=r"^scene: the radiance of some rays is NaN"):
        letters(torch.tensor([130.0]), torch.tensor([torch.nan]), names=kept)
    after = [np.array(parameters[name]) for name in kept]
    assert after[0] == before[0] and after[1] == 1
    torch.testing.assert_close(letters(torch.ones(1), torch.ones(1)), image, rtol=0, atol=0)


def test_scenes_of_another_variant(letters):
    value = torch.ones(1, requires_grad=True)
    image = letters(value, torch.ones(1))
    mi.set_variant("llvm_ad_rgb")
    for work in (lambda: image.sum().backward(), lambda: letters(value, torch.ones(1))):
        refuses("^scene: .*llvm_ad_mono.*llvm_ad_rgb", work)
    mi.set_variant("llvm_ad_mono")
    image.sum().backward()
    assert float(value.grad) > 0


def rendered(values):
    mi.set_variant("llvm_ad_mono")
    return bridge.render(load_scene("letters"), values)


def forwarded(weights):
    return bridge.forward(stored(), weights)


test_refusals = refused(
    (lambda: rendered({}), "^values: "),
    (lambda: rendered({RADIANCES[0]: torch.ones(3)}), r"^f\.emitter\.radiance\.value of shape \(3,\)"),
    (lambda: rendered({"f.faces": torch.ones(18)}), "^f.faces: it is UInt"),
    (lambda: rendered({"f.emitter.radiance": torch.ones(1)}), "^values: f.emitter.radiance: "),
    (lambda: forwarded(random(2, 4)), r"^weights of shape \(2, 4\)"),
    (lambda: forwarded([1, 2, 3]), r"^\[1, 2, 3\]: .* tensor"),
    (lambda: forwarded(torch.tensor([1, 2, 3])), r"^tensor of shape \(3,\), "),
    (lambda: forwarded(torch.ones(3).to_sparse()), r"^tensor of shape \(3,\), "),
    (lambda: forwarded(torch.ones(3, device="meta")), r"^tensor of shape \(3,\), "),
    (lambda: bridge.capture(computing, CAMERA, {"mla_distance": 120.0}, random(3)), r"^120\.0: .* tensor"),
    (lambda: bridge.capture(computing, CAMERA, {"wavelength": torch.ones(1)}, random(3)), "^parameters: wavelength: "),
    # Colours are axes before the rows.
    (lambda: bridge.refocus(RayRefocus(CAMERA, 225.0), random(64, 64, 3)), r"^captures .*64, 3\): .* \(64, 64\)$"),
)
