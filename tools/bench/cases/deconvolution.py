"""What deconvolution resolves: contrasts of sinusoids over the stated limit, against ray reconstruction.

Planes of the paper's camera, on a detector of fewer lenses, hold sinusoids of contrast 1, along x and turned by 30
degrees, in two phases. Their captures are exact sums over radiators that deconvolution has no knowledge of: a grid of
at least 2.6 to the limit's period and at other positions than its own, each with a point spread of its own (accuracy
0). Products of a sinusoid and the camera's response hold no frequency above 2.3 limits, so such a grid is the integral
over the plane.

Bins are even over their width. Contrast is the Fourier coefficient of that image at the true frequency and phase over
the mean, in a window of the middle of the field; the error is the root mean square of the bins from the truth's means
over them, over the sinusoid's mean. Bins as points would read 1 / 0.89 of that contrast at 3.8 bins a period: the
even bins' own blur, which the light that reaches the detector has not.

What arrives of the contrast follows from the captures themselves: the difference of two whose sinusoids are a quarter
of a period apart is that of one sinusoid without the grey. Noise-free captures of 100 steps give a contrast of 0.1
back where 1 % arrives. Limits hold in the mean over directions and phases.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, reconstruct
from mitsuba_plenoptic.design import resolution_limit
from mitsuba_plenoptic.extensions.deconvolution.deconvolved import MOST_ITERATIONS, until_noise
from mitsuba_plenoptic.extensions.deconvolution.response import Response
from mitsuba_plenoptic.linear.noise import PixelNoise
from mitsuba_plenoptic.linear.solver import RichardsonLucy, Solution, solve

from .. import Row, at_least, at_most, case

WAVELENGTH = 633.0
PLANES = (13.0, 40.0, -30.0, 30.0, 20.0, -13.0)
PHOTONS = 2000.0
RADIATORS_PER_PERIOD, LEAST_RADIATORS = 2.6, 3
JUDGED, EARLIEST, LATEST = 0.8, 1.0, 1.3
"""Frequencies over the limit: at the first contrast must be left, between the others it must fall to 0.1."""

ARRIVES = 0.01
"""Part of the contrast on the detector from which on captures without noise give lines back."""


@case(
    "deconvolution.contrast",
    "Contrast of sinusoids of contrast 1, by rays, deconvolved without noise, and with 2000 photons in the brightest "
    "pixel, stopped by the method itself; in brackets the error",
    {
        "d (mm)": "{d:+g}", "limit (lp/mm)": "{limit:.2f}", "frequency / limit": "{relative:.2f}",
        "bins a lens": "{oversample}", "arrives": "{arrives:.1%}", "rays": "{ray:.2f} ({ray_error:.2f})",
        "deconvolved": "{clean:.2f} ({clean_error:.2f})", "lowest": "{lowest:.2f}",
        "with noise": "{noisy:.2f} ({noisy_error:.2f})", "its lowest": "{lowest_noisy:.2f}",
        "steps, clean and noisy": "{iterations}, {noisy_iterations:.0f}",
    },
    (
        at_least("clean", "least"),
        at_least("noisy", "least_noisy"),
        at_most("clean", "most"),
        at_most("noisy", "most_noisy"),
    ),
    page="docs/guides/deconvolution.md",
    quick={"planes": (13.0,), "relative": (JUDGED,), "accuracy": 0.05, "iterations": 50},
)  # fmt: skip
def contrasts(
    output: Path,
    *,
    planes: tuple[float, ...] = PLANES,
    relative: tuple[float, ...] = (0.5, JUDGED, EARLIEST, 1.15, LATEST),
    lenses: int = 0,
    accuracy: float = 0.0,
    iterations: int = 100,
) -> Iterator[Row]:
    """Measure planes at distances from the focus; ``lenses`` 0 is one more than a point lights, 10 at least."""
    for d in planes:
        for row in plane_of(d, relative, lenses, accuracy, output).rows(iterations):
            bounds: Row = {}
            if row["relative"] == JUDGED:
                bounds = {"least": 0.6, "least_noisy": 0.15}
            elif row["relative"] == EARLIEST:
                bounds = {"least": 0.1}
            elif row["relative"] == LATEST:
                # Without noise only where nothing arrives.
                bounds = {"most_noisy": 0.1, "most": 0.1 if row["arrives"] < ARRIVES else None}
            yield row | bounds


class Waves:
    """Sinusoids of one frequency in a plane: along x and turned by 30 degrees, each in two phases."""

    def __init__(self, frequency: float) -> None:
        self.patterns = [(frequency, angle, phase) for angle in (0.0, 30.0) for phase in (0.0, 90.0)]

    def at(self, X: np.ndarray, Y: np.ndarray) -> np.ndarray:
        """Return the cosines at places in the plane, one for each pattern, first."""
        found = []
        for frequency, angle, phase in self.patterns:
            along = X * math.cos(math.radians(angle)) + Y * math.sin(math.radians(angle))
            found.append(np.cos(2 * np.pi * frequency * along + math.radians(phase)))
        return np.array(found)

    def bin_blur(self, size: float) -> list[float]:
        """Return what the width of a bin in the plane leaves of each."""
        return [
            float(np.sinc(f * size * math.cos(math.radians(angle))) * np.sinc(f * size * math.sin(math.radians(angle))))
            for f, angle, _ in self.patterns
        ]


def capture(camera: PlenopticCamera, distance: float, waves: list[Waves], allowed: float, folder: Path) -> np.ndarray:
    """Record all sinusoids, one a channel, by radiators of their own; or take the captures from the folder."""
    limit = resolution_limit(camera, distance, WAVELENGTH)
    count = max(LEAST_RADIATORS, math.ceil(RADIATORS_PER_PERIOD * limit.frequency / (2 * limit.lenses)))
    frequencies = [one.patterns[0][0] for one in waves]
    made_of = json.dumps([camera.to_dict(), distance, frequencies, allowed, count, WAVELENGTH])
    path = folder / f"capture_{distance:g}_{hashlib.sha256(made_of.encode()).hexdigest()[:12]}.npy"
    if path.exists():
        return np.load(path)
    pitch, b, z = camera.row_pitch, camera.mla_distance, camera.detector_distance
    reach = math.ceil((camera.detector_width + camera.blur_diameter(distance)) / 2 / pitch + 1) * count
    places = (np.arange(-reach, reach) + 0.37) * pitch / count
    X = -np.stack(np.meshgrid(places, places + 0.31 * pitch / count), axis=-1).reshape(-1, 2) * distance / b
    values = np.concatenate([0.5 + 0.5 * one.at(*X.T) for one in waves])
    weight = math.pi * camera.aperture_radius**2 * z**2 / (count**2 * b**2 * camera.pixel_size**2)
    points = np.column_stack([X, np.full(len(X), distance)])
    operator = CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=allowed)
    images = np.maximum(operator.forward(values.T * weight), 0)
    np.save(path, images)
    return images


def contrast(
    image: np.ndarray, camera: PlenopticCamera, distance: float, waves: Waves, number: int
) -> tuple[float, float]:
    """Return contrast and error of one pattern in an image of bins."""
    # Of an odd number of lenses a reconstruction shows one less, or one more.
    size = camera.row_pitch * camera.bin_count[0] / len(image)
    place = (np.arange(len(image)) - (len(image) - 1) / 2) * size
    x, y = np.meshgrid(place, place)
    half = 0.4 * camera.detector_width
    window = np.prod([np.cos(np.pi / 2 * np.clip(axis / half, -1, 1)) ** 2 for axis in (x, y)], axis=0)
    window = window / window.sum()
    image = np.nan_to_num(image)
    scale = distance / camera.mla_distance
    cosine, blur = waves.at(-x * scale, -y * scale)[number], waves.bin_blur(size * scale)[number]
    mean = (window * image).sum()
    error = np.sqrt((window * (image - 0.5 - 0.5 * blur * cosine) ** 2).sum()) / 0.5
    return 2 * blur * (window * (image - mean) * cosine).sum() / mean, float(error)


def arriving(images: np.ndarray) -> float:
    """Return what arrives on the detector of the contrast of sinusoids (rows, columns, patterns), root mean square."""
    grey = np.linalg.norm(images.mean(2))
    # cos a - cos(a + 90 degrees) is a cosine of the amplitude sqrt 2, whose root mean square is 1.
    found = [np.linalg.norm(images[..., k] - images[..., k + 1]) / grey for k in range(0, images.shape[2], 2)]
    return float(np.sqrt(np.mean(np.square(found))))


class Plane:
    """One plane, the captures of its sinusoids, and what is made of them; captures are stored in the folder."""

    def __init__(self, d: float, relative: tuple[float, ...], lenses: int, accuracy: float, folder: Path) -> None:
        paper = PlenopticCamera()
        self.d, self.distance, self.relative = d, paper.focus_distance + d, relative
        lenses = lenses or max(10, math.ceil(paper.blur_diameter(self.distance) / paper.row_pitch) + 1)
        self.camera = paper.replace(detector_width=paper.row_pitch * lenses, resolution=(32 * lenses, 32 * lenses))
        self.limit = resolution_limit(self.camera, self.distance, WAVELENGTH).frequency
        self.oversample = math.ceil(3 * self.limit * self.camera.bin_size(self.distance))
        self.waves = [Waves(self.limit * part) for part in relative]
        images = capture(self.camera, self.distance, self.waves, accuracy, folder)
        self.images = np.split(images, len(self.waves), axis=2)

    def response(self, wavelength: float = WAVELENGTH, distance: float | None = None) -> Response:
        """Return the response to the plane, or to one that is taken for it."""
        places = [self.distance if distance is None else distance]
        return Response(self.camera, places, wavelength=wavelength, oversample=self.oversample)

    def solved(self, response: Response, image: np.ndarray, **options: Any) -> tuple[np.ndarray, Solution]:
        """Return the upright bins that explain an image, and the solution that they are of."""
        steps = RichardsonLucy(response, np.ascontiguousarray(image, np.float32))
        found = solve(steps, accelerate=True, **options)
        return response.to_image(found.point, 0), found

    def rows(self, iterations: int) -> Iterator[Row]:
        """Yield contrasts and errors at each frequency."""
        response, random = self.response(), np.random.default_rng(0)
        for part, waves, data in zip(self.relative, self.waves, self.images, strict=True):
            found = []
            for number in range(4):
                image = np.ascontiguousarray(data[..., number])
                photons = PHOTONS / float(image.max())
                noisy = random.poisson(image * photons).astype(np.float32) / np.float32(photons)
                ray = reconstruct(image, self.distance, camera=self.camera, oversample=self.oversample).image
                clean, _ = self.solved(response, image, iterations=iterations)
                stop = until_noise(PixelNoise(photons))
                rough, end = self.solved(response, noisy, iterations=MOST_ITERATIONS, stop=stop)
                figures = [contrast(made, self.camera, self.distance, waves, number) for made in (ray, clean, rough)]
                found.append([*np.ravel(figures), end.iterations])
            names = ("ray", "ray_error", "clean", "clean_error", "noisy", "noisy_error", "noisy_iterations")
            row = {"d": self.d, "limit": self.limit, "relative": part, "oversample": self.oversample}
            row["arrives"] = arriving(data)
            row |= dict(zip(names, np.mean(found, axis=0).round(4).tolist(), strict=True))
            lowest = np.min(found, axis=0).round(4).tolist()
            yield row | {"iterations": iterations, "lowest": lowest[2], "lowest_noisy": lowest[4]}


plane_of = functools.cache(Plane)
