"""Ray reconstructions against Mitsuba's own thin lens: the table quoted in the README.

Renders each scene once with the plenoptic sensor, refocuses it by both ray versions, and compares with the image
of a `thinlens` sensor of one pixel a bin. One scale factor per scene and version serves all distances.

    python tools/ray_accuracy.py --output out [--spp 64] [--resolution 4096]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import load_scene, reconstruct, render_capture
from mitsuba_plenoptic.report.images import write_png
from mitsuba_plenoptic.report.reference import agreement, best_shift, thin_lens_image

SCENES = {"letters": (210.0, 240.0, 280.0), "still_life": (215.0, 240.0, 280.0)}


def main() -> None:
    """Render, refocus, compare, and write the table as Markdown and JSON with the pictures beside it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out/ray_accuracy"))
    parser.add_argument("--spp", type=int, default=64, help="samples per detector pixel")
    parser.add_argument("--referee-spp", type=int, default=4096, help="samples per pixel of the thin lens")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    mi.set_variant("llvm_ad_mono")

    rows = []
    for name, distances in SCENES.items():
        scene = load_scene(name)
        capture = render_capture(scene, spp=arguments.spp)
        references = [thin_lens_image(scene, capture.camera, g, arguments.referee_spp) for g in distances]
        for footprint in ("point", "lens"):
            images = [r.image.astype(np.float64) for r in reconstruct(capture, distances, footprint=footprint)]
            scale, scores = agreement(images, references)
            for g, image, reference, (psnr, correlation) in zip(distances, images, references, scores, strict=True):
                rows.append(
                    {
                        "scene": name,
                        "distance": g,
                        "footprint": footprint,
                        "psnr_db": round(psnr, 2),
                        "correlation": round(correlation, 5),
                        "scale": round(scale, 4),
                        "best_shift": best_shift(image, reference),
                    }
                )
                tile = np.concatenate(
                    [scale * image, reference, 0.5 * reference.max() + (scale * image - reference)], 1
                )
                write_png(arguments.output / f"{name}_{g:g}_{footprint}.png", tile, peak=float(reference.max()))

    (arguments.output / "ray_accuracy.json").write_text(json.dumps(rows, indent=1))
    lines = [
        "| scene | g (mm) | version | PSNR (dB) | correlation | scale | best shift |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r['scene']} | {r['distance']:g} | {r['footprint']} | {r['psnr_db']:.1f} | {r['correlation']:.4f} "
        f"| {r['scale']:.3f} | {r['best_shift']} |"
        for r in rows
    ]
    table = "\n".join(lines) + "\n"
    (arguments.output / "ray_accuracy.md").write_text(table)
    print(table)


if __name__ == "__main__":
    main()
