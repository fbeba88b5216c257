"""Time of ray captures through real main lenses."""

from __future__ import annotations

from collections.abc import Iterator

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import PlenopticCamera, load_scene, with_camera

from .. import Row, at_least, case
from ..timing import paired


@case(
    "lenses.speed",
    "Samples per second of ray captures through lenses over those of the thin lens",
    {"scene": "{scene}", "lens": "{lens}", "ratio": "{ratio:.2f}", "thin": "{thin:.3g}/s"},
    (at_least("ratio", "limit"),),
    page="docs/guides/main_lenses.md",
    quick={"resolution": 256, "runs": 1},
)
def speed(*, resolution: int = 1024, spp: int = 16, runs: int = 5) -> Iterator[Row]:
    """Render built-in scenes in turn."""
    for scene, limit in (("letters", 0.3), ("still_life", 0.7)):
        works = {}
        for name in (None, "double_gauss", "singlet"):
            camera = PlenopticCamera(
                resolution=(resolution, resolution), main_lens=name, focal_length=80, aperture_radius=5
            )
            loaded = with_camera(load_scene(scene), camera)
            works[name or "thin"] = lambda loaded=loaded: np.array(mi.render(loaded, spp=spp))
        timings = paired(works, runs)
        thin = resolution**2 * spp / timings["thin"].seconds
        for name in ("double_gauss", "singlet"):
            yield {
                "scene": scene,
                "lens": name,
                "ratio": 1 / timings[name].ratio,
                "thin": thin,
                "limit": limit if resolution >= 1024 else None,
            }
