"""Fits of a camera of 16 x 16 lenses to noisy captures of white and of letters, again and again, at accuracy 0.

The data are a wall and the three letters, whose brightest pixels get some photons, with Poisson noise by a seed.
Pitch, offset and angle of the array, its distance, that of the detector and both focal lengths are fitted together. The
captures' derivatives are computed once, at the true camera, and stored; with them held, each fit proceeds by
Gauss-Newton steps of which each takes one capture (chord iterations). These end at the same camera as steps with
derivatives of their own do, up to the square of what the noise changes.

Most fits start within two deviations of the true camera. Some start as one would who knows little: 2 % off
in every length, by 1 degree and 0.3 pitches; the lattice is then found in the white capture, `fitting.coarse_fit` finds
a camera by rays, and the same steps follow. They must end where the fit of the same noise from near ends.

Over so few seeds the mean of the squared errors is known to the square root of 2 / seeds only (0.22 for 40). The first
step from the true camera, which takes no capture, is therefore found for a thousand noises, the fits' own among them,
too; the fits must end where this step does, and its squared errors are what those of many fits would be.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera
from mitsuba_plenoptic.extensions.inverse.fit_light import Pixels
from mitsuba_plenoptic.extensions.inverse.fit_result import summary
from mitsuba_plenoptic.extensions.inverse.point_rays import WaveModel, vector_of
from mitsuba_plenoptic.fitting import Fit, PixelNoise, View, coarse_fit, lattice_from_white
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.points.units import brightness_of

from .. import Row, at_most, case
from ..scenes.letters import letter_points

WAVELENGTH = 633.0

NAMES = (
    "mla_pitch", "mla_offset", "mla_rotation", "mla_distance", "detector_distance", "mla_focal_length", "focal_length"
)  # fmt: skip

WALL = 110.0
"""Distance of the wall, whose points are blurred over three to four lenses."""

STEPS, BIAS_STEPS, FAR_STEPS = 2, 4, 8

NOISES = 1000

Array = NDArray[np.float64]


@case(
    "fits.noise",
    "Fits of 16 x 16 lenses to noisy captures of a wall and letters at accuracy 0; errors and steps in deviations",
    {
        "parameter": "{parameter}", "deviation": "{deviation:.3g}", "mean square over variance": "{square:.2f}",
        "of first steps": "{first:.2f}", "fits from first steps": "{apart:.3f}", "mean": "{mean:+.2f}",
        "variance over bound": "{variance[0]:.3f} to {variance[1]:.3f}", "last step": "{last:.3f}",
        "from afar": "{far:.3f}", "bias": "{bias:+.2f}",
    },
    (
        at_most("square_off", 0.25),
        at_most("first_off", 0.25),
        at_most("apart", 0.25),
        at_most("variance_off", 0.2),
        at_most("last", 0.05),
        at_most("far", 0.05),
    ),
    page="docs/fitting.md",
    quick={"lenses": 4, "seeds": 2, "far": 0, "derivatives": 0.05},
)  # fmt: skip
def noise(
    output: Path,
    *,
    lenses: int = 16,
    pixels: int = 8,
    seeds: int = 40,
    far: int = 2,
    photons: float = 2000.0,
    derivatives: float = 0.004,
    noises: int = NOISES,
    minutes: float = 35.0,
) -> Iterator[Row]:
    """Fit as many seeds as the minutes allow; a further run continues behind those that are stored.

    ``far`` of them are also fitted from afar, ``derivatives`` is the accuracy of the derivatives. The bias is that of
    data from other points at default accuracy.
    """
    began = time.monotonic()
    camera = PlenopticCamera(
        focal_length=40.0, aperture_radius=2.5, mla_distance=60.0, mla_rotation=0.3, mla_offset=(0.01, -0.017),
        detector_width=0.064 * lenses, resolution=(pixels * lenses,) * 2,
    )  # fmt: skip
    study = Study(camera, [wall(camera, 1), letters(lenses, 1)], photons)
    study.differentiate(derivatives, output)
    stored = output / "fits.json"
    known = json.loads(stored.read_text()) if stored.exists() else {}
    fits: list[dict[str, Any]] = known["fits"][:seeds] if known.get("key") == study.key else []
    # Along the directions that are separated, so that none starts further off than the data resolve.
    root = study.unit[:, None] * np.array(
        [[part * one.deviation for part in one.parts.values()] for one in study.stated(study.images).directions]
    ).T  # fmt: skip
    for seed in range(len(fits), seeds):
        if time.monotonic() - began > 60 * minutes:
            break
        near = study.true + root @ np.random.default_rng(1000 + seed).uniform(-2, 2, len(study.true))
        fits.append(study.settle(near, study.noisy(seed + 1), STEPS))
        stored.write_text(json.dumps({"key": study.key, "fits": fits}))
    bias = study.settle(study.true, study.recorded([wall(camera, 3), letters(lenses, 2)]), BIAS_STEPS)["error"]
    afar = [
        far_difference(study, study.noisy(seed + 1), np.random.default_rng(2000 + seed), found)
        for seed, found in enumerate(fits[:far])
    ]
    first, deviations = study.first_steps(max(noises, len(fits))), study.deviations(study.images)
    errors, variances, last = (np.array([each[key] for each in fits]) for key in ("error", "variance", "last"))
    for number, label in enumerate(study.labels):
        square, of_first = float((errors[:, number] ** 2).mean()), float((first[:, number] ** 2).mean())
        variance = variances[:, number]
        yield {
            "parameter": label,
            "deviation": deviations[number],
            "square": square,
            "square_off": abs(square - 1) if len(fits) >= 40 else None,
            "first": of_first,
            "first_off": abs(of_first - 1),
            "apart": float(np.abs(errors - first[: len(fits)])[:, number].max()),
            "mean": errors[:, number].mean(),
            "variance": [variance.min(), variance.max()],
            "variance_off": float(np.abs(variance - 1).max()),
            "last": float(last[:, number].max()),
            "far": max((each[number] for each in afar), default=None),
            "bias": bias[number],
            "seeds": len(fits),
        }


def wall(camera: PlenopticCamera, per_lens: int) -> tuple[Array, Array]:
    """Return points of a wall, `per_lens` to a lens along an axis, two lenses beyond the detector's border."""
    step = camera.detector_width / round(camera.detector_width / camera.mla_pitch) / per_lens
    half = round(camera.detector_width / 2 / step) + 2 * per_lens
    place = (np.arange(-half, half) + 0.63) * step
    x, y = (-part.ravel() * WALL / camera.mla_distance for part in np.meshgrid(place, place))
    return np.column_stack([x, y, np.full(x.size, WALL)]), np.full(x.size, 1.0 / per_lens**2)


def letters(lenses: int, per_lens: int) -> tuple[Array, Array]:
    """Return points of the letters, `per_lens` to a lens along an axis, for the paper's camera at half its size."""
    side = 0.128 * lenses
    camera = PlenopticCamera(detector_width=side, resolution=(64 * lenses,) * 2)
    points, weights = letter_points(camera, side / 8.192, per_lens**2)
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

    def __init__(self, camera: PlenopticCamera, lights: list[tuple[Array, Array]], photons: float) -> None:
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
        """Return what the camera with these parameters records at accuracy 0."""
        camera = self.vector.at(x)
        blank = np.zeros((len(self.lights), *camera.shape))
        return WaveModel(camera, self.views(blank, self.lights), WAVELENGTH, 0.0).images()

    def recorded(self, lights: list[tuple[Array, Array]]) -> Array:
        """Return captures of other points, whose total power is the same, at default accuracy."""
        images = []
        for (points, weights), (_, own), top in zip(lights, self.lights, self._tops, strict=True):
            operator = CaptureOperator(self.camera, points, wavelength=WAVELENGTH)
            scale = brightness_of(self.camera, main_lens(self.camera)) / top * float(own.sum() / weights.sum())
            images.append(scale * operator.forward(weights))
        return np.stack(images).astype(np.float64)

    def noisy(self, seed: int) -> Array:
        """Return the true captures with the noise of photons."""
        rng = np.random.default_rng(seed)
        return rng.poisson(np.maximum(self.images, 0) * self.photons) / self.photons

    def differentiate(self, accuracy: float, folder: Path) -> None:
        """Find the derivatives at the true camera, in `scales`, or take those that are stored."""
        file = folder / "derivatives.npz"
        key = [self.camera.to_dict(), accuracy, [len(points) for points, _ in self.lights], NAMES]
        self.key = json.dumps([*key, self.photons])
        if file.exists() and str(np.load(file)["key"]) == self.key:
            self.slopes = np.load(file)["slopes"]
            return
        model = WaveModel(self.camera, self.views(self.images, self.lights), WAVELENGTH, accuracy)
        self.slopes = model.derivatives(self.vector, self.images) * self.unit[:, None, None, None]
        np.savez(file, key=self.key, slopes=self.slopes)

    def _rows(self, images: Array) -> tuple[Array, Pixels]:
        """Return the weighted derivatives, (pixels, parameters), and the noise that fits weight by."""
        pixels = Pixels.of(self.views(images, self.lights), images, PixelNoise(self.photons))
        return (self.slopes / pixels.weight).reshape(len(self.labels), -1).T, pixels

    def stated(self, images: Array, residuals: Array | None = None) -> Fit:
        """Return what a fit states that ends at such pixels, with these weighted residuals."""
        rows, pixels = self._rows(images)
        limits = self.vector.limits(None)
        left = np.zeros(len(rows)) if residuals is None else residuals
        return summary(self.camera, self.labels, self.true, self.unit, limits, rows, left, pixels, 1)

    def deviations(self, images: Array) -> Array:
        """Return the stated standard deviations of the parameters."""
        return np.array(list(self.stated(images).deviations.values()))

    def first_steps(self, seeds: int) -> Array:
        """Return the step from the true camera for each noise over the stated deviations, (seeds, parameters)."""
        rows, pixels = self._rows(self.images)
        inverse = self.unit[:, None] * np.linalg.pinv(rows) / self.deviations(self.images)[:, None]
        noises = (self.noisy(seed + 1) - self.images for seed in range(seeds))
        return np.stack([inverse @ (noise / pixels.weight).ravel() for noise in noises])

    def settle(self, x: Array, seen: Array, steps: int) -> dict[str, Any]:
        """Go to where, by the derivatives that are held, the squared residuals are least."""
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


def far_difference(study: Study, images: Array, rng: np.random.Generator, near: dict[str, Any]) -> list[float]:
    """Fit from afar, and return how far from the fit from near it ends, over the deviations."""
    off: dict[str, Any] = {
        name: getattr(study.camera, name) * (1 + rng.choice((-0.02, 0.02)))
        for name in ("mla_pitch", "mla_distance", "detector_distance", "mla_focal_length", "focal_length")
    }
    away = 0.3 * study.camera.mla_pitch * rng.choice((-1, 1), 2)
    off["mla_offset"] = tuple((np.array(study.camera.mla_offset) + away).tolist())
    off["mla_rotation"] = study.camera.mla_rotation + rng.choice((-1, 1))
    start = lattice_from_white(study.camera.replace(**off), images[0])
    views = study.views(images, study.lights)
    coarse = study.vector.of(coarse_fit(start, views, NAMES, wavelength=WAVELENGTH)).values
    settled = study.settle(coarse, images, FAR_STEPS)
    difference = np.array(settled["x"]) - np.array(near["x"])
    return np.abs(difference / study.deviations(study.images)).tolist()
