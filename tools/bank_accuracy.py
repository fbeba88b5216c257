"""The kernel bank against exact sums of point spreads, over the blur on the microlens array.

Walls of 4 x 4 lenses, an even grid of points in every lens, on the axis and off it, and single points: relative L2 over
the detector of method "bank" against method "patch" with accuracy 0, the energy of the walls, and how many kernels the
bank has. Beyond 15 lenses of blur, where patches of accuracy 0 take minutes, they are of accuracy 0.001, whose own
error up to there is below 0.1 %. Writes a table, and the difference for one wall as a picture; exits with 1 if a wall
is beyond its limit.

    python tools/bank_accuracy.py --output out/bank [--accuracy 0.01] [--points 8] [--cameras square raytrix]
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.capture.accuracy import DEFAULT_ACCURACY
from mitsuba_plenoptic.capture.bank import LensBank, near_weight
from mitsuba_plenoptic.capture.operator import CaptureOperator
from mitsuba_plenoptic.optics.main_lens import main_lens
from mitsuba_plenoptic.report.images import write_png

WAVELENGTH = 633.0
CAMERAS = {
    "square": PlenopticCamera(),
    "hexagonal": PlenopticCamera(mla_lattice="hexagonal", mla_rotation=7.0),
    "discs with gaps": PlenopticCamera(mla_lattice="hexagonal", mla_aperture="circle", mla_fill=0.9),
    "focused": PlenopticCamera(mla_distance=112.0, detector_distance=0.6),
    "raytrix": PlenopticCamera.preset("raytrix"),
}
BLURS = (0.0, 2.0, 4.0, 5.0, 6.0, 7.0, 9.0, 13.5, 20.0, 40.0)
LENSES = 4
OFF_AXIS = 20
"""Lenses from the axis, along both rows and columns, of the walls off it."""

SMALL = 10.0
"""Lenses of blur up to which all points of a wall are summed at once."""

WIDE, ALMOST_EXACT = 15.0, 0.001
"""Lenses of blur from which on the reference is not of accuracy 0, and its accuracy there."""

LIMIT = 0.01
"""Relative L2 of walls at the default accuracy."""


def main() -> int:
    """Compare, and write table and picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out/bank"))
    parser.add_argument("--accuracy", type=float, default=DEFAULT_ACCURACY)
    parser.add_argument("--points", type=int, default=8, help="points of a wall across a lens")
    parser.add_argument("--cameras", nargs="+", default=list(CAMERAS), choices=list(CAMERAS))
    parser.add_argument("--blurs", nargs="+", type=float, default=list(BLURS), help="in lenses")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    mi.set_variant("llvm_ad_mono")
    lines = [
        "| camera | blur (lenses) | kernels | wall | off axis | energy | off axis | points | time (s) |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    worst = (0.0, np.zeros((1, 1)), np.ones((1, 1)))
    for name in arguments.cameras:
        for blur in sorted({sign * size for size in arguments.blurs for sign in (-1, 1)}):
            distance = distance_of(CAMERAS[name], blur)
            if distance is None:
                continue
            row, start = [], time.perf_counter()
            for lenses in (0, OFF_AXIS):
                points = wall(CAMERAS[name], distance, lenses, arguments.points)
                camera = around(CAMERAS[name], points, abs(blur))
                image, exact = both(camera, points, arguments.accuracy, abs(blur))
                row.append((error(image, exact), image.sum(dtype=float) / exact.sum(dtype=float)))
                worst = max(worst, (row[-1][0], image, exact), key=lambda some: some[0])
            vergence = main_lens(camera).vergence(distance)
            kernels = 0
            if near_weight(camera, vergence, arguments.accuracy) < 1:
                kernels = LensBank.learn(camera, WAVELENGTH, arguments.accuracy, (vergence, vergence)).rank
            single = [
                error(*both(camera, points[[place]], arguments.accuracy, abs(blur))) for place in (0, len(points) // 2)
            ]
            lines.append(
                f"| {name} | {blur:g} | {kernels} | {row[0][0]:.2%} | {row[1][0]:.2%} | {row[0][1]:.4f} "
                f"| {row[1][1]:.4f} | {np.mean(single):.1%} | {time.perf_counter() - start:.0f} |"
            )
            print(lines[-1], flush=True)
    lines.append(f"\nLimit of walls at the default accuracy {LIMIT:.0%}; the worst of these {worst[0]:.2%}.")
    (arguments.output / "bank_accuracy.md").write_text("\n".join(lines) + "\n")
    peak = float(worst[2].max())
    picture = np.concatenate([worst[1], worst[2], 0.5 * peak + 10 * (worst[1] - worst[2])], axis=1)
    write_png(arguments.output / "worst_wall_exact_difference_times_10.png", picture, peak=peak)
    return int(worst[0] > LIMIT)


def distance_of(camera: PlenopticCamera, blur: float) -> float | None:
    """Return the distance at which points are blurred over so many lenses, None if there is none."""
    lens = main_lens(camera)
    defocus = blur * max(camera.mla_pitches) / (2 * lens.pupil_radius)
    reciprocal = lens.vergence(math.inf) - (1 - defocus) / lens.pupil_distance
    return 1 / reciprocal if reciprocal > 1e-9 else None


def wall(camera: PlenopticCamera, distance: float, lenses: int, per_lens: int) -> np.ndarray:
    """Return the points of a wall whose image covers some lenses, as far from the axis."""
    steps = (np.arange(LENSES * per_lens) + 0.5) / per_lens - LENSES / 2 + lenses
    place = np.array(np.meshgrid(steps, steps)).reshape(2, -1).T * camera.mla_pitch
    return np.column_stack([place * -distance / camera.mla_distance, np.full(len(place), distance)])


def around(camera: PlenopticCamera, points: np.ndarray, blur: float) -> PlenopticCamera:
    """Return the camera with a detector that is cropped to where their light goes."""
    image = -points[:, :2] * camera.mla_distance / points[:, 2:]
    centre = image.mean(0) * (1 + camera.detector_distance / camera.mla_distance) / camera.pixel_size
    half = math.ceil((blur / 2 + LENSES / 2 + 5) * camera.mla_pitch / camera.pixel_size)
    size = 2 * (math.ceil(np.abs(centre).max()) + half)
    return camera.replace(
        detector_width=size * camera.pixel_size,
        resolution=(size, size),
        crop_offset=tuple(int(place) + size // 2 - half for place in centre),
        crop_size=(2 * half, 2 * half),
    )


def both(camera: PlenopticCamera, points: np.ndarray, accuracy: float, blur: float) -> tuple[np.ndarray, np.ndarray]:
    """Sum the point spreads by the bank and exactly."""
    ones = np.ones(len(points))
    image = CaptureOperator(camera, points, wavelength=WAVELENGTH, method="bank", accuracy=accuracy).forward(ones)
    best = ALMOST_EXACT if blur > WIDE else 0
    # Few points at a time where patches are large: those of many must be small. Few have softer edges of the pupil,
    # and lose half a percent of the light.
    groups = np.array_split(points, -(-len(points) // 64)) if blur > SMALL else [points]
    exact = sum(
        CaptureOperator(camera, group, wavelength=WAVELENGTH, accuracy=best).forward(np.ones(len(group)))
        for group in groups
    )
    return image, np.asarray(exact)


def error(image: np.ndarray, exact: np.ndarray) -> float:
    """Return the relative difference in the L2 norm."""
    return float(np.linalg.norm(image - exact) / np.linalg.norm(exact))


if __name__ == "__main__":
    sys.exit(main())
