"""Take one scene in white light through a thin lens, a double Gauss and a singlet by rays, side by side.

The scene is the resolution chart; the lenses have the focal length, aperture and focus of the paper's camera, opened
to the aperture that is given. Rays have the ways of their own colours. The pictures are refocused to the plane in
focus by a thin lens in the place of the exit pupil, under which all light of a lens goes into its bin. Printed is by
how much blue lies beside red at the corner of the field, in microlenses, by chief rays.

    python tools/lens_pictures.py --resolution 2048 --spp 48
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np

from mitsuba_plenoptic import PlenopticCamera, load_scene, reconstruct, render_capture, with_camera
from mitsuba_plenoptic.optics.lens_figures import lateral_colour
from mitsuba_plenoptic.optics.spectrum import RGB_WAVELENGTHS
from mitsuba_plenoptic.report.drawing import Canvas, show

DISTANCE = 240.0

LENSES: dict[str, dict[str, str]] = {
    "thin lens": {},
    "double Gauss": {"main_lens": "double_gauss"},
    "singlet": {"main_lens": "singlet"},
}


def main() -> None:
    """Render, refocus and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=2048, help="columns of the detector")
    parser.add_argument("--spp", type=int, default=48, help="samples per pixel")
    parser.add_argument("--aperture", type=float, default=5.0, help="radius of the entrance pupil in millimetres")
    parser.add_argument("--scene", default="chart", help="a built-in scene or a file with a plenoptic sensor")
    parser.add_argument("--output", type=Path, default=Path("out/lens_pictures"), help="folder for the picture")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    scene = load_scene(arguments.scene, variant="llvm_ad_rgb")
    size = 3.4
    canvas = Canvas(0.2 + (size + 0.2) * len(LENSES), 0.3 + 2 * (size + 0.35))
    for column, (name, lens) in enumerate(LENSES.items()):
        camera = PlenopticCamera(
            **lens,
            focal_length=80,
            aperture_radius=arguments.aperture,
            focus_distance=DISTANCE,
            resolution=(arguments.resolution, arguments.resolution),
        )
        capture = render_capture(with_camera(scene, camera), spp=arguments.spp)
        b = camera.pupil_distance
        like = PlenopticCamera(
            focal_length=1 / (1 / DISTANCE + 1 / b),
            aperture_radius=camera.pupil_radius,
            mla_distance=b,
            resolution=camera.resolution,
        )
        image = np.clip(np.nan_to_num(reconstruct(capture.image, DISTANCE, camera=like).image), 0, 1)
        left = 0.2 + (size + 0.2) * column
        show(canvas.axes(left, 0.3, size, size), image, f"{name}, f/{camera.f_number:.3g}", peak=1.0)
        show(canvas.axes(left, 0.65 + size, size, size), image[12:52, 44:84], "in focus, nearer", peak=1.0)
        corner = math.hypot(camera.detector_width, camera.detector_height) / 2
        shift = 0.0 if not lens else lateral_colour(camera, corner, (RGB_WAVELENGTHS[0], RGB_WAVELENGTHS[2]))
        print(
            f"{name}: blue lies {shift / camera.mla_pitch:+.3f} microlenses beyond red at {corner:.3g} mm from the axis"
        )
    canvas.save(arguments.output / "lenses.png")
    print(arguments.output / "lenses.png")


if __name__ == "__main__":
    main()
