"""Fit a camera of 16 x 16 lenses to noisy captures of white and of letters, again and again, at accuracy 0.

    python tools/fit_noise_accuracy.py
    python tools/fit_noise_accuracy.py --lenses 4 --seeds 4 --far 0     # small

The data are a wall and the three letters, whose brightest pixels get so many photons, with Poisson noise by a seed.
Pitch, offset and angle of the array, its distance, that of the detector and both focal lengths are fitted together. The
captures' derivatives are computed once, at the true camera (``--derivatives`` is their accuracy), and kept in the
folder that ``--output`` names; with them held, each fit goes on by Gauss-Newton steps of which each takes one capture
(chord iterations). These end at the same camera as steps with derivatives of their own do, up to the square of what
the noise changes.

Most fits start within two deviations of the true camera. ``--far`` of them start as one would who knows little: 2 % off
in every length, by 1 degree and 0.3 pitches; the lattice is then found in the white capture, `fitting.come_near` finds
a camera by rays, and the same steps follow. They must end where the fit of the same noise from near ends.

Over so few seeds the mean of the squared errors is known to the square root of 2 / seeds only (0.22 for 40). The first
step from the true camera, which takes no capture, is therefore found for a thousand noises, the fits' own among them,
too; the fits must end where this step does, and its squared errors tell what those of many fits would be.

Printed, for each number: the mean over the seeds of the squared error over its stated variance (limit 1 within 0.25),
the same of the first steps over a thousand noises (0.25), how far fits end from the first step (0.25 deviations), the
stated variance over the Cramer-Rao bound of the true camera (1 within 0.2), the last step over the deviation (0.05),
and where a fit from afar ended (0.05 deviations). Without limits: the bias over the deviation where the data
come from other points and default accuracy. Fits begin until ``--minutes`` have passed; those that are done are
kept, too, and a further run goes on behind them. Writes ``fit_noise_accuracy.json``; exits with 1 where a limit is
not kept.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from typing import Any

import accuracy
import mitsuba as mi
import numpy as np
from derivative_benchmark import points_of
from numpy.typing import NDArray
from verdict import Verdict

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.fitting import Fit, PixelNoise, View, come_near, lattice_from_white
from mitsuba_plenoptic.fitting.model import Model, vector_of
from mitsuba_plenoptic.fitting.noise import Pixels
from mitsuba_plenoptic.fitting.result import summary
from mitsuba_plenoptic.lenses.factory import main_lens
from mitsuba_plenoptic.operator.units import brightness_of

WAVELENGTH = 633.0
NAMES = (
    "mla_pitch", "mla_offset", "mla_rotation", "mla_distance", "detector_distance", "mla_focal_length", "focal_length"
)  # fmt: skip
SPREAD, BOUND, SETTLED = 0.25, 0.2, 0.05
WALL = 110.0
"""Distance of the wall, whose points are blurred over three to four lenses."""

STEPS, BIAS_STEPS, FAR_STEPS = 2, 4, 8

NOISES = 1000

Array = NDArray[np.float64]


def main() -> None:
    """Fit, judge and write."""
    parser = accuracy.options("fit_noise_accuracy", __doc__)
    parser.add_argument("--lenses", type=int, default=16, help="across the detector")
    parser.add_argument("--pixels", type=int, default=8, help="across a lens")
    parser.add_argument("--seeds", type=int, default=40, help="captures with noise that are fitted")
    parser.add_argument("--far", type=int, default=2, help="how many of them are fitted from afar, too")
    parser.add_argument("--photons", type=float, default=2000.0, help="of the brightest pixels")
    parser.add_argument("--derivatives", type=float, default=0.004, help="accuracy of the derivatives")
    parser.add_argument("--minutes", type=float, default=35.0, help="after which no fit begins")
    arguments = accuracy.start(parser)
    mi.set_variant("llvm_ad_mono")
    began = time.monotonic()

    camera = mp.PlenopticCamera(
        focal_length=40.0, aperture_radius=2.5, mla_distance=60.0, mla_rotation=0.3, mla_offset=(0.01, -0.017),
        detector_width=0.064 * arguments.lenses, resolution=(arguments.pixels * arguments.lenses,) * 2,
    )  # fmt: skip
    study = Study(camera, [wall(camera, 1), letters(arguments.lenses, 1)], arguments.photons)
    print(f"{[len(points) for points, _ in study.lights]} points, {camera.shape} pixels", flush=True)
    study.differentiate(arguments)
    print(f"derivatives: {time.monotonic() - began:.0f} s", flush=True)

    kept = arguments.output / "fit_noise_fits.json"
    known = json.loads(kept.read_text()) if kept.exists() else {}
    fits: list[dict[str, Any]] = known["fits"][: arguments.seeds] if known.get("key") == study.key else []
    # Along the directions that are told apart, so that none starts further off than the data tell.
    root = study.unit[:, None] * np.array(
        [[part * one.deviation for part in one.parts.values()] for one in study.stated(study.images).directions]
    ).T  # fmt: skip
    for seed in range(len(fits), arguments.seeds):
        if time.monotonic() - began > 60 * arguments.minutes:
            break
        rng = np.random.default_rng(1000 + seed)
        near = study.true + root @ rng.uniform(-2, 2, len(study.true))
        fits.append(found := study.settle(near, study.noisy(seed + 1), STEPS))
        kept.write_text(json.dumps({"key": study.key, "fits": fits}))
        print(f"fit {seed + 1}: {np.round(found['error'], 2)}, {time.monotonic() - began:.0f} s", flush=True)
    other = [wall(camera, 3), letters(arguments.lenses, 2)]
    bias = study.settle(study.true, study.recorded(other), BIAS_STEPS)["error"]
    print(f"bias over deviation: {np.round(bias, 2)}", flush=True)
    for seed, found in enumerate(fits[: arguments.far]):
        found["far"] = far_difference(study, study.noisy(seed + 1), np.random.default_rng(2000 + seed), found)
        print(f"from afar {seed + 1}: {np.round(found['far'], 3)}, {time.monotonic() - began:.0f} s", flush=True)
    first = study.first_steps(max(NOISES, len(fits)))
    results = judged(study.labels, fits, bias, study.deviations(study.images), first)
    results["points"] = [len(points) for points, _ in study.lights]
    (arguments.output / "fit_noise_accuracy.json").write_text(json.dumps(results, indent=1) + "\n")
    sys.exit(0 if results["kept"] else 1)


def wall(camera: mp.PlenopticCamera, per_lens: int) -> tuple[Array, Array]:
    """Return points of a wall, so many to a lens along an axis, two lenses beyond the detector's border."""
    step = camera.detector_width / round(camera.detector_width / camera.mla_pitch) / per_lens
    half = round(camera.detector_width / 2 / step) + 2 * per_lens
    place = (np.arange(-half, half) + 0.63) * step
    x, y = (-part.ravel() * WALL / camera.mla_distance for part in np.meshgrid(place, place))
    return np.column_stack([x, y, np.full(x.size, WALL)]), np.full(x.size, 1.0 / per_lens**2)


def letters(lenses: int, per_lens: int) -> tuple[Array, Array]:
    """Return points of the letters, so many to a lens along an axis, for the camera of the paper at half its size."""
    side, pixels = 0.128 * lenses, 64 * lenses
    given = {"resolution": str(pixels), "detector_width": str(side), "letter_scale": str(side / 8.192)}
    scene = mp.load_scene("letters", parameters=given)
    camera = mp.PlenopticCamera(detector_width=side, resolution=(pixels, pixels))
    points, weights = points_of(scene, camera, per_lens**2)
    return points / 2, weights


class Study:
    """What the fits have in common: the true camera, its captures, the light, and its derivatives.

    Parameters
    ----------
    camera : PlenopticCamera
        The true one.
    lights : list of pairs
        Points and weights of each view.
    photons : float
        Of the brightest pixel of each.
    """

    def __init__(self, camera: mp.PlenopticCamera, lights: list[tuple[Array, Array]], photons: float) -> None:
        self.camera, self.photons = camera, photons
        self.vector = vector_of(camera, NAMES)
        self.labels = self.vector.labels
        self.true, self.unit = self.vector.values, self.vector.scales
        self.lights = lights
        # In units in which the brightest pixel of each view is 1.
        self._tops = [1.0] * len(lights)
        self._tops = [float(image.max()) for image in self.expected(self.true)]
        self.images = self.expected(self.true)

    def views(self, images: Array, lights: list[tuple[Array, Array]]) -> list[View]:
        """Return views of some images, with the light in their units."""
        given = zip(images, lights, self._tops, strict=True)
        return [View(image, points, weights / top) for image, (points, weights), top in given]

    def expected(self, x: Array) -> Array:
        """Return what the camera with these numbers records at accuracy 0."""
        camera = self.vector.at(x)
        blank = np.zeros((len(self.lights), *camera.shape))
        return Model(camera, self.views(blank, self.lights), WAVELENGTH, 0.0).images()

    def recorded(self, lights: list[tuple[Array, Array]]) -> Array:
        """Return captures of other points, whose total power is the same, at default accuracy."""
        images = []
        for (points, weights), (_, own), top in zip(lights, self.lights, self._tops, strict=True):
            operator = mp.CaptureOperator(self.camera, points, wavelength=WAVELENGTH)
            scale = brightness_of(self.camera, main_lens(self.camera)) / top * float(own.sum() / weights.sum())
            images.append(scale * operator.forward(weights))
        return np.stack(images).astype(np.float64)

    def noisy(self, seed: int) -> Array:
        """Return the true captures with the noise of photons."""
        rng = np.random.default_rng(seed)
        return rng.poisson(np.maximum(self.images, 0) * self.photons) / self.photons

    def differentiate(self, arguments: argparse.Namespace) -> None:
        """Find the derivatives at the true camera, in `scales`, or take those that have been kept."""
        file = arguments.output / "fit_noise_derivatives.npz"
        key = [self.camera.to_dict(), arguments.derivatives, [len(points) for points, _ in self.lights], NAMES]
        self.key = json.dumps([*key, self.photons])
        if file.exists() and str(np.load(file)["key"]) == self.key:
            self.slopes = np.load(file)["slopes"]
            return
        model = Model(self.camera, self.views(self.images, self.lights), WAVELENGTH, arguments.derivatives)
        self.slopes = model.derivatives(self.vector, self.images) * self.unit[:, None, None, None]
        np.savez(file, key=self.key, slopes=self.slopes)

    def _rows(self, images: Array) -> tuple[Array, Pixels]:
        """Return the weighted derivatives, (pixels, numbers), and the noise that fits weight by."""
        pixels = Pixels.of(self.views(images, self.lights), images, PixelNoise(self.photons))
        return (self.slopes / pixels.weight).reshape(len(self.labels), -1).T, pixels

    def stated(self, images: Array, residuals: Array | None = None) -> Fit:
        """Return what a fit states that ends at such pixels, with these weighted residuals."""
        rows, pixels = self._rows(images)
        limits = self.vector.limits(None)
        left = np.zeros(len(rows)) if residuals is None else residuals
        return summary(self.camera, self.labels, self.true, self.unit, limits, rows, left, pixels, 1)

    def deviations(self, images: Array) -> Array:
        """Return the stated standard deviations of the numbers."""
        return np.array(list(self.stated(images).deviations.values()))

    def first_steps(self, seeds: int) -> Array:
        """Return the step from the true camera for each noise over the stated deviations, (seeds, numbers)."""
        rows, pixels = self._rows(self.images)
        inverse = self.unit[:, None] * np.linalg.pinv(rows) / self.deviations(self.images)[:, None]
        noises = (self.noisy(seed + 1) - self.images for seed in range(seeds))
        return np.stack([inverse @ (noise / pixels.weight).ravel() for noise in noises])

    def settle(self, x: Array, seen: Array, steps: int) -> dict[str, Any]:
        """Go to where the derivatives that are held tell that the squared residuals are least."""
        for _ in range(steps):
            images = self.expected(x)
            rows, pixels = self._rows(images)
            residuals = ((seen - images) / pixels.weight).ravel()
            step = self.unit * np.linalg.lstsq(rows, residuals, rcond=None)[0]
            x = x + step
        found = self.stated(images, residuals - rows @ (step / self.unit))
        stated = np.array(list(found.deviations.values()))
        return {
            "x": x.tolist(),
            "error": ((x - self.true) / stated).tolist(),
            "variance": ((stated / self.deviations(self.images)) ** 2).tolist(),
            "last": np.abs(step / stated).tolist(),
            "chi_square": found.chi_square,
        }


def far_difference(study: Study, seen: Array, rng: np.random.Generator, near: dict[str, Any]) -> list[float]:
    """Fit from afar, and return how far from the fit from near it ends, over the deviations."""
    off: dict[str, Any] = {
        name: getattr(study.camera, name) * (1 + rng.choice((-0.02, 0.02)))
        for name in ("mla_pitch", "mla_distance", "detector_distance", "mla_focal_length", "focal_length")
    }
    away = 0.3 * study.camera.mla_pitch * rng.choice((-1, 1), 2)
    off["mla_offset"] = tuple((np.array(study.camera.mla_offset) + away).tolist())
    off["mla_rotation"] = study.camera.mla_rotation + rng.choice((-1, 1))
    start = lattice_from_white(study.camera.replace(**off), seen[0])
    views = study.views(seen, study.lights)
    began = time.monotonic()
    coarse = study.vector.of(come_near(start, views, NAMES, wavelength=WAVELENGTH)).values
    deviations = study.deviations(study.images)
    print(f"from {np.round((study.vector.of(start).values - study.true) / deviations)}", flush=True)
    print(f"to {np.round((coarse - study.true) / deviations)}, {time.monotonic() - began:.0f} s", flush=True)
    settled = study.settle(coarse, seen, FAR_STEPS)
    print(f"last step {np.round(settled['last'], 3)}", flush=True)
    difference = np.array(settled["x"]) - np.array(near["x"])
    return np.abs(difference / study.deviations(study.images)).tolist()


def judged(
    labels: list[str], fits: list[dict[str, Any]], bias: list[float], deviations: Array, first: Array
) -> dict[str, Any]:
    """Judge all figures, and return them."""
    verdict, rows = Verdict(), []
    errors, variance = (np.array([found[key] for found in fits]) for key in ("error", "variance"))
    last = np.array([found["last"] for found in fits])
    print(f"{len(fits)} seeds, chi-square per pixel {np.mean([found['chi_square'] for found in fits]):.4f}", flush=True)
    for number, label in enumerate(labels):
        row = {
            "number": label,
            "deviation": float(deviations[number]),
            "mean square over variance": float((errors[:, number] ** 2).mean()),
            "first steps": float((first[:, number] ** 2).mean()),
            "fits from first steps": float(np.abs(errors - first[: len(fits)])[:, number].max()),
            "mean over deviation": float(errors[:, number].mean()),
            "variance over bound": [float(variance[:, number].min()), float(variance[:, number].max())],
            "last step": float(last[:, number].max()),
            "far": [found["far"][number] for found in fits if "far" in found],
            "bias over deviation": bias[number],
        }
        rows.append(row)
        print(row, flush=True)
        verdict.judge(f"{label}: mean square over variance, off 1", abs(row["mean square over variance"] - 1), SPREAD)
        verdict.judge(f"{label}: of first steps, {len(first)} noises, off 1", abs(row["first steps"] - 1), SPREAD)
        verdict.judge(f"{label}: fits from first steps", row["fits from first steps"], SPREAD)
        verdict.judge(f"{label}: variance over bound, off 1", float(np.abs(variance[:, number] - 1).max()), BOUND)
        verdict.judge(f"{label}: last step", row["last step"], SETTLED)
        for far in row["far"]:
            verdict.judge(f"{label}: where a fit from afar ends", far, SETTLED)
    return {"seeds": len(fits), "numbers": rows, "kept": verdict.kept}


if __name__ == "__main__":
    main()
