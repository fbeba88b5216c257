"""Time, memory and noise of captures by signed rays against ray captures."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.ndimage import uniform_filter

from mitsuba_plenoptic import load_scene, render_capture

from .. import Row, at_most, case
from ..timing import in_process, paired, peak_memory

MODELS: dict[str, dict[str, Any]] = {"ray": {"model": "ray"}, "wave": {"model": "wave", "method": "signed_rays"}}

CROP, SEEDS = 512, 16

_LIT, _NOISY = 0.1, 0.01
"""Light of lit pixels over the median of pixels that have any; noise of a noisy pixel's ray captures over its light."""


@case(
    "signed-ray-cost",
    "Captures by signed rays and by rays in turn, a scene in a process of its own: seconds of the processor and "
    "elapsed, their ratios, peak of memory, light, and variance over seeds of lit pixels of the middle",
    {
        "scene": "{scene}", "rays (s)": "{ray[0]:.1f}, {ray[1]:.1f}", "waves (s)": "{wave[0]:.1f}, {wave[1]:.1f}",
        "waves over rays": "{ratio:.2f}, {elapsed_ratio:.2f}", "peak (GiB)": "{memory:.1f}", "light": "{light:.3f}",
        "variance": "{variance:.2f}", "median, 99 %": "{median:.2f}, {highest:.1f}",
        "99 % of noisy pixels": "{highest_of_noisy:.1f}",
    },
    (at_most("light_off", 0.01), at_most("median", 1.3), at_most("highest_of_noisy", "most")),
    page="docs/theory/cost.md",
    quick={"scenes": ("letters",), "pixels": 256, "runs": 1, "seeds": 2},
)  # fmt: skip
def signed_ray_cost(
    *,
    scenes: tuple[str, ...] = ("letters", "still_life", "vitrine", "keplerian"),
    pixels: int = 4096,
    samples: int = 16,
    runs: int = 2,
    seeds: int = SEEDS,
    variant: str = "llvm_ad_mono",
) -> Iterator[Row]:
    """Measure scenes; ``variant=llvm_ad_rgb`` captures three wavelengths."""
    for name in scenes:
        row = in_process(_times, name, pixels, samples, runs, variant=variant)
        yield row | in_process(_variances, name, pixels, samples, seeds, variant=variant)


def _times(name: str, pixels: int, samples: int, runs: int) -> Row:
    scene, means = load_scene(name, parameters={"resolution": str(pixels)}), {}

    def capture(model: str) -> None:
        means[model] = float(render_capture(scene, spp=samples, **MODELS[model]).image.mean())

    timings = paired({model: lambda model=model: capture(model) for model in MODELS}, runs)
    light = means["wave"] / means["ray"]
    return {
        "scene": name, "memory": peak_memory(), "light": light, "light_off": abs(light - 1),
        "ratio": timings["wave"].processor_ratio, "elapsed_ratio": timings["wave"].ratio,
        **{model: [timing.processor, timing.seconds] for model, timing in timings.items()},
    }  # fmt: skip


def _variances(name: str, pixels: int, samples: int, seeds: int) -> Row:
    """Compare the spread over seeds of the middle of the detector."""
    scene = load_scene(name, parameters={"resolution": str(pixels)})
    parameters = mi.traverse(scene)
    film = next(key for key in parameters.keys() if key.endswith("film.crop_size")).removesuffix("crop_size")  # noqa: SIM118
    size = min(CROP, pixels)
    parameters[f"{film}crop_size"] = mi.ScalarVector2u(size, size)
    parameters[f"{film}crop_offset"] = mi.ScalarPoint2u((pixels - size) // 2)
    parameters.update()
    rays, waves = (
        np.stack([render_capture(scene, spp=samples, seed=seed, **options).image for seed in range(seeds)])
        .reshape(seeds, size, size, -1)
        .mean(-1)
        for options in MODELS.values()
    )
    # Of few seeds, a pixel's variance is known better with its neighbours.
    spread = [uniform_filter(each.var(0, ddof=1), 3) for each in (rays, waves)]
    light = rays.mean(0)
    lit = (light > _LIT * np.median(light[light > 0])) & (spread[0] > 0)
    ratio, noisy = spread[1][lit] / spread[0][lit], np.sqrt(spread[0][lit]) > _NOISY * light[lit]
    return {
        "variance": float(spread[1][lit].sum() / spread[0][lit].sum()), "median": float(np.median(ratio)),
        "highest": float(np.percentile(ratio, 99)), "highest_of_noisy": float(np.percentile(ratio[noisy], 99)),
        # Ratios of variances of fewer seeds scatter too much.
        "most": 3.0 if seeds >= SEEDS else math.inf,
    }  # fmt: skip
