"""Ray reconstructions against Mitsuba's own thin lens: the table quoted in the README.

Renders each scene once with the plenoptic sensor, refocuses it by both ray versions, and compares with the image
of a `thinlens` sensor of one pixel a bin. One scale factor per scene and version serves all distances. Each figure must
reach what the first version reached, to the digits that are told; exits with 1 if one does not.

    python tools/ray_accuracy.py --output out [--spp 64] [--reference-spp 4096]
"""

from __future__ import annotations

import sys

import accuracy
import numpy as np

from mitsuba_plenoptic import load_scene, reconstruct, render_capture
from mitsuba_plenoptic.report.experiment import best_shift, thin_lens_image

SCENES = {"letters": (210.0, 240.0, 280.0), "still_life": (215.0, 240.0, 280.0)}
LIMITS = {
    ("letters", "point"): {"correlation": (0.998, 1.000, 0.991), "psnr_db": (39.0, 49.7, 32.1)},
    ("letters", "lens"): {"correlation": (0.998, 1.000, 0.998), "psnr_db": (39.0, 48.9, 38.7)},
    ("still_life", "point"): {"psnr_db": (44.4, 43.1, 32.8)},
    ("still_life", "lens"): {"psnr_db": (45.0, 42.5, 36.5)},
}
"""Least figures at the distances, to three and to one decimals."""

DECIMALS = {"correlation": 3, "psnr_db": 1}
COLUMNS = {
    "scene": "{scene}",
    "g (mm)": "{distance:g}",
    "version": "{footprint}",
    "PSNR (dB)": "{psnr_db:.1f}",
    "correlation": "{correlation:.4f}",
    "scale": "{scale:.3f}",
    "best shift": "{best_shift}",
    "at least": "{limit}",
    "verdict": "{verdict}",
}


def main() -> int:
    """Render, refocus, compare, and write table and pictures; 1 if a figure is below its limit."""
    arguments = accuracy.start(accuracy.options("ray_accuracy", __doc__, spp=64, reference_spp=4096))
    rows = []
    for name, distances in SCENES.items():
        scene = load_scene(name)
        capture = render_capture(scene, spp=arguments.spp)
        references = [thin_lens_image(scene, capture.camera, g, arguments.reference_spp) for g in distances]
        for footprint in ("point", "lens"):
            images = [r.image.astype(np.float64) for r in reconstruct(capture, distances, footprint=footprint)]
            scale, found = accuracy.scores(images, references)
            for place, (g, image, reference, score) in enumerate(
                zip(distances, images, references, found, strict=True)
            ):
                row = {"scene": name, "distance": g, "footprint": footprint, **score}
                row["best_shift"] = best_shift(image, reference)
                least = {figure: limits[place] for figure, limits in LIMITS[name, footprint].items()}
                row["limit"] = ", ".join(f"{value:.{DECIMALS[figure]}f}" for figure, value in least.items())
                kept = all(round(score[figure], DECIMALS[figure]) >= value for figure, value in least.items())
                rows.append(row | {"verdict": "kept" if kept else "BROKEN"})
                accuracy.write_comparison(arguments.output / f"{name}_{g:g}_{footprint}.png", scale * image, reference)
    accuracy.finish(arguments, rows, accuracy.markdown(COLUMNS, rows))
    return int(any(row["verdict"] == "BROKEN" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
