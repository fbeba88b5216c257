"""Microlens lattices on the whole detector: where the micro-images are, how bright, and how well they refocus.

Renders the white scene and the letters at full size with each lattice by rays. Prints how far the micro-images'
centroids are from the model, in pixels; the mean of the white capture over its closed form; how far the grid estimated
from the white capture alone is from the model; and refocused letters against Mitsuba's thin lens.

    python tools/lattice_accuracy.py --output out [--spp 64]
"""

from __future__ import annotations

import accuracy
import numpy as np
from scipy.spatial import cKDTree

from mitsuba_plenoptic import Capture, design, load_scene, reconstruct, render_capture
from mitsuba_plenoptic.lightfield import estimate_lens_grid
from mitsuba_plenoptic.lightfield.grid import micro_image_centres
from mitsuba_plenoptic.report.experiment import agreement, thin_lens_image
from mitsuba_plenoptic.report.output_files import write_png

LATTICES = {
    "square": {},
    "square, turned by 0.3 degrees, moved": {"mla_rotation": "0.3", "mla_offset": "0.021, -0.008"},
    "square, turned by 13 degrees, discs of 0.8": {"mla_rotation": "13", "mla_aperture": "circle", "mla_fill": "0.8"},
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
    "rectangular, pitches of 0.064 and 0.06": {"mla_pitch": "0.064, 0.06"},
    "hexagonal, stretched to pitches of 0.064 and 0.06, turned by 0.3 degrees": {
        "mla_lattice": "hexagonal",
        "mla_pitch": "0.064, 0.06",
        "mla_rotation": "0.3",
    },
}
DISTANCES = (210.0, 240.0, 280.0)
COLUMNS = {
    "lattice": "{lattice}",
    "lenses": "{lenses}",
    "centres, largest error (px)": "{largest:.3f}",
    "RMS (px)": "{rms:.3f}",
    "white mean / closed form": "{white_mean:.4f}",
    "estimated grid, RMS (px)": "{estimated:.4f}",
    "refocused at 210, 240, 280 mm (dB)": "{psnr_db[0]:.1f}, {psnr_db[1]:.1f}, {psnr_db[2]:.1f}",
}

# Half the side of the square about a centre over which its centroid is taken; the micro-images are 21.4 pixels wide.
_HALF = 13


def main() -> None:
    """Render, measure, and write the table as Markdown and JSON with pictures of the corners beside it."""
    arguments = accuracy.start(accuracy.options("lattice_accuracy", __doc__, spp=64, reference_spp=1024))
    rows: list[accuracy.Row] = []
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
        if not references:
            references = [thin_lens_image(scene, capture.camera, g, arguments.reference_spp) for g in DISTANCES]
        images = [result.image.astype(np.float64) for result in reconstruct(capture, DISTANCES)]
        row = {
            "lattice": name,
            "lenses": len(centres),
            "largest": error.max(),
            "rms": np.sqrt(np.mean(error**2)),
            "white_mean": mean(white) / design.white_mean(white.camera),
            "estimated": np.sqrt(np.mean(estimated**2)),
            "psnr_db": [psnr for psnr, _ in agreement(images, references)[1]],
        }
        rows.append(row)
        print(accuracy.markdown(COLUMNS, rows).splitlines()[-1], flush=True)
        write_png(arguments.output / f"white_{number}.png", white.image[-256:, -256:], peak=1.0)
        write_png(arguments.output / f"letters_{number}.png", np.concatenate(images, axis=1), peak=1.0)
    accuracy.finish(arguments, rows, accuracy.markdown(COLUMNS, rows))


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
