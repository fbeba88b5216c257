"""Measure the Fourier microscope's deconvolution: its response against exact spreads, and a known volume of beads.

Beads, points of random powers at random places that are not the middles of bins, lie in some of the planes of a volume.
Their capture is the sum of exact point spreads, each propagated on its own (`full_field`), where the response knows
one spread a plane and moves it. The volume of all planes is deconvolved from it, and the same capture with 2000 photons
in the brightest pixel, stopped by the method itself. Every figure is printed with its limit; exits with 1 if one is
missed. Writes ``fourier_microscope_accuracy.md``, ``.json`` and a picture of the views beside the volume's overview.

    python tools/fourier_microscope_accuracy.py
    python tools/fourier_microscope_accuracy.py --planes 32 --beads 24 --oversample 2
"""

from __future__ import annotations

import time

import numpy as np
from accuracy import Row, finish, markdown, options, start
from verdict import Verdict

from mitsuba_plenoptic import Capture, CaptureOperator, Objective, PlenopticCamera, reconstruct
from mitsuba_plenoptic.lightfield import decode, view_mosaic
from mitsuba_plenoptic.operator.units import radiance_weight
from mitsuba_plenoptic.reconstruction import Reconstruction, Volume
from mitsuba_plenoptic.reconstruction.deconvolution.fourier import FourierResponse
from mitsuba_plenoptic.report.output_files import write_png
from mitsuba_plenoptic.report.volumes import write_volume_overview

WAVELENGTH, PHOTONS = 550.0, 2000.0
DEEPEST = 0.045
"""Depth in millimetres of the outermost planes, within the depth of field of a lens."""

NEAR = 8
"""Bins around a bead whose light counts as its own."""

SPREAD, PLACE, POWER, ELSEWHERE = 0.01, 0.1, 0.03, 0.03
NOISY_PLACE, NOISY_POWER = 0.1, 0.03
"""Limits with noise."""

COLUMNS = {
    "depth, um": "{depth:.3g}",
    "place, bins": "{place:.3f}",
    "power": "{power:.3f}",
    "elsewhere in its plane": "{elsewhere:.3f}",
    "place with noise": "{noisy_place:.3f}",
    "power with noise": "{noisy_power:.3f}",
}


def microscope() -> PlenopticCamera:
    """Return a 20x/0.5 microscope with 5 lenses across the image of its stop and 50 pixels across a view."""
    return PlenopticCamera(
        main_lens=Objective(20, 0.5, arrangement="fourier", fourier_focal_length=50),
        mla_pitch=0.5,
        mla_focal_length=20.0,
        mla_offset=(0.25, 0.25),
        detector_width=3.0,
        resolution=(300, 300),
    )


def weight(camera: PlenopticCamera, oversample: int) -> float:
    """Return the light of a bin of radiance 1."""
    return radiance_weight(
        camera, (camera.pixel_size / oversample * camera.mla_distance / camera.detector_distance) ** 2
    )


def worst_spread(camera: PlenopticCamera, depth: float, oversample: int) -> float:
    """Return the largest difference of the response to a bin from its exact spreads, at three places of the field."""
    response = FourierResponse(camera, [depth], wavelength=WAVELENGTH, oversample=oversample)
    rows, columns = response.shapes[0]
    size, inner, found = camera.bin_size(0) / oversample, (np.arange(3) + 0.5) / 3, []
    for row, column in ((rows // 2, columns // 2), (1, columns // 3), (rows - 2, 1)):
        values = np.zeros((rows, columns), np.float32)
        values[row, column] = 1
        x, y = np.meshgrid((column - columns / 2 + inner) * size, (row - rows / 2 + inner) * size)
        points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, depth)])
        exact = CaptureOperator(camera, points, wavelength=WAVELENGTH, method="full_field").forward(
            np.full(len(points), weight(camera, oversample) / len(points))
        )
        found.append(float(np.linalg.norm(response.forward([values]) - exact) / np.linalg.norm(exact)))
    return max(found)


def seen(plane: Reconstruction, bead: np.ndarray, power: float, light_of_bin: float) -> tuple[float, float, float]:
    """Return the error of a bead's place in bins, its power over the true one, and what else its plane holds of it."""
    light = np.nan_to_num(plane.image) * light_of_bin / power
    # Pictures have +x to the left and +y up.
    y, x = ((size / 2 - np.arange(size) - 0.5) * plane.bin_size for size in light.shape)
    across, down = np.abs(x - bead[0]) < NEAR * plane.bin_size, np.abs(y - bead[1]) < NEAR * plane.bin_size
    mine = light * (across & down[:, None])
    total = float(mine.sum())
    place = np.array([(mine.sum(0) @ x) / total, (mine.sum(1) @ y) / total]) - bead[:2]
    return float(np.hypot(*place)) / plane.bin_size, total, float(light.sum()) - total


def main() -> int:
    """Measure, print and write."""
    parser = options("fourier_microscope_accuracy", __doc__)
    parser.add_argument("--planes", type=int, default=9, help="planes of the volume")
    parser.add_argument("--beads", type=int, default=5, help="beads, each in a plane of its own")
    parser.add_argument("--oversample", type=int, default=2, help="bins along a pixel")
    parser.add_argument("--iterations", type=int, default=60, help="steps without noise")
    given = start(parser)
    camera, random, verdict = microscope(), np.random.default_rng(3), Verdict()
    depths = np.linspace(-DEEPEST, DEEPEST, given.planes)
    half = 0.35 * camera.bin_size(0) * camera.bin_count[0]
    which = np.sort(random.choice(given.planes, given.beads, replace=False))
    beads = np.column_stack([random.uniform(-half, half, (given.beads, 2)), depths[which]])
    powers = random.uniform(0.5, 1.5, given.beads)
    for depth in (0.0, DEEPEST):
        what = f"response {1e3 * depth:.3g} um from the native plane against exact spreads"
        verdict.judge(what, worst_spread(camera, depth, given.oversample), SPREAD)
    image = CaptureOperator(camera, beads, wavelength=WAVELENGTH, method="full_field").forward(powers)
    capture = Capture(np.maximum(image, 0), camera, WAVELENGTH, "wave", {})
    photons = PHOTONS / float(capture.image.max())
    noisy = Capture(
        (random.poisson(capture.image * photons) / photons).astype(np.float32), camera, WAVELENGTH, "wave", {}
    )
    began = time.perf_counter()
    found = reconstruct(
        capture,
        depths.tolist(),
        method="deconvolved",
        volume=True,
        oversample=given.oversample,
        iterations=given.iterations,
    )
    seconds = time.perf_counter() - began
    rough = reconstruct(
        noisy, depths.tolist(), method="deconvolved", volume=True, oversample=given.oversample, photons=photons
    )
    rows: list[Row] = []
    light = weight(camera, given.oversample)
    for number, bead, power in zip(which, beads, powers, strict=True):
        place, whole, elsewhere = seen(found[number], bead, power, light)
        noisy_place, noisy_power, _ = seen(rough[number], bead, power, light)
        row = {"depth": 1e3 * float(bead[2]), "place": place, "power": whole, "elsewhere": elsewhere}
        rows.append(row | {"noisy_place": noisy_place, "noisy_power": noisy_power})
        at = f"bead at {row['depth']:.3g} um: "
        verdict.judge(at + "place, bins", place, PLACE)
        verdict.judge(at + "power", abs(whole - 1), POWER)
        verdict.judge(at + "light elsewhere in its plane", elsewhere, ELSEWHERE)
        verdict.judge(at + "place with noise, bins", noisy_place, NOISY_PLACE)
        verdict.judge(at + "power with noise", abs(noisy_power - 1), NOISY_POWER)
    mosaic = view_mosaic(decode(capture))
    write_png(given.output / "views.png", mosaic, peak=float(np.quantile(mosaic, 0.999)))
    write_volume_overview(given.output / "volume.png", Volume.of(found))
    text = (
        f"{given.planes} planes of {found[0].image.shape[1]} x {found[0].image.shape[0]} bins, {given.iterations} "
        f"steps in {seconds:.1f} s with the point spreads; with noise stopped after {rough[0].facts['iterations']}.\n"
    )
    finish(given, {"beads": rows, "seconds": seconds}, text, markdown(COLUMNS, rows))
    return int(not verdict.kept)


if __name__ == "__main__":
    raise SystemExit(main())
