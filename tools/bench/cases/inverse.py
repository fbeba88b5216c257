"""Time of derivatives of captures by signed rays."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import load_scene
from mitsuba_plenoptic.waves.signed_camera import PARAMETERS

from .. import Row, case, figure, pick
from ..timing import paired

LIMIT, TRANSPOSE, SLOWEST = 0.01, 1e-5, 4.0


TIMED = {"letters": "f.emitter.radiance.value", "still_life": "window.emitter.radiance.value"}


def signed(child: str, **options: Any) -> dict[str, Any]:
    """Describe the integrator."""
    return {"type": "plenoptic_wave", "method": "signed_rays", "child": {"type": child, **options}}


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
