"""Time, memory and noise of captures by signed rays beside those by rays, in turn, in one run.

For each scene the captures are repeated in turn, each in both models. Printed are medians of the processor time and of
the elapsed time, their ratios, the peak of memory of the process, the light of the one over the other, and of a crop
the variance over seeds: that of waves over that of rays, all in all, the median and the 99th percentile of lit pixels.

    python tools/signed_rays_benchmark.py --output out/signed_rays_benchmark [--scenes letters] [--pixels 4096]
"""

from __future__ import annotations

import argparse
import resource
import statistics
import time
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.ndimage import uniform_filter

import mitsuba_plenoptic as mp

MODELS: dict[str, dict[str, Any]] = {"ray": {"model": "ray"}, "wave": {"model": "wave", "method": "signed_rays"}}
CROP, SEEDS = 512, 16


def main() -> int:
    """Measure, print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out/signed_rays_benchmark"))
    parser.add_argument("--scenes", nargs="+", default=["letters", "still_life", "vitrine", "keplerian"])
    parser.add_argument("--pixels", type=int, default=4096, help="of the detector across")
    parser.add_argument("--samples", type=int, default=16, help="rays a pixel")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--variant", default="llvm_ad_mono", help="llvm_ad_rgb captures three wavelengths")
    parser.add_argument("--no-noise", action="store_true")
    arguments = parser.parse_args()
    mi.set_variant(arguments.variant)
    lines = [
        "| scene | rays: processor, elapsed (s) | waves (s) | ratios | peak (GiB) | light | variance | median, 99 % |",
        "|---|---|---|---|---|---|---|---|",
    ]
    print(*lines, sep="\n")
    for name in arguments.scenes:
        times, means = capture_times(name, arguments)
        ray, wave = times["ray"], times["wave"]
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        noise = "" if arguments.no_noise else variances(name, arguments)
        lines.append(
            f"| {name} | {ray[0]:.1f}, {ray[1]:.1f} | {wave[0]:.1f}, {wave[1]:.1f} "
            f"| {wave[0] / ray[0]:.2f}, {wave[1] / ray[1]:.2f} | {peak:.1f} | {means['wave'] / means['ray']:.4f} "
            f"| {noise or '|'} |"
        )
        print(lines[-1], flush=True)
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "signed_rays_benchmark.md").write_text("\n".join(lines) + "\n")
    return 0


def capture_times(name: str, arguments: argparse.Namespace) -> tuple[dict[str, list[float]], dict[str, float]]:
    """Return the medians of processor and elapsed time of both models, and the mean pixels."""
    scene = mp.load_scene(name, parameters={"resolution": str(arguments.pixels)})
    found: dict[str, list[tuple[float, float]]] = {model: [] for model in MODELS}
    means = {}
    for repeat in range(arguments.repeats):
        for model, options in MODELS.items():
            processor, elapsed = time.process_time(), time.perf_counter()
            image = mp.render_capture(scene, spp=arguments.samples, seed=repeat, **options).image
            found[model].append((time.process_time() - processor, time.perf_counter() - elapsed))
            means[model] = float(image.mean())
    return {
        model: [statistics.median(each) for each in zip(*pairs, strict=True)] for model, pairs in found.items()
    }, means


def variances(name: str, arguments: argparse.Namespace) -> str:
    """Compare the spread over seeds of the middle of the detector."""
    scene = mp.load_scene(name, parameters={"resolution": str(arguments.pixels)})
    parameters = mi.traverse(scene)
    film = next(key for key in parameters.keys() if key.endswith("film.crop_size")).removesuffix("crop_size")  # noqa: SIM118
    size = min(CROP, arguments.pixels)
    parameters[f"{film}crop_size"] = mi.ScalarVector2u(size, size)
    parameters[f"{film}crop_offset"] = mi.ScalarPoint2u((arguments.pixels - size) // 2)
    parameters.update()
    images = {
        model: np.stack(
            [mp.render_capture(scene, spp=arguments.samples, seed=seed, **options).image for seed in range(SEEDS)]
        )
        for model, options in MODELS.items()
    }
    rays, waves = (each.reshape(SEEDS, size, size, -1).mean(-1) for each in images.values())
    # Of few seeds, a pixel's variance is known better with its neighbours.
    spread = [uniform_filter(each.var(0, ddof=1), 3) for each in (rays, waves)]
    lit = (rays.mean(0) > 0.02 * rays.mean(0).max()) & (spread[0] > 0)
    ratio = spread[1][lit] / spread[0][lit]
    total = spread[1][lit].sum() / spread[0][lit].sum()
    return f"{total:.2f} | {np.median(ratio):.2f}, {np.percentile(ratio, 99):.1f}"


if __name__ == "__main__":
    raise SystemExit(main())
