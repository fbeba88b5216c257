"""Signed rays against points, each propagated by itself: the letters, and the still life with matte materials.

Both are captured with the lens_model "parabolic" that waves pass, by several seeds each, whose spread is the noise. It
is subtracted from the relative difference (L2); the energy is that of points over that by signed rays. Parts of the
whole scenes are seen, by some lenses. By default it takes some minutes; at the full size, hours:

    python tools/points_comparison.py --output out/points [--lenses 32 --points 256 --accuracy 0 --seeds 4]
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import PlenopticCamera, load_scene, render_capture, scene_path
from mitsuba_plenoptic.plugins.other_camera import with_camera
from mitsuba_plenoptic.report.output_files import write_png

PIXELS = 32
"""Pixels of a lens at full resolution."""

REFLECTANCES = {"roughplastic": "diffuse_reflectance", "roughconductor": "specular_reflectance"}
"""What the colour of materials that become matte is called."""


def letters() -> Any:
    """Return the letters."""
    return load_scene("letters", variant="llvm_ad_mono")


def matte_still_life() -> Any:
    """Return the still life, its gloss taken away."""
    path = scene_path("still_life")
    tree = ElementTree.parse(path)
    for material in tree.iter("bsdf"):
        name = REFLECTANCES.get(material.get("type", ""))
        if name is None:
            continue
        material.set("type", "diffuse")
        for item in list(material):
            if item.get("name") == name:
                item.set("name", "reflectance")
            else:
                material.remove(item)
    for item in tree.iter("string"):
        if item.get("name") == "filename":
            item.set("value", str(path.parent / item.get("value", "")))
    with tempfile.TemporaryDirectory() as folder:
        matte = Path(folder) / "matte.xml"
        tree.write(matte)
        return load_scene(matte, variant="llvm_ad_mono")


SCENES = {
    "letters, the F in focus": (letters, (58, 55)),
    "letters, the 8 at 210 mm": (letters, (30, 71)),
    "letters, the # at 280 mm": (letters, (93, 63)),
    "matte still life": (matte_still_life, (56, 64)),
}
"""Each with the lens in the middle of its crop."""


def seen_by(scene: Any, middle: tuple[int, int], lenses: int) -> Any:
    """Return a scene as some lenses of the paper's camera see it, whose lenses are parabolic."""
    first = tuple(PIXELS * (place - lenses // 2) for place in middle)
    camera = PlenopticCamera(lens_model="parabolic", crop_offset=first, crop_size=(PIXELS * lenses,) * 2)
    return with_camera(scene, camera)


def capture(scene: Any, seeds: int, **options: Any) -> tuple[np.ndarray, float, float]:
    """Return the mean of some seeds' captures, the noise of that mean over its norm, and the seconds of one."""
    start = time.perf_counter()
    images = [
        np.asarray(render_capture(scene, model="wave", seed=seed, **options).image, float) for seed in range(seeds)
    ]
    mean = np.mean(images, axis=0)
    noise = math.sqrt(float(np.var(images, axis=0, ddof=1).sum()) / seeds) / float(np.linalg.norm(mean))
    return mean, noise, (time.perf_counter() - start) / seeds


def main() -> int:
    """Compare, print and write a table and pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out/points"))
    parser.add_argument("--lenses", type=int, default=8, help="across the part that is seen")
    parser.add_argument("--points", type=int, default=64, help="points of a lens")
    parser.add_argument("--rays", type=int, default=256, help="signed rays a pixel")
    parser.add_argument("--accuracy", type=float, default=0.01, help="of the points' propagation")
    parser.add_argument("--seeds", type=int, default=2, help="at least 2")
    parser.add_argument("--only", choices=list(SCENES), action="append")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    mi.set_variant("llvm_ad_mono")
    lines = [
        "| scene | difference | noise of points | of signed rays | energy | seconds by points | by signed rays |",
        "|---|---|---|---|---|---|---|",
    ]
    print(*lines, sep="\n", flush=True)
    for name in arguments.only or SCENES:
        load, middle = SCENES[name]
        scene = seen_by(load(), middle, arguments.lenses)
        rays, rays_noise, rays_time = capture(
            scene, arguments.seeds, method="signed_rays", spp=arguments.rays, accuracy=0.001
        )
        points, noise, seconds = capture(
            scene, arguments.seeds, method="points", spp=arguments.points, accuracy=arguments.accuracy
        )
        apart = float(np.linalg.norm(points - rays) / np.linalg.norm(rays))
        own = math.sqrt(max(apart**2 - noise**2 - rays_noise**2, 0))
        lines.append(
            f"| {name} | {own:.2%} | {noise:.2%} | {rays_noise:.2%} | {points.sum() / rays.sum():.4f} | {seconds:.0f} "
            f"| {rays_time:.0f} |"
        )
        print(lines[-1], flush=True)
        peak = float(rays.max())
        picture = np.concatenate([points, rays, 0.5 * peak + 10 * (points - rays)], axis=1)
        write_png(
            arguments.output
            / f"{''.join(c if c.isalnum() else '_' for c in name)}_points_rays_difference_times_10.png",
            picture,
            peak=peak,
        )
    (arguments.output / "points_comparison.md").write_text("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
