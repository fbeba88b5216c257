"""Measure what deconvolution resolves: contrasts of sinusoids over the stated limit, beside ray reconstruction.

Planes of the paper's camera, on a detector of fewer lenses, hold sinusoids of contrast 1, along x and turned by 30
degrees, in two phases. Their captures are exact sums over radiators that deconvolution does not know: 16 x 16 a lens,
spread by Sobol, each with a point spread of its own (``--accuracy 0``; more lets neighbouring lenses share them, which
is what ``--quick`` does). Contrast is the Fourier coefficient at the true frequency and phase over the mean, in a
window of the middle of the field; the error is the root mean square from the truth over the sinusoid's mean.

Writes ``deconvolution_accuracy.md`` and ``.json``. Exits with 1 if the mean over directions and phases, at 80 % of the
limit, is below 0.6 without noise or below 0.15 with 2000 photons in the brightest pixel, stopped by the method itself.

    python tools/deconvolution_accuracy.py --output out [--quick] [--planes 13 20] [--accuracy 0]
"""

from __future__ import annotations

import math
import time

import accuracy
import numpy as np

from mitsuba_plenoptic.camera import PlenopticCamera
from mitsuba_plenoptic.capture.operator import CaptureOperator
from mitsuba_plenoptic.capture.radiators import sample_pairs
from mitsuba_plenoptic.design import resolution_limit
from mitsuba_plenoptic.reconstruction import reconstruct
from mitsuba_plenoptic.reconstruction.deconvolution.noise import Noise
from mitsuba_plenoptic.reconstruction.deconvolution.response import Response
from mitsuba_plenoptic.reconstruction.deconvolution.solver import richardson_lucy
from mitsuba_plenoptic.reconstruction.deconvolution.to_bins import to_bins
from mitsuba_plenoptic.reconstruction.deconvolved import MOST_ITERATIONS

WAVELENGTH = 633.0
PLANES = (-30.0, -13.0, 13.0, 20.0, 30.0, 40.0)
PHOTONS = 2000.0
RADIATORS = 16
JUDGED, LEAST, LEAST_NOISY = 0.8, 0.6, 0.15

COLUMNS = {
    "d (mm)": "{d:+g}",
    "limit (lp/mm)": "{limit:.2f}",
    "frequency / limit": "{relative:.2f}",
    "bins a lens": "{oversample}",
    "rays": "{ray:.2f} ({ray_error:.2f})",
    "deconvolved": "{clean:.2f} ({clean_error:.2f})",
    "lowest": "{lowest:.2f}",
    "with noise": "{noisy:.2f} ({noisy_error:.2f})",
    "its lowest": "{lowest_noisy:.2f}",
    "steps, clean and noisy": "{iterations}, {noisy_iterations:.0f}",
}


WRONG = {
    "response": "{response}",
    "contrast": "{contrast:.2f}",
    "error": "{error:.2f}",
    "left of the capture": "{residual:.2%}",
    "brightest bin": "{most:.2f}",
}


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


def capture(camera: PlenopticCamera, distance: float, waves: list[Waves], allowed: float) -> np.ndarray:
    """Record all sinusoids, one a channel, by radiators of their own."""
    pitch, b, z = camera.mla_pitch, camera.mla_distance, camera.detector_distance
    reach = camera.detector_width / 2 + camera.blur_diameter(distance) / 2 + 2 * pitch
    lenses = np.arange(-math.ceil(reach / pitch), math.ceil(reach / pitch))
    first = np.stack(np.meshgrid(lenses, lenses), axis=-1).reshape(-1, 1, 2)
    places = ((first + sample_pairs(RADIATORS, np.full(4, 0.37))[:, :2]) * pitch).reshape(-1, 2)
    X = -places * distance / b
    values = np.concatenate([0.5 + 0.5 * one.at(*X.T) for one in waves])
    pupil = math.pi * camera.aperture_radius**2
    weight = pupil * z**2 / (RADIATORS**2 * b**2 * camera.pixel_size**2)
    points = np.column_stack([X, np.full(len(X), distance)])
    operator = CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=allowed)
    return np.maximum(operator.forward(values.T * weight), 0)


def contrast(
    image: np.ndarray, camera: PlenopticCamera, distance: float, waves: Waves, number: int
) -> tuple[float, float]:
    """Return contrast and error of one pattern in an image of bins."""
    size = camera.detector_width / len(image)
    place = (np.arange(len(image)) - (len(image) - 1) / 2) * size
    x, y = np.meshgrid(place, place)
    half = 0.4 * camera.detector_width
    window = np.prod([np.cos(np.pi / 2 * np.clip(axis / half, -1, 1)) ** 2 for axis in (x, y)], axis=0)
    window = window / window.sum()
    image = np.nan_to_num(image)
    cosine = waves.at(-x * distance / camera.mla_distance, -y * distance / camera.mla_distance)[number]
    mean = (window * image).sum()
    error = np.sqrt((window * (image - 0.5 - 0.5 * cosine) ** 2).sum()) / 0.5
    return 2 * (window * (image - mean) * cosine).sum() / mean, float(error)


def plane(
    camera: PlenopticCamera, d: float, relative: list[float], allowed: float, iterations: int
) -> list[accuracy.Row]:
    """Measure one plane at some fractions of its limit."""
    distance = camera.focus_distance + d
    limit = resolution_limit(camera, distance, WAVELENGTH).frequency
    oversample = math.ceil(3 * limit * camera.bin_size(distance))
    waves = [Waves(limit * part) for part in relative]
    start = time.time()
    images = capture(camera, distance, waves, allowed)
    response = Response(camera, [distance], wavelength=WAVELENGTH, oversample=oversample)
    print(f"d = {d:+g}: capture and response in {time.time() - start:.0f} s", flush=True)
    random = np.random.default_rng(0)

    def solved(image: np.ndarray, **options: object) -> tuple[np.ndarray, int]:
        found = richardson_lucy(response, np.ascontiguousarray(image, np.float32), **options)  # type: ignore[arg-type]
        return to_bins(found.values[0], response.cells, response.planes[0].lit, camera, oversample), found.iterations

    rows = []
    for part, one, data in zip(relative, waves, np.split(images, len(waves), axis=2), strict=True):
        found = []
        for number in range(4):
            image = np.ascontiguousarray(data[..., number])
            photons = PHOTONS / float(image.max())
            noisy = random.poisson(image * photons).astype(np.float32) / np.float32(photons)
            ray = reconstruct(image, distance, camera=camera, oversample=oversample).image
            clean, _ = solved(image, iterations=iterations)
            rough, steps = solved(noisy, iterations=MOST_ITERATIONS, misfit=Noise(photons, 0.0).misfit)
            figures = [contrast(made, camera, distance, one, number) for made in (ray, clean, rough)]
            found.append([*np.ravel(figures), steps])
        means = np.mean(found, axis=0)
        names = ("ray", "ray_error", "clean", "clean_error", "noisy", "noisy_error", "noisy_iterations")
        row = {"d": d, "limit": limit, "relative": part, "oversample": oversample, "iterations": iterations}
        row |= dict(zip(names, means.round(4).tolist(), strict=True))
        row |= {"lowest": float(np.min(found, axis=0)[2]), "lowest_noisy": float(np.min(found, axis=0)[4])}
        rows.append(row)
        print(accuracy.markdown(COLUMNS, rows[-1:]).splitlines()[-1], flush=True)
    return rows


def wrong(camera: PlenopticCamera, d: float, allowed: float, iterations: int) -> list[accuracy.Row]:
    """Deconvolve one capture by responses of a wavelength, or a distance, that is 1 % off."""
    distance = camera.focus_distance + d
    limit = resolution_limit(camera, distance, WAVELENGTH).frequency
    oversample = math.ceil(3 * limit * camera.bin_size(distance))
    waves = Waves(JUDGED * limit)
    image = np.ascontiguousarray(capture(camera, distance, [waves], allowed)[..., 0])
    rows = []
    for name, wavelength, place in (
        ("as it is", WAVELENGTH, distance),
        ("wavelength 1 % longer", 1.01 * WAVELENGTH, distance),
        ("distance from focus 1 % longer", WAVELENGTH, distance + 0.01 * d),
        ("distance 1 % longer", WAVELENGTH, 1.01 * distance),
    ):
        response = Response(camera, [place], wavelength=wavelength, oversample=oversample)
        found = richardson_lucy(response, image, iterations=iterations)
        made = to_bins(found.values[0], response.cells, response.planes[0].lit, camera, oversample)
        seen, error = contrast(made, camera, distance, waves, 0)
        row = {
            "response": name,
            "contrast": seen,
            "error": error,
            "residual": found.residual,
            "most": float(made.max()),
        }
        rows.append(row)
        print(accuracy.markdown(WRONG, rows[-1:]).splitlines()[-1], flush=True)
    return rows


def main() -> int:
    """Measure the planes, and judge them at 80 % of their limits."""
    parser = accuracy.options("deconvolution_accuracy", __doc__)
    parser.add_argument(
        "--quick", action="store_true", help="12 lenses, shared point spreads, two planes, 80 %% of the limit only"
    )
    parser.add_argument("--planes", type=float, nargs="*", help="distances from the plane in focus")
    parser.add_argument("--relative", type=float, nargs="*", help="frequencies over the limit")
    parser.add_argument("--lenses", type=int, help="lenses across the detector; default 24")
    parser.add_argument("--accuracy", type=float, help="of the captures; default 0")
    parser.add_argument("--iterations", type=int, default=60, help="steps without noise")
    given = accuracy.start(parser)
    lenses = given.lenses or (12 if given.quick else 24)
    planes = given.planes or ((13.0, -30.0) if given.quick else PLANES)
    relative = given.relative or ([JUDGED] if given.quick else [0.5, 0.65, JUDGED, 0.9, 1.0, 1.1, 1.2, 1.3])
    allowed = given.accuracy if given.accuracy is not None else (0.01 if given.quick else 0.0)
    camera = PlenopticCamera(detector_width=0.064 * lenses, resolution=(32 * lenses, 32 * lenses))
    rows = [row for d in planes for row in plane(camera, d, relative, allowed, given.iterations)]
    judged = [row for row in rows if row["relative"] == JUDGED]
    off = wrong(camera, planes[0], allowed, given.iterations)
    results = {"planes": rows, "wrong responses": off}
    accuracy.finish(given, results, accuracy.markdown(COLUMNS, rows), accuracy.markdown(WRONG, off))
    return int(any(row["clean"] < LEAST or row["noisy"] < LEAST_NOISY for row in judged))


if __name__ == "__main__":
    raise SystemExit(main())
