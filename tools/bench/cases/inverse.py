"""Derivatives of captures by signed rays, and their time.

Inverse problems: least squares with stored spreads against computed ones, and training steps in PyTorch.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse.linalg import lsqr

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, StoredOperator, load_scene
from mitsuba_plenoptic.light.signed_camera import PARAMETERS

from .. import Row, case, figure, pick
from ..measures import relative
from ..scenes.light_paths import facing, radiating, scene_of, sensor
from ..timing import once, paired

LIMIT, TRANSPOSE, SLOWEST = 0.01, 1e-5, 4.0

POINT = {"type": "point", "position": [0.0, 40.0, 0.0], "intensity": 3e4}

CUBE = {"type": "cube", "bsdf": {"type": "null"}}

THICK = 20.0

TIMED = {"letters": "f.emitter.radiance.value", "still_life": "window.emitter.radiance.value"}


@case(
    "gradients.accuracy",
    "Derivatives of captures by signed rays: forward against differences of captures with the same rays, reverse "
    "against forward, the coefficients of fog against closed forms",
    page="docs/guides/derivatives.md",
    quick={"lenses": 4, "only": ("letters",)},
)
def gradients(*, lenses: int = 8, only: tuple[str, ...] = ()) -> Iterator[Row]:
    """Measure the letters, made small, a wall of some gloss that a point lights, and fog.

    Mitsuba differentiates the fog's coefficients in reverse alone: absorbing fog darkens what is behind it by its
    thickness, and light scattered once is proportional to the albedo.
    """
    path, gloss = mi.load_dict(signed("path")), {"type": "roughconductor", "alpha": 0.3}
    textured = {"type": "diffuse", "reflectance": texture()}
    principled = {"type": "principled", "roughness": 0.5, "metallic": 0.5}
    cases: dict[str, Callable[[], Iterator[Row]]] = {
        "letters": lambda: compare("letters, radiance", letters(lenses), path, "f.emitter.radiance.value", 0.05),
        "texture": lambda: compare("texture", wall(lenses, textured), path, "wall.bsdf.reflectance.data", 0.05),
        "rough": lambda: compare("rough conductor", wall(lenses, gloss), path, "wall.bsdf.alpha.value", 0.003),
        "principled": lambda: compare("principled", wall(lenses, principled), path, "wall.bsdf.roughness.value", 0.003),
        "extinction": lambda: against_form("extinction", absorbing(lenses), "sigma_t", lambda total: -THICK * total),
        "albedo": lambda: against_form("albedo", scattering(lenses), "albedo", lambda total: total / 0.6),
    }
    for measure in pick(cases, only).values():
        yield from measure()


def absorbing(lenses: int) -> Any:
    """Return the scene of a shining wall behind absorbing fog."""
    shining = facing(260.0, 20.0, **radiating())
    return foggy(lenses, {"sigma_t": 0.03, "albedo": 0.0}, signed("volpath"), wall=shining)


def scattering(lenses: int) -> Any:
    """Return the scene of fog that scatters a lamp's light once."""
    return foggy(lenses, {"sigma_t": 0.03, "albedo": 0.6}, signed("volpath", max_depth=2), lamp=POINT)


def signed(child: str, **options: Any) -> dict[str, Any]:
    """Describe the integrator."""
    return {"type": "plenoptic_wave", "method": "signed_rays", "child": {"type": child, **options}}


def wall(lenses: int, bsdf: dict[str, Any]) -> Any:
    """Return the scene of a wall that a point lights."""
    return scene_of(sensor(lenses, 16), signed("path"), wall=facing(250.0, 0.8, bsdf=bsdf), lamp=POINT)


def foggy(lenses: int, medium: dict[str, Any], child: dict[str, Any], **objects: Any) -> Any:
    """Return the scene of a slab of fog."""
    to_world = mi.ScalarTransform4f().translate([0, 0, 240]).scale([20, 20, THICK / 2])
    fog = {**CUBE, "to_world": to_world, "interior": {"type": "homogeneous", **medium}}
    return scene_of(sensor(lenses, 16), child, fog=fog, **objects)


def letters(lenses: int) -> Any:
    """Return the letters before an array of `lenses` across."""
    size = {"resolution": 16 * lenses, "detector_width": 0.064 * lenses, "letter_scale": lenses / 128}
    return load_scene("letters", parameters={name: str(value) for name, value in size.items()})


def texture() -> dict[str, Any]:
    """Describe a texture."""
    texels = np.random.default_rng(1).uniform(0.2, 1, (4, 4, 1)).astype(np.float32)
    return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(texels)}


def direction_of(value: Any) -> Any:
    """Return in which direction a parameter is changed."""
    if isinstance(value, mi.TensorXf):
        return mi.TensorXf(np.random.default_rng(2).uniform(-0.2, 0.2, value.shape).astype(np.float32))
    return type(value)(1.0)


def compare(what: str, scene: Any, integrator: Any, key: str, step: float) -> Iterator[Row]:
    """Compare forward with differences, and reverse with forward."""
    params, camera = mi.traverse(scene), scene.sensors()[0]
    start = type(params[key])(params[key])
    direction, amount, sides = direction_of(start), mi.Float(0), []
    for side in (step, -step):
        params[key] = start + side * direction
        params.update()
        sides.append(np.array(integrator.render(scene, camera, spp=16), np.float64))
    dr.enable_grad(amount)
    params[key] = start + amount * direction
    params.update()
    dr.forward(amount, dr.ADFlag.ClearEdges)
    change = np.array(integrator.render_forward(scene, params, camera, spp=16), np.float64)
    gradient = np.random.default_rng(3).normal(size=change.shape)
    back = pulled(scene, integrator, key, start, gradient, 16) @ np.ravel(np.array(direction))
    off = abs(np.vdot(change, gradient) - back) / (np.linalg.norm(change) * np.linalg.norm(gradient))
    yield figure(f"{what}, forward", relative(change, (sides[0] - sides[1]) / (2 * step)), at_most=LIMIT)
    yield figure(f"{what}, reverse against forward", off, at_most=TRANSPOSE)


def pulled(scene: Any, integrator: Any, key: str, value: Any, gradient: np.ndarray, spp: int) -> np.ndarray:
    """Return the gradient by a parameter from that of the image."""
    params = mi.traverse(scene)
    params[key] = value
    dr.enable_grad(params[key])
    params.update()
    given = mi.TensorXf(gradient.astype(np.float32))
    integrator.render_backward(scene, params, given, scene.sensors()[0], spp=spp)
    found = np.ravel(np.array(dr.grad(params[key]), np.float64))
    # Mitsuba follows parameters of all scenes that there are.
    dr.disable_grad(params[key])
    params.update()
    return found


def against_form(what: str, scene: Any, name: str, form: Callable[[float], float]) -> Iterator[Row]:
    """Compare the gradient of the image's sum by a coefficient of the fog with what follows from the sum."""
    key = f"fog.interior_medium.{name}.value.value"
    image = np.array(scene.integrator().render(scene, scene.sensors()[0], spp=256), np.float64)
    value = mi.Float(mi.traverse(scene)[key])
    found = pulled(scene, scene.integrator(), key, value, np.ones(image.shape), 64)[0]
    yield figure(f"{what}, reverse", abs(found / form(image.sum()) - 1), at_most=LIMIT)


@case(
    "gradients.time",
    "Reverse passes of captures by signed rays, by a radiance and by all parameters of the camera, over the capture, "
    "elapsed time, 16 samples a pixel",
    page="docs/guides/derivatives.md",
    quick={"resolution": 256, "runs": 1, "only": ("letters",)},
)
def times(*, resolution: int = 1024, runs: int = 3, only: tuple[str, ...] = ()) -> Iterator[Row]:
    """Time a capture and its reverse passes in turn."""
    for name, key in pick(TIMED, only).items():
        size = {"resolution": str(resolution), "detector_width": str(0.002 * resolution)}
        if name == "letters":
            size["letter_scale"] = str(resolution / 4096)
        scene, integrator = load_scene(name, parameters=size), mi.load_dict(signed("path"))
        camera, params = scene.sensors()[0], mi.traverse(scene)
        given = dr.ones(mi.TensorXf, (resolution, resolution, 1))
        of_camera = [each for each in params.keys() if each.rsplit(".", 1)[-1] in PARAMETERS]  # noqa: SIM118

        def reverse(keys: list[str], s: Any = scene, i: Any = integrator, p: Any = params, g: Any = given) -> None:
            for each in keys:
                dr.enable_grad(p[each])
            p.update()
            i.render_backward(s, p, g, s.sensors()[0], spp=16)
            for each in keys:
                dr.disable_grad(p[each])
            p.update()

        works: dict[str, Callable[[], object]] = {
            "capture": lambda s=scene, i=integrator, c=camera: np.array(i.render(s, c, spp=16)),
            "a radiance": lambda k=key, r=reverse: r([k]),
            "the camera": lambda k=of_camera, r=reverse: r(k),
        }
        timings = paired(works, runs)
        capture = timings["capture"].seconds
        for what, limit in (("a radiance", SLOWEST), ("the camera", None)):
            title = f"{name}, by {what}: reverse pass over {capture:.2f} s"
            yield figure(title, timings[what].ratio, at_most=limit)


WAVELENGTH = 633.0

FASTER, MOST_OURS = 50.0, 0.25


def _camera(pixels: int) -> PlenopticCamera:
    return PlenopticCamera(detector_width=0.002 * pixels, resolution=(pixels, pixels))


@case(
    "inverse.lsqr",
    "Least squares with SciPy's lsqr: steps with stored point spreads, their computation included, against steps that "
    "compute them",
    page="docs/guides/inverse_problems.md",
    quick={"pixels": 64},
)
def least_squares(*, points: int = 25, pixels: int = 256, steps: int = 60, computed: int = 3) -> Iterator[Row]:
    """Find the weights of random points from a capture with noise."""
    camera, rng = _camera(pixels), np.random.default_rng(0)
    reach = camera.detector_width  # of points at twice the distance of the microlenses
    positions = np.column_stack([rng.uniform(-reach, reach, (points, 2)), rng.uniform(215, 260, points)])
    weights, options = rng.uniform(0.5, 1, points), {"wavelength": WAVELENGTH, "accuracy": 0}
    plain = CaptureOperator(camera, positions, **options)
    image = plain.forward(weights)  # plans the sums, and compiles the kernels
    noisy = image + rng.normal(size=image.shape) * image.std() / 10

    def solve(operator: CaptureOperator, count: int) -> Any:
        return lsqr(operator.as_linear_operator(), noisy.ravel(), iter_lim=count, atol=0, btol=0, conlim=0)

    found, _, busy = once(lambda: solve(plain, computed))
    each = busy / found[2]
    stored = StoredOperator(camera, positions, **options)
    _, _, making = once(stored.to_sparse)
    solved, _, solving = once(lambda: solve(stored, steps))
    whole = making + steps * solving / solved[2]
    yield figure(f"{computed} steps that compute the spreads, processor time", computed * each, unit="s")
    yield figure("computing and storing the spreads once", making, unit="s")
    yield figure(f"{steps} steps with stored spreads, and computing them", whole, unit="s")
    yield figure(f"times faster, {steps} steps", steps * each / whole, at_least=FASTER if pixels >= 256 else None)
    yield figure("image against that of computed spreads", relative(stored.forward(weights), image), at_most=1e-5)


@case(
    "inverse.training",
    "A training step of a small network on captures by stored spreads in PyTorch: its time, and the part of captures",
    page="docs/guides/inverse_problems.md",
    quick={"pixels": 64, "batch": 4, "across": 4},
    needs=("torch",),
)
def training(*, batch: int = 32, pixels: int = 256, across: int = 16, runs: int = 3) -> Iterator[Row]:
    """Capture planes whose weights are trained together with three convolutions that see the captures."""
    torch: Any = importlib.import_module("torch")
    bridge: Any = importlib.import_module("mitsuba_plenoptic.torch")
    camera = _camera(pixels)
    axis = np.linspace(-0.4, 0.4, across) * camera.detector_width * 2
    x, y = (each.ravel() for each in np.meshgrid(axis, axis))
    operator = StoredOperator(camera, np.column_stack([x, y, np.full(x.size, 240.0)]), wavelength=WAVELENGTH)
    torch.manual_seed(0)
    weights = torch.rand(batch, x.size, requires_grad=True)
    layers = [torch.nn.Conv2d(a, b, 3, padding=1) for a, b in ((1, 8), (8, 8), (8, 1))]
    network = torch.nn.Sequential(layers[0], torch.nn.ReLU(), layers[1], torch.nn.ReLU(), layers[2])
    trained = torch.optim.Adam([weights, *network.parameters()], lr=1e-3)
    spent, forward, adjoint = [0.0], operator.forward, operator.adjoint

    def timed(function: Any) -> Any:
        def call(given: Any) -> Any:
            start = time.perf_counter()
            result = function(given)
            spent[0] += time.perf_counter() - start
            return result

        return call

    operator.forward, operator.adjoint = timed(forward), timed(adjoint)  # type: ignore[method-assign]

    def step() -> None:
        trained.zero_grad()
        captures = bridge.forward(operator, weights)[:, None]
        (network(captures / captures.detach().std()) - 1).square().mean().backward()
        trained.step()

    _, making, _ = once(step)
    taken, ours = [], []
    for _ in range(runs):
        spent[0] = 0.0
        taken.append(once(step)[1])
        ours.append(spent[0])
    middle = int(np.argsort(taken)[runs // 2])
    yield figure(f"first step, with the spreads of {x.size} points", making, unit="s")
    yield figure(f"a step of {batch} captures of {pixels} x {pixels}", taken[middle], unit="s")
    yield figure("fraction of it in captures and their transpose", ours[middle] / taken[middle], at_most=MOST_OURS)
