"""The kernel bank behind real main lenses: against exact sums of point spreads, and a scene against rays.

Walls of 4 x 4 lenses, an even grid of points in every lens, on the axis and off it: relative L2 over the detector of
method "bank" against method "patch" with accuracy 0, and energy. The still life, small, by rays and by the bank: its
energy, and contrast (standard deviation over mean) of its refocused images. Each figure stands beside its limit; the
exit status is 1 if one is beyond it. Where a lens's aberrations leave too little blur, exact spreads serve, too, and
differ by nothing: how much of a wall's light the bank records is told.

    python tools/lens_bank_accuracy.py                                     (about half an hour on two quiet cores)
    python tools/lens_bank_accuracy.py --only walls --lenses double_gauss --blurs 8
    python tools/lens_bank_accuracy.py --only times                        (full size, double Gauss and thin lens)
"""

from __future__ import annotations

import math
import sys
import time
from typing import Any

import mitsuba as mi
import numpy as np
from accuracy import finish, markdown, options, start
from bank_accuracy import error
from lens_waves import LENSES, WAVELENGTH, behind
from verdict import Verdict

from mitsuba_plenoptic import PlenopticCamera, load_scene, reconstruct, render_capture, with_camera
from mitsuba_plenoptic.capture.accuracy import DEFAULT_ACCURACY
from mitsuba_plenoptic.capture.bank import LensBank, local_camera, local_vergences, near_weight
from mitsuba_plenoptic.capture.operator import CaptureOperator
from mitsuba_plenoptic.optics.fitted_lens import lens_of_waves
from mitsuba_plenoptic.optics.lens_system import LensSystem
from mitsuba_plenoptic.optics.pupil_fit import Pupils
from mitsuba_plenoptic.report.images import write_png

BLURS = (-15.0, -8.0, 8.0, 15.0)
PLACES = ((0, 0), (40, 20), (58, -56))
"""Lenses from the axis of the middles of walls; the last is in the detector's corner."""

LATTICES = {"square": {}, "hexagonal": {"mla_lattice": "hexagonal", "mla_rotation": 7.0}}
LENSES_ACROSS = 4
GROUP = 64
"""Points that are summed exactly at once: patches of few are wider."""

DISTANCES = (215.0, 240.0, 280.0)
LIMITS = {"wall": 0.01, "wall energy": 0.01, "scene energy": 0.015, "contrast": 0.02, "times": 2.0}


def wall(camera: PlenopticCamera, blur: float, place: tuple[int, int], per_lens: int) -> np.ndarray:
    """Return the points of a wall whose image near the axis is blurred over so many lenses."""
    vergence = (1 - blur * max(camera.mla_pitches) / (2 * camera.pupil_radius)) / camera.pupil_distance
    pupils = Pupils.of(LensSystem.of(camera))
    nearness = (pupils.at_infinity - vergence) * pupils.magnification**2
    distance = 1 / nearness + pupils.entrance
    steps = (np.arange(LENSES_ACROSS * per_lens) + 0.5) / per_lens - LENSES_ACROSS / 2
    x, y = (values.ravel() for values in np.meshgrid(steps + place[0], steps + place[1]))
    images = np.stack([x, y], axis=1) * camera.mla_pitch
    about = np.column_stack([-1.05 * images * distance / camera.mla_distance, np.full(len(images), distance)])
    lens = lens_of_waves(camera, about, WAVELENGTH)
    return lens.points(images, np.full(len(images), nearness))


def around(camera: PlenopticCamera, blur: float, place: tuple[int, int]) -> PlenopticCamera:
    """Return the camera cropped to where the light of a wall goes."""
    half = math.ceil((0.6 * abs(blur) + LENSES_ACROSS / 2 + 4) * camera.mla_pitch / camera.pixel_size)
    centre = np.array(place) * camera.mla_pitch * (1 + camera.detector_distance / camera.pupil_distance)
    first = np.round((centre + camera.detector_width / 2) / camera.pixel_size).astype(int) - half
    first = np.clip(first, 0, np.array(camera.resolution) - 2 * half)
    return camera.replace(crop_offset=(int(first[0]), int(first[1])), crop_size=(2 * half, 2 * half))


def walls(arguments: Any, verdict: Verdict) -> list[dict[str, Any]]:
    """Compare walls, and keep the picture of the worst."""
    rows, worst = [], (0.0, np.zeros((1, 1)), np.zeros((1, 1)))
    for name in arguments.lenses:
        for lattice in arguments.lattices:
            whole = behind(name, LENSES[name], **LATTICES[lattice])
            for blur in arguments.blurs:
                for place in PLACES:
                    points, camera = wall(whole, blur, place, arguments.points), around(whole, blur, place)
                    began = time.perf_counter()
                    bank = CaptureOperator(camera, points, wavelength=WAVELENGTH, method="bank")
                    image = bank.forward(np.ones(len(points)))
                    seconds = time.perf_counter() - began
                    exact = np.zeros_like(image)
                    for group in np.array_split(points, -(-len(points) // GROUP)):
                        spreads = CaptureOperator(camera, group, wavelength=WAVELENGTH, accuracy=0)
                        exact += spreads.forward(np.ones(len(group)))
                    vergence = LensSystem.of(camera).vergence(points[0, 2])
                    row = {
                        "lens": name,
                        "lattice": lattice,
                        "blur": blur,
                        "place": str(place),
                        "recorded": 1 - float(near_weight(camera, np.array(vergence), DEFAULT_ACCURACY)),
                        "error": error(image, exact),
                        "energy": float(image.sum(dtype=float) / exact.sum(dtype=float)),
                        "seconds": seconds,
                    }
                    rows.append(row)
                    worst = max(worst, (row["error"], image, exact), key=lambda some: some[0])
                    what = f"{name}, {lattice}, blur {blur:g}, {place}, by the bank {row['recorded']:.0%}"
                    verdict.judge(f"{what}: relative L2", row["error"], LIMITS["wall"])
                    verdict.judge(f"{what}: energy", abs(row["energy"] - 1), LIMITS["wall energy"])
    peak = float(worst[2].max())
    picture = np.concatenate([worst[1], worst[2], 0.5 * peak + 10 * (worst[1] - worst[2])], axis=1)
    write_png(arguments.output / "worst_wall_exact_difference_times_10.png", picture, peak=peak)
    return rows


def scene(arguments: Any, verdict: Verdict) -> list[dict[str, Any]]:
    """Compare the still life by rays and by the bank."""
    rows = []
    for name in arguments.lenses:
        camera = behind(name, LENSES[name], resolution=(arguments.resolution,) * 2, **_width(arguments.resolution))
        seen = with_camera(load_scene("still_life"), camera)
        began = time.perf_counter()
        vergences = tuple(float(LensSystem.of(camera).vergence(distance)) for distance in DISTANCES)
        between = local_vergences(camera, (min(vergences), max(vergences)))
        LensBank.learn(local_camera(camera), WAVELENGTH, DEFAULT_ACCURACY, between)
        learning = time.perf_counter() - began
        rays = render_capture(seen, model="ray", spp=64)
        waves = render_capture(seen, model="wave", method="bank", wavelength=WAVELENGTH, spp=16)
        energy = float(waves.image.sum(dtype=float) / rays.image.sum(dtype=float))
        verdict.judge(f"{name}, still life: energy, waves over rays", abs(energy - 1), LIMITS["scene energy"])
        for distance in DISTANCES:
            by_rays, by_waves = (_contrast(reconstruct(capture, distance).image) for capture in (rays, waves))
            what = f"{name}, still life at {distance:g} mm: contrast {by_rays:.3f} by rays, difference"
            verdict.judge(what, abs(by_waves - by_rays), LIMITS["contrast"])
            rows.append({"lens": name, "distance": distance, "energy": energy, "rays": by_rays, "waves": by_waves})
        print(f"{name}: learning a bank takes {learning:.1f} s", flush=True)
        write_png(
            arguments.output / f"still_life_{name}.png", waves.image, peak=float(np.percentile(waves.image, 99.5))
        )
    return rows


def _width(resolution: int) -> dict[str, float]:
    return {"detector_width": 0.002 * resolution}


def _contrast(image: np.ndarray) -> float:
    inner = image[2:-2, 2:-2]
    return float(inner.std() / inner.mean())


def times(_: Any, verdict: Verdict) -> list[dict[str, Any]]:
    """Time the still life at full size through the thin lens and the double Gauss."""
    rows: list[dict[str, Any]] = []
    for name in (None, "double_gauss"):
        seen = with_camera(load_scene("still_life"), behind(name))
        began = time.perf_counter()
        render_capture(seen, model="wave", spp=16, wavelength=WAVELENGTH)
        rows.append({"lens": name or "thin", "seconds": time.perf_counter() - began})
        print(f"still life, 4096 x 4096, {rows[-1]['lens']}: {rows[-1]['seconds']:.1f} s", flush=True)
    verdict.judge("double Gauss over thin lens", rows[1]["seconds"] / rows[0]["seconds"], LIMITS["times"])
    return rows


GROUPS = {"walls": walls, "scene": scene, "times": times}
COLUMNS = {
    "lens": "{lens}",
    "lattice": "{lattice}",
    "blur (lenses)": "{blur:g}",
    "place (lenses)": "{place}",
    "by the bank": "{recorded:.0%}",
    "relative L2": "{error:.2%}",
    "energy": "{energy:.4f}",
    "time (s)": "{seconds:.1f}",
}


def main() -> int:
    """Measure, and return 1 if a figure is beyond its limit."""
    parser = options("lens_bank_accuracy", __doc__)
    parser.add_argument("--only", nargs="+", choices=list(GROUPS), default=["walls", "scene"])
    parser.add_argument("--lenses", nargs="+", choices=list(LENSES), default=["double_gauss", "cooke_triplet"])
    parser.add_argument("--lattices", nargs="+", choices=list(LATTICES), default=list(LATTICES))
    parser.add_argument("--blurs", nargs="+", type=float, default=list(BLURS), help="in lenses")
    parser.add_argument("--points", type=int, default=8, help="points of a wall across a lens")
    parser.add_argument("--resolution", type=int, default=512, help="pixels across the still life")
    arguments = start(parser)
    verdict = Verdict()
    results = {name: GROUPS[name](arguments, verdict) for name in arguments.only}
    finish(arguments, results, markdown(COLUMNS, results.get("walls", [])))
    return 0 if verdict.kept else 1


if __name__ == "__main__":
    mi.set_variant("llvm_ad_mono")
    sys.exit(main())
