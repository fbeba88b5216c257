"""Fit captures with other noise again and again, to see whether fits spread as their stated deviations say.

    python tools/fit_accuracy.py
    python tools/fit_accuracy.py --lenses 16 --seeds 40 --numbers mla_pitch,mla_offset,detector_distance
    python tools/fit_accuracy.py --method rays --lenses 16 --points 400

Points at several distances, of which the brightest pixel gets so many photons, are recorded by a small camera at the
given accuracy. Each fit starts off by the given part of the lengths. Printed and written, for each number: the mean of
the squared errors over their stated variances (1 if right, within 0.25), and the stated deviation over the Cramer-Rao
bound of the true camera (1 if right, within 0.2). Exits with 1 where a figure is beyond its limit.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from verdict import Verdict

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, fit
from mitsuba_plenoptic.fitting import View
from mitsuba_plenoptic.fitting.ray_model import PointRays
from mitsuba_plenoptic.lenses.factory import main_lens
from mitsuba_plenoptic.operator.units import brightness_of
from mitsuba_plenoptic.system.optical_system import OpticalSystem

WAVELENGTH = 633.0
SPREAD, BOUND = 0.25, 0.2


def main() -> None:
    """Fit, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lenses", type=int, default=2, help="lenses across the detector")
    parser.add_argument("--points", type=int, default=6, help="points before the camera")
    parser.add_argument("--seeds", type=int, default=40, help="captures with noise that are fitted")
    parser.add_argument("--photons", type=float, default=2000.0, help="photons of the brightest pixel")
    parser.add_argument("--method", default="waves", choices=("waves", "rays"), help="of captures and fits")
    parser.add_argument("--accuracy", type=float, default=0.0, help="of captures and fits")
    parser.add_argument("--off", type=float, default=0.005, help="by what part of itself the pitch starts off")
    parser.add_argument("--numbers", default="mla_pitch,mla_offset,detector_distance", help="what is fitted")
    parser.add_argument("--output", type=Path, default=Path("fit_accuracy.csv"), help="table to write")
    options = parser.parse_args()

    side = 0.064 * options.lenses
    camera = PlenopticCamera(
        detector_width=side,
        resolution=(32 * options.lenses,) * 2,
        focal_length=40.0,
        aperture_radius=2.5,
        mla_distance=60.0,
    )
    rng = np.random.default_rng(0)
    g = rng.uniform(112, 128, options.points)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (options.points, 2)) * side * -g[:, None] / 60, g])
    if options.method == "rays":
        image = PointRays(camera, points, WAVELENGTH).image(OpticalSystem(camera, WAVELENGTH), np.ones(options.points))
    else:
        operator = CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=options.accuracy)
        image = operator.forward(np.ones(options.points)).astype(np.float64)
    image *= brightness_of(camera, main_lens(camera))
    weights = np.full(options.points, 1 / image.max())
    image /= image.max()
    names = options.numbers.split(",")
    common = {"wavelength": WAVELENGTH, "photons": options.photons, "accuracy": options.accuracy}
    common |= {"method": options.method}
    # What the true camera's derivatives tell: a fit of what it records without noise ends there.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that chi-square is 0
        bound = fit(camera, View(image, points, weights), names, **common)
    true = bound.values
    fits, began = [], time.monotonic()
    for seed in range(options.seeds):
        noise = np.random.default_rng(seed + 1)
        seen = noise.poisson(np.maximum(image, 0) * options.photons) / options.photons
        start = camera.replace(
            mla_pitch=camera.mla_pitch * (1 + noise.uniform(-1, 1) * options.off),
            mla_offset=tuple(noise.uniform(-0.3, 0.3, 2) * options.off * camera.mla_pitch),
        )
        fits.append(fit(start, View(seen, points, weights), names, **common))
        print(f"{seed + 1} of {options.seeds} fits, {time.monotonic() - began:.0f} s", flush=True)
    rows = []
    for name, deviation in bound.deviations.items():
        errors = np.array([(found.values[name] - true[name]) / found.deviations[name] for found in fits])
        stated = np.array([found.deviations[name] for found in fits]) / deviation
        spread = (errors**2).mean(), errors.mean(), stated.mean(), stated.min(), stated.max()
        rows.append({"number": name, "deviation": deviation} | dict(zip(_COLUMNS, map(float, spread), strict=True)))
    print(f"chi-square per pixel {np.mean([found.chi_square for found in fits]):.3f}")
    for row in rows:
        print("  ".join(f"{name} {value:.4g}" if isinstance(value, float) else value for name, value in row.items()))
    with options.output.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    verdict = Verdict()
    for row in rows:
        off = abs(float(row["mean square over variance"]) - 1)
        verdict.judge(f"{row['number']}: mean square over variance, off 1", off, SPREAD)
        off = max(abs(float(row[key]) - 1) for key in ("least", "most"))
        verdict.judge(f"{row['number']}: deviation over bound, off 1", off, BOUND)
    sys.exit(0 if verdict.kept else 1)


_COLUMNS = "mean square over variance", "mean error over deviation", "deviation over bound", "least", "most"


if __name__ == "__main__":
    main()
