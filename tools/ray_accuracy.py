"""Ray reconstructions against Mitsuba's own thin lens: the table quoted in the README.

Renders each scene once with the plenoptic sensor, refocuses it by both ray versions, and compares with the image
of a `thinlens` sensor of one pixel a bin. One scale factor per scene and version serves all distances.

    python tools/ray_accuracy.py --output out [--spp 64] [--reference-spp 4096]
"""

from __future__ import annotations

import accuracy
import numpy as np

from mitsuba_plenoptic import load_scene, reconstruct, render_capture
from mitsuba_plenoptic.report.reference import best_shift, thin_lens_image

SCENES = {"letters": (210.0, 240.0, 280.0), "still_life": (215.0, 240.0, 280.0)}
COLUMNS = {
    "scene": "{scene}",
    "g (mm)": "{distance:g}",
    "version": "{footprint}",
    "PSNR (dB)": "{psnr_db:.1f}",
    "correlation": "{correlation:.4f}",
    "scale": "{scale:.3f}",
    "best shift": "{best_shift}",
}


def main() -> None:
    """Render, refocus, compare, and write the table as Markdown and JSON with the pictures beside it."""
    arguments = accuracy.start(accuracy.options("ray_accuracy", __doc__, spp=64, reference_spp=4096))
    rows = []
    for name, distances in SCENES.items():
        scene = load_scene(name)
        capture = render_capture(scene, spp=arguments.spp)
        references = [thin_lens_image(scene, capture.camera, g, arguments.reference_spp) for g in distances]
        for footprint in ("point", "lens"):
            images = [r.image.astype(np.float64) for r in reconstruct(capture, distances, footprint=footprint)]
            scale, found = accuracy.scores(images, references)
            for g, image, reference, score in zip(distances, images, references, found, strict=True):
                shift = best_shift(image, reference)
                rows.append({"scene": name, "distance": g, "footprint": footprint, **score, "best_shift": shift})
                accuracy.write_comparison(arguments.output / f"{name}_{g:g}_{footprint}.png", scale * image, reference)
    accuracy.finish(arguments, rows, accuracy.markdown(COLUMNS, rows))


if __name__ == "__main__":
    main()
