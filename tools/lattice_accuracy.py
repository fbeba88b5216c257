"""Microlens lattices on the whole detector: where the micro-images are, how bright, and how well they refocus.

Renders the white scene and the letters at full size with each lattice by rays. Prints how far the micro-images'
centroids are from the model, in pixels; the mean of the white capture over its closed form; how far the grid estimated
from the white capture alone is from the model; and refocused letters against Mitsuba's thin lens.

    python tools/lattice_accuracy.py --output out [--spp 64]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from mitsuba_plenoptic import Capture, design, load_scene, reconstruct, render_capture
from mitsuba_plenoptic.lightfield import estimate_lens_grid
from mitsuba_plenoptic.lightfield.grid import micro_image_centres
from mitsuba_plenoptic.report.images import write_png
from mitsuba_plenoptic.report.reference import agreement, thin_lens_image

LATTICES = {
    "square": {},
    "square, turned by 0.3 degrees, moved": {"mla_rotation": "0.3", "mla_offset": "0.021, -0.008"},
    "square, turned by 13 degrees, discs of 0.8": {
        "mla_rotation": "13",
        "mla_aperture": "circle",
        "mla_fill": "0.8",
    },
    "hexagonal": {"mla_lattice": "hexagonal"},
    "hexagonal, turned by 0.3 degrees, discs": {
        "mla_lattice": "hexagonal",
        "mla_rotation": "0.3",
        "mla_aperture": "circle",
    },
    "hexagonal, three focal lengths": {
        "mla_lattice": "hexagonal",
        "mla_focal_length": "0.49, 0.512, 0.535",
        "detector_distance": "0.512",
    },
}
DISTANCES = (210.0, 240.0, 280.0)

# Half the side of the square about a centre over which its centroid is taken; the micro-images are 21.4 pixels wide.
_HALF = 13


def main() -> None:
    """Render, measure, and write the table as Markdown with pictures of the corners beside it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out/lattice_accuracy"))
    parser.add_argument("--spp", type=int, default=64, help="samples per detector pixel")
    parser.add_argument("--referee-spp", type=int, default=1024, help="samples per pixel of the thin lens")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    mi.set_variant("llvm_ad_mono")

    lines = [
        "| lattice | lenses | centres, largest error (px) | RMS (px) | white mean / closed form "
        "| estimated grid, RMS (px) | refocused at 210, 240, 280 mm (dB) |",
        "|---|---|---|---|---|---|---|",
    ]
    references: list[np.ndarray] = []
    for number, (name, parameters) in enumerate(LATTICES.items()):
        white = render_capture(load_scene("white", parameters=parameters), spp=arguments.spp)
        centres = micro_image_centres(white.camera, 0)
        size = np.array(white.image.shape[::-1])
        centres = centres[((centres > _HALF + 1) & (centres < size - _HALF - 1)).all(1)]
        error = np.hypot(*(centroids(white.image, centres) - centres).T)
        grid = estimate_lens_grid(white.image).centres().reshape(-1, 2)
        estimated = cKDTree(grid).query(centres)[0]

        scene = load_scene("letters", parameters=parameters)
        capture = render_capture(scene, spp=arguments.spp)
        references = references or [thin_lens_image(scene, capture.camera, g, arguments.referee_spp) for g in DISTANCES]
        images = [result.image.astype(np.float64) for result in reconstruct(capture, DISTANCES)]
        _, scores = agreement(images, references)

        lines.append(
            f"| {name} | {len(centres)} | {error.max():.3f} | {np.sqrt(np.mean(error**2)):.3f} "
            f"| {mean(white) / design.white_mean(white.camera):.4f} | {np.sqrt(np.mean(estimated**2)):.4f} "
            f"| {', '.join(f'{psnr:.1f}' for psnr, _ in scores)} |"
        )
        print(lines[-1], flush=True)
        write_png(arguments.output / f"white_{number}.png", white.image[-256:, -256:], peak=1.0)
        write_png(arguments.output / f"letters_{number}.png", np.concatenate(images, axis=1), peak=1.0)
    table = "\n".join(lines) + "\n"
    (arguments.output / "lattice_accuracy.md").write_text(table)
    print(table)


def centroids(image: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Centroid of the image in a square about each centre."""
    base = np.floor(centres).astype(int)
    window = np.arange(-_HALF, _HALF + 1)
    x, y = (base[:, axis, None] + window for axis in (0, 1))
    patch = image[y[:, :, None], x[:, None, :]].astype(np.float64)
    moments = [(patch.sum(1) * (x + 0.5)).sum(1), (patch.sum(2) * (y + 0.5)).sum(1)]
    return np.stack(moments, axis=-1) / patch.sum((1, 2))[:, None]


def mean(white: Capture) -> float:
    """Mean under a window that lets the pattern of the lenses average out."""
    down, across = (np.hanning(n + 2)[1:-1] for n in white.image.shape)
    return float(down @ white.image.astype(np.float64) @ across / (down.sum() * across.sum()))


if __name__ == "__main__":
    main()
