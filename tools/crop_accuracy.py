"""A still life by waves against exact sums in which nothing is shared, on crops of the whole detector.

For each of three crops of 512 x 512 pixels (a near ball, the far backdrop, the edge of the die before it) the radiators
that light it are found once. Their light is summed as a capture of the default accuracy sums it, by the kernel bank and
shared point spreads, and by a point spread of its own for each (accuracy 0): the relative L2 difference of the two
images has no noise in it. What the samples add is told apart: the difference of two captures with other random numbers,
over the root of two. Writes a table and each difference as a picture; exits with 1 if a crop is beyond its limit.

    python tools/crop_accuracy.py --output out/crops [--crops near far edge]
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import PlenopticCamera, load_scene, render_capture
from mitsuba_plenoptic.capture.accuracy import DEFAULT_ACCURACY
from mitsuba_plenoptic.capture.operator import CaptureOperator
from mitsuba_plenoptic.capture.radiators import find_radiators, sample_pairs
from mitsuba_plenoptic.capture.sight import Sight
from mitsuba_plenoptic.report.images import write_png

WAVELENGTH, SPP, PER_LENS = 633.0, 16, 8
CROPS = {"near": (22, 96), "far": (60, 10), "edge": (66, 62)}
"""First lens, along x and y, of the crops."""

LENSES, PIXELS = 16, 32
"""Lenses across a crop, and pixels across a lens."""

LIMIT = 0.01
"""Relative L2 difference at the default accuracy."""


def main() -> int:
    """Compare, and write table and pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out/crops"))
    parser.add_argument("--crops", nargs="+", default=list(CROPS), choices=list(CROPS))
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    mi.set_variant("llvm_ad_mono")
    lines = ["| crop | radiators | relative L2 | energy | noise | exact (s) |", "|---|---|---|---|---|---|"]
    worst = 0.0
    for name in arguments.crops:
        scene, camera = cropped(CROPS[name])
        start = time.perf_counter()
        image, exact, count = both(scene, camera)
        error = float(np.linalg.norm(image - exact) / np.linalg.norm(exact))
        worst = max(worst, error)
        lines.append(
            f"| {name} | {count} | {error:.2%} | {image.sum(dtype=float) / exact.sum(dtype=float):.4f} "
            f"| {noise(scene):.2%} | {time.perf_counter() - start:.0f} |"
        )
        print(lines[-1], flush=True)
        peak = float(exact.max())
        picture = np.concatenate([image, exact, 0.5 * peak + 10 * (image - exact)], axis=1)
        write_png(arguments.output / f"{name}_exact_difference_times_10.png", picture, peak=peak)
    lines.append(f"\nLimit at the default accuracy {LIMIT:.0%}; the worst of these {worst:.2%}.")
    (arguments.output / "crop_accuracy.md").write_text("\n".join(lines) + "\n")
    return int(worst > LIMIT)


def cropped(lens: tuple[int, int]) -> tuple[Any, PlenopticCamera]:
    """Return the scene with a film that is cropped to some lenses, and its camera."""
    scene = load_scene("still_life")
    film = mi.traverse(scene.sensors()[0])
    film["film.crop_size"] = (LENSES * PIXELS,) * 2
    film["film.crop_offset"] = tuple(PIXELS * first for first in lens)
    film.update()
    return scene, PlenopticCamera.from_sensor(scene.sensors()[0])


def both(scene: Any, camera: PlenopticCamera) -> tuple[np.ndarray, np.ndarray, int]:
    """Sum the same radiators as captures do and exactly; return their number, too."""
    sight = Sight.of(scene, scene.sensors()[0], scene.integrator(), None)
    pairs = sample_pairs(PER_LENS, np.zeros(4))
    found = find_radiators(sight, camera, pairs, spp=SPP, seed=0, occlusion=True)
    weights = found.radiance[:, 0] / found.fraction
    images = [
        CaptureOperator(
            camera,
            found.positions,
            wavelength=WAVELENGTH,
            pupil_weights=found.pupil_weights,
            **options,
        ).forward(weights)
        for options in ({"method": "bank", "accuracy": DEFAULT_ACCURACY}, {"accuracy": 0.0})
    ]
    return images[0], images[1], len(found.positions)


def noise(scene: Any) -> float:
    """Return the standard deviation of captures over their root mean square."""
    first, second = (render_capture(scene, model="wave", seed=seed, spp=SPP, method="bank") for seed in (0, 1))
    a, b = np.asarray(first.image), np.asarray(second.image)
    return float(np.linalg.norm(a - b) / np.sqrt(2) / np.linalg.norm(a))


if __name__ == "__main__":
    sys.exit(main())
