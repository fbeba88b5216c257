"""Measure derivatives of captures by signed rays: against differences of captures with the same rays, and their time.

    python tools/signed_gradients.py [--lenses 8] [--resolution 1024]

The scenes are the letters, made small before 64 lenses, and a wall of some gloss that a point lights. Forward is
compared with central differences of captures of the same seed, and reverse with forward. The medium's coefficients,
which Mitsuba differentiates in reverse alone, are compared with closed forms: absorbing fog darkens what is behind it
by its thickness, and light scattered once is proportional to the albedo. How well derivatives by the camera agree with
captures whose rays are held in the scene is in `tests/capture/test_signed_camera.py`.

Times are those of the built-in scenes with so many pixels across, 16 samples a pixel: of the capture, of its reverse
pass by a radiance, and by all parameters of the camera that have derivatives; the least of two. Writes
``signed_gradients.md`` and ``.json`` to the folder that ``--output`` names; exits with 1 where a limit is broken.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import accuracy
import drjit as dr
import mitsuba as mi
import numpy as np
from any_scenes import facing, radiating, scene_of, sensor

from mitsuba_plenoptic import load_scene
from mitsuba_plenoptic.capture.signed_camera import PARAMETERS

LIMIT, TRANSPOSE, SLOWEST = 0.01, 1e-5, 4.0
POINT = {"type": "point", "position": [0.0, 40.0, 0.0], "intensity": 3e4}
CUBE = {"type": "cube", "bsdf": {"type": "null"}}
THICK = 20.0
TIMED = {"letters": "f.emitter.radiance.value", "still_life": "window.emitter.radiance.value"}


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


def letters(lenses: int) -> tuple[Any, Any]:
    """Return the letters before so many lenses across, and the integrator."""
    size = {"resolution": 16 * lenses, "detector_width": 0.064 * lenses, "letter_scale": lenses / 128}
    scene = load_scene("letters", parameters={name: str(value) for name, value in size.items()})
    return scene, mi.load_dict(signed("path"))


def texture() -> dict[str, Any]:
    """Describe a texture."""
    texels = np.random.default_rng(1).uniform(0.2, 1, (4, 4, 1)).astype(np.float32)
    return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(texels)}


def direction_of(value: Any) -> Any:
    """Return in which direction a parameter is changed."""
    if isinstance(value, mi.TensorXf):
        return mi.TensorXf(np.random.default_rng(2).uniform(-0.2, 0.2, value.shape).astype(np.float32))
    return type(value)(1.0)


def compare(case: str, scene: Any, integrator: Any, key: str, step: float) -> list[accuracy.Row]:
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
    expected = (sides[0] - sides[1]) / (2 * step)
    off = abs(np.vdot(change, gradient) - back) / (np.linalg.norm(change) * np.linalg.norm(gradient))
    error = np.linalg.norm(change - expected) / np.linalg.norm(expected)
    return [
        {"case": f"{case}, forward", "found": float(error), "limit": LIMIT},
        {"case": f"{case}, reverse against forward", "found": float(off), "limit": TRANSPOSE},
    ]


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


def against_form(case: str, scene: Any, key: str, form: Callable[[float], float]) -> list[accuracy.Row]:
    """Compare the gradient of the image's sum with what follows from the sum."""
    image = np.array(scene.integrator().render(scene, scene.sensors()[0], spp=256), np.float64)
    value = mi.Float(mi.traverse(scene)[key])
    found = pulled(scene, scene.integrator(), key, value, np.ones(image.shape), 64)[0]
    return [{"case": f"{case}, reverse", "found": float(abs(found / form(image.sum()) - 1)), "limit": LIMIT}]


def least(work: Callable[[], Any]) -> float:
    """Return the least time of two runs, after one that compiles."""
    times = []
    for _ in range(3):
        start = time.perf_counter()
        work()
        dr.sync_thread()
        times.append(time.perf_counter() - start)
    return min(times[1:])


def timed(name: str, key: str, resolution: int) -> list[accuracy.Row]:
    """Time a capture and its reverse passes."""
    size = {"resolution": str(resolution), "detector_width": str(0.002 * resolution)}
    if name == "letters":
        size["letter_scale"] = str(resolution / 4096)
    scene, integrator = load_scene(name, parameters=size), mi.load_dict(signed("path"))
    camera, params = scene.sensors()[0], mi.traverse(scene)
    seconds = least(lambda: np.array(integrator.render(scene, camera, spp=16)))
    given, rows = dr.ones(mi.TensorXf, (resolution, resolution, 1)), []
    cameras = [each for each in params.keys() if each.rsplit(".", 1)[-1] in PARAMETERS]  # noqa: SIM118
    for case, keys in (("a radiance", [key]), ("the camera", cameras)):
        for each in keys:
            dr.enable_grad(params[each])
        params.update()
        ratio = least(lambda: integrator.render_backward(scene, params, given, camera, spp=16)) / seconds
        for each in keys:
            dr.disable_grad(params[each])
        params.update()
        limit = SLOWEST if case == "a radiance" else float("inf")
        rows.append({"case": f"{name}, by {case}: reverse pass over {seconds:.2f} s", "found": ratio, "limit": limit})
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    """Measure, and write the table."""
    parser = accuracy.options("signed_gradients", __doc__)
    parser.add_argument("--lenses", type=int, default=8, help="lenses across, for the comparisons")
    parser.add_argument("--resolution", type=int, default=1024, help="pixels across, for the times")
    arguments = accuracy.start(parser)
    lenses, rows = arguments.lenses, []
    rows += compare("letters, radiance", *letters(lenses), "f.emitter.radiance.value", 0.05)
    gloss = {"type": "roughconductor", "alpha": 0.3}
    for case, bsdf, key, step in (
        ("texture", {"type": "diffuse", "reflectance": texture()}, "wall.bsdf.reflectance.data", 0.05),
        ("rough conductor", gloss, "wall.bsdf.alpha.value", 0.003),
        ("principled", {"type": "principled", "roughness": 0.5, "metallic": 0.5}, "wall.bsdf.roughness.value", 0.003),
    ):
        scene = wall(lenses, bsdf)
        rows += compare(case, scene, scene.integrator(), key, step)
    absorbing = foggy(
        lenses, {"sigma_t": 0.03, "albedo": 0.0}, signed("volpath"), wall=facing(260.0, 20.0, **radiating())
    )
    sigma, albedo = (f"fog.interior_medium.{name}.value.value" for name in ("sigma_t", "albedo"))
    rows += against_form("extinction", absorbing, sigma, lambda total: -THICK * total)
    once = foggy(lenses, {"sigma_t": 0.03, "albedo": 0.6}, signed("volpath", max_depth=2), lamp=POINT)
    rows += against_form("albedo", once, albedo, lambda total: total / 0.6)
    for name, key in TIMED.items():
        rows += timed(name, key, arguments.resolution)
    for row in rows:
        row["verdict"] = "kept" if row["found"] <= row["limit"] else "beyond"
    columns = {"case": "{case}", "found": "{found:.3g}", "limit": "{limit:g}", "": "{verdict}"}
    accuracy.finish(arguments, rows, "# Derivatives of captures by signed rays\n", accuracy.markdown(columns, rows))
    sys.exit(any(row["verdict"] == "beyond" for row in rows))


if __name__ == "__main__":
    main()
