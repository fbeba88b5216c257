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

Deconvolution at the paper's size: where points come to lie, letters, time and memory.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mitsuba_plenoptic import Capture, CaptureOperator, Detector, PlenopticCamera, expose, load_scene, reconstruct
from mitsuba_plenoptic.design import resolution_limit
from mitsuba_plenoptic.extensions.deconvolution.deconvolved import MOST_ITERATIONS
from mitsuba_plenoptic.extensions.deconvolution.response import Response
from mitsuba_plenoptic.extensions.deconvolution.solver import PlaneEstimates, richardson_lucy
from mitsuba_plenoptic.extensions.deconvolution.variation import Noise
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.points.units import radiance_weight
from mitsuba_plenoptic.report.experiment import thin_lens_image
from mitsuba_plenoptic.report.images import write_png

from .. import Row, at_least, at_most, case, figure, pick
from ..timing import in_process, once, paired, peak_memory
from . import resolution
from .reconstructions import letters_captures

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


@case(
    "deconvolution.wrong-response",
    "What becomes of a capture by responses of a wavelength, or a distance, that is 1 % off",
    {
        "d (mm)": "{d:+g}", "response": "{response}", "contrast": "{contrast:.2f}", "error": "{error:.2f}",
        "left of the capture": "{residual:.2%}", "brightest bin": "{most:.2f}",
    },
    page="docs/guides/deconvolution.md",
    quick={"accuracy": 0.05, "iterations": 50},
)  # fmt: skip
def wrong_responses(
    output: Path, *, d: float = 13.0, lenses: int = 0, accuracy: float = 0.0, iterations: int = 100
) -> Iterator[Row]:
    """Deconvolve the sinusoid at 80 % of the limit."""
    plane = plane_of(d, (JUDGED,), lenses, accuracy, output)
    for name, wavelength, place in (
        ("as it is", WAVELENGTH, plane.distance),
        ("wavelength 1 % longer", 1.01 * WAVELENGTH, plane.distance),
        ("distance from focus 1 % longer", WAVELENGTH, plane.distance + 0.01 * d),
        ("distance 1 % longer", WAVELENGTH, 1.01 * plane.distance),
    ):
        image = plane.images[0][..., 0]
        made, found = plane.solved(plane.response(wavelength, place), image, iterations=iterations)
        left, error = contrast(made, plane.camera, plane.distance, plane.waves[0], 0)
        row = {"d": d, "response": name, "contrast": left, "error": error}
        yield row | {"residual": found.residual, "most": float(made.max())}


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
    pitch, b, z = camera.mla_pitch, camera.mla_distance, camera.detector_distance
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
    size = camera.mla_pitch * camera.bin_count[0] / len(image)
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


@case(
    "deconvolution.fine-lines",
    "Lines finer than two lenses in wave captures of the paper's camera, by rays and deconvolved: contrast, and the "
    "error over that of an even grey, out of focus and in focus",
    {"distance (mm)": "{distance:g}", "period (lenses)": "{period:.2f}", "method": "{method}",
     "contrast": "{contrast:.2f}", "error": "{error:.2f}"},
    (at_most("error", "most"), at_least("error", "least")),
    page="docs/guides/deconvolution.md",
    quick={"periods": (1.3,), "iterations": 10, "distances": (253.0,)},
)  # fmt: skip
def fine_lines(
    *,
    distances: tuple[float, ...] = (253.0, 240.0),
    periods: tuple[float, ...] = (1.3, 0.9, 0.6),
    lenses: int = 14,
    iterations: int = 100,
    photons: float = 2000.0,
    spp: int = 64,
) -> Iterator[Row]:
    """Deconvolution must find lines out of focus with less than half the error of a grey, and in focus with more.

    Out of focus, captures without noise are judged. In focus those with noise are, because diffraction at the borders
    of lenses leaves a little of the lines.
    """
    camera, oversample = resolution.camera_of("paper", lenses), 8
    for distance, period in itertools.product(distances, periods):
        frequency, (angle, phase) = 1 / (period * camera.mla_pitch), resolution.PATTERNS[1]
        clean = resolution.captured(camera, distance, resolution.sinusoid(frequency, angle, phase), "wave", spp)
        noisy = expose(clean, Detector(), photons=photons, seed=1)
        focused = abs(distance - camera.focus_distance) < 1
        judged, bound = (noisy, {"least": 0.5}) if focused else (clean, {"most": 0.5})
        for method, capture, options in (
            ("rays", clean, {}),
            ("deconvolved", clean, {"method": "deconvolved", "iterations": iterations}),
            (f"deconvolved, {photons:g} photons", noisy, {"method": "deconvolved"}),
        ):
            image = reconstruct(capture, distance, oversample=oversample, **options).image
            values, places = resolution.binned(image, camera, oversample)
            truth = resolution.sinusoid(frequency, angle, phase)(*places) - 1
            error = float(np.std(values[:, 0] / values.mean() - 1 - truth) / np.std(truth))
            row = {"distance": distance, "period": period, "method": method, "error": error}
            row["contrast"] = resolution.contrast(values[:, 0], places, frequency, angle)
            yield row | (bound if options and capture is judged else {})


class Plane:
    """One plane, the captures of its sinusoids, and what is made of them; captures are stored in the folder."""

    def __init__(self, d: float, relative: tuple[float, ...], lenses: int, accuracy: float, folder: Path) -> None:
        paper = PlenopticCamera()
        self.d, self.distance, self.relative = d, paper.focus_distance + d, relative
        lenses = lenses or max(10, math.ceil(paper.blur_diameter(self.distance) / paper.mla_pitch) + 1)
        self.camera = paper.replace(detector_width=paper.mla_pitch * lenses, resolution=(32 * lenses, 32 * lenses))
        self.limit = resolution_limit(self.camera, self.distance, WAVELENGTH).frequency
        self.oversample = math.ceil(3 * self.limit * self.camera.bin_size(self.distance))
        self.waves = [Waves(self.limit * part) for part in relative]
        images = capture(self.camera, self.distance, self.waves, accuracy, folder)
        self.images = np.split(images, len(self.waves), axis=2)

    def response(self, wavelength: float = WAVELENGTH, distance: float | None = None) -> Response:
        """Return the response to the plane, or to one that is taken for it."""
        places = [self.distance if distance is None else distance]
        return Response(self.camera, places, wavelength=wavelength, oversample=self.oversample)

    def solved(self, response: Response, image: np.ndarray, **options: Any) -> tuple[np.ndarray, PlaneEstimates]:
        """Return the upright bins that explain an image, and the solution that they are of."""
        found = richardson_lucy(response, np.ascontiguousarray(image, np.float32), **options)
        return response.to_image(found.values[0], 0), found

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
                rough, end = self.solved(response, noisy, iterations=MOST_ITERATIONS, misfit=Noise(photons, 0.0).misfit)
                figures = [contrast(made, self.camera, self.distance, waves, number) for made in (ray, clean, rough)]
                found.append([*np.ravel(figures), end.iterations])
            names = ("ray", "ray_error", "clean", "clean_error", "noisy", "noisy_error", "noisy_iterations")
            row = {"d": self.d, "limit": self.limit, "relative": part, "oversample": self.oversample}
            row["arrives"] = arriving(data)
            row |= dict(zip(names, np.mean(found, axis=0).round(4).tolist(), strict=True))
            lowest = np.min(found, axis=0).round(4).tolist()
            yield row | {"iterations": iterations, "lowest": lowest[2], "lowest_noisy": lowest[4]}


plane_of = functools.cache(Plane)


WINDOWS = {"middle": (0.0, 0.0), "edge": (0.9, 0.0), "corner": (0.9, 0.9)}
"""Middles of the windows, over half of the detector."""

PLACES, POWERS = np.array([[0.085, -0.07], [-0.092, 0.081]]), np.array([2000.0, 1000.0])
"""On the array, from the middle of the window, in millimetres."""

NEAR = 2.5
"""Bins around a point whose light is its own."""


def window(distance: float, where: tuple[float, float]) -> PlenopticCamera:
    """Return the paper's camera with the window that holds the light of the points."""
    camera = PlenopticCamera()
    reach = camera.blur_diameter(distance) + 2 * float(np.abs(PLACES).max()) + 4 * camera.mla_pitch
    size = math.ceil(reach / camera.pixel_size)
    width, height = camera.resolution
    left, top = (
        min(total - size, max(0, round(total / 2 * (1 + part) - size / 2)))
        for total, part in zip((width, height), where, strict=True)
    )
    return camera.replace(crop_offset=(left, top), crop_size=(size, size))


@case(
    "deconvolution.points",
    "Where deconvolution puts two points, and with what power, in the middle, at the edge and in the corner of the "
    "paper's detector; captures are exact point spreads, each plane is deconvolved alone",
    {
        "d (mm)": "{d:+g}", "window": "{window}", "bins a lens": "{oversample}", "position (bins)": "{place:.3f}",
        "power": "{power:.4f}", "left of the capture": "{residual:.2%}",
    },
    (at_most("place", 0.1), at_most("power_off", 0.03)),
    page="docs/guides/deconvolution.md",
    quick={"planes": (13.0,), "windows": ("middle",), "iterations": 30},
)  # fmt: skip
def points(
    *, planes: tuple[float, ...] = tuple(sorted(PLANES)), windows: tuple[str, ...] = (), iterations: int = 60
) -> Iterator[Row]:
    """Measure planes at distances from the focus; a point's position is the mean of the light around it."""
    for d in planes:
        for name in pick(WINDOWS, windows):
            yield from window_points(d, name, iterations)


def window_points(d: float, name: str, iterations: int) -> list[Row]:
    """Return place and power of each point of a plane."""
    distance = PlenopticCamera().focus_distance + d
    camera = window(distance, WINDOWS[name])
    offset, size = np.array(camera.crop_offset), np.array(camera.crop_size)
    b, z = camera.mla_distance, camera.detector_distance
    # On the array, where chief rays to the middle of the window go through it.
    middle = (offset + size / 2 - np.array(camera.resolution) / 2) * camera.pixel_size * b / (b + z)
    places = middle + PLACES
    points = np.column_stack([-places * distance / b, np.full(len(places), distance)])
    image = CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=0).forward(POWERS)
    capture = Capture(np.maximum(image, 0), camera, WAVELENGTH, "wave", {})
    # About two bins a line pair of the plane's limit.
    oversample = 4 if abs(d) < 20 else 3
    found = reconstruct(capture, distance, method="deconvolved", oversample=oversample, iterations=iterations)
    light = np.nan_to_num(found.image.astype(np.float64))
    pitch = camera.mla_pitch / oversample
    light *= radiance_weight(camera, main_lens(camera), pitch**2)
    y, x = ((np.arange(count) - (count - 1) / 2) * pitch for count in light.shape)
    made = []
    for place, power in zip(places, POWERS, strict=True):
        near = np.hypot(x - place[0], (y - place[1])[:, None]) < NEAR * pitch
        own = light * near
        mean = np.array([own.sum(0) @ x, own.sum(1) @ y]) / own.sum()
        row = {"d": d, "window": name, "oversample": oversample, "residual": found.facts["residual"]}
        made.append(
            row
            | {
                "place": float(np.hypot(*(mean - place))) / pitch,
                "power": float(own.sum() / power),
                "power_off": abs(float(own.sum() / power) - 1),
            },
        )
    return made


DISTANCES = {"8": 210.0, "#": 280.0}

OVERSAMPLE = 4


@case(
    "deconvolution.letters",
    "The letters at full size, by rays and deconvolved, against a thin lens: PSNR over the letter's own part, and the "
    "width of its edges from 10 to 90 %",
    {
        "letter": "{letter}", "method": "{method}", "PSNR (dB)": "{psnr:.2f}", "edge (bins)": "{edge:.2f}",
        "steps": "{iterations}", "left of the capture": "{residual:.0%}", "s": "{seconds:.0f}",
    },
    (at_least("psnr", "least"), at_most("edge", "widest")),
    page="docs/guides/deconvolution.md",
    quick={"letters": ("#",), "iterations": 5, "reference_spp": 16, "size": 1024},
)  # fmt: skip
def letters(
    output: Path,
    *,
    letters: tuple[str, ...] = (),
    iterations: int = 30,
    reference_spp: int = 256,
    capture: str = "",
    size: int = 4096,
) -> Iterator[Row]:
    """Reconstruct the planes of letters out of focus; the deconvolved must beat rays in PSNR and by 0.7 in edges."""
    taken = letters_captures(capture, size)["wave"]
    scene = load_scene("letters", parameters={"letter_scale": str(size / 4096)})
    for letter, distance in pick(DISTANCES, letters).items():
        reference = thin_lens_image(scene, taken.camera, distance, reference_spp, OVERSAMPLE)
        part, images, bounds = region(reference), [], {}
        for method, options in (("ray", {}), ("deconvolved", {"iterations": iterations})):
            made, seconds, _ = once(
                lambda d=distance, m=method, o=options: reconstruct(taken, d, method=m, oversample=OVERSAMPLE, **o)
            )
            images.append(np.nan_to_num(made.image))
            found = {
                "psnr": psnr(made.image[part], reference[part]),
                "edge": edge_width(made.image[part], reference[part]),
            }
            facts = {"iterations": made.facts.get("iterations", "-"), "residual": made.facts.get("residual")}
            yield {"letter": letter, "method": method, **found, **facts, "seconds": seconds, **bounds}
            bounds = {"least": found["psnr"], "widest": 0.7 * found["edge"]}
        peak = float(reference.max())
        write_png(output / f"plane_{distance:g}.png", np.concatenate([*images, reference], 1), peak=peak)


def region(reference: np.ndarray) -> tuple[slice, slice]:
    """Return the letter in focus: where the steepest edges of the reference lie, and a little around."""
    steep = np.hypot(*np.gradient(reference))
    rows, columns = np.nonzero(steep > 0.5 * steep.max())
    margin = 4 * OVERSAMPLE
    return tuple(
        slice(max(0, int(np.percentile(index, 1)) - margin), int(np.percentile(index, 99)) + margin)
        for index in (rows, columns)
    )  # type: ignore[return-value]


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """Return the peak signal over the error, in decibels."""
    error = np.mean((image - reference) ** 2)
    return float(10 * np.log10(reference.max() ** 2 / error))


def edge_width(image: np.ndarray, reference: np.ndarray) -> float:
    """Return the mean width of the edges across rows, from 10 to 90 %, where the reference has isolated steep ones."""
    widths = []
    reach = 3 * OVERSAMPLE
    for line, truth in zip(image, reference, strict=True):
        step = np.diff(truth)
        for place in np.flatnonzero(np.abs(step) > 0.3):
            part = slice(place - reach, place + reach + 1)
            if place < reach or place + reach + 1 > len(truth):
                continue
            low, high = truth[part][: reach - 2], truth[part][-(reach - 2) :]
            if np.ptp(low) > 0.1 or np.ptp(high) > 0.1:
                continue
            profile = line[part] if step[place] > 0 else line[part][::-1]
            first, last = profile[:4].mean(), profile[-4:].mean()
            if last - first < 0.3:
                continue
            rising = (profile - first) / (last - first)
            above = int(np.argmax(rising > 0.9))
            below = above - int(np.argmax(rising[above::-1] < 0.1))
            if below < above and rising[below] < 0.1:
                up = above - (rising[above] - 0.9) / max(rising[above] - rising[above - 1], 1e-6)
                down = below + (0.1 - rising[below]) / max(rising[below + 1] - rising[below], 1e-6)
                widths.append(up - down)
    return float(np.median(widths)) if widths else float("nan")


@case(
    "deconvolution.time",
    "Deconvolution of the paper's camera: planning, the response and its adjoint, and memory, in a process of its own",
    page="docs/guides/deconvolution.md",
    quick={"resolution": 512, "runs": 1},
)
def times(*, distance: float = 253.0, oversample: int = 4, resolution: int = 4096, runs: int = 3) -> Iterator[Row]:
    """Time a plane, then 1, 2 and 4 planes between 253 and 262 mm on a quarter of the detector's width."""
    whole, planning, processor, memory = in_process(_one_plane, distance, oversample, resolution, runs)
    yield figure("planning", planning, unit="s")
    for name, seconds in whole.items():
        yield figure(f"{name}, elapsed", seconds, unit="s")
        yield figure(f"{name}, processor", processor[name], unit="s")
    yield figure("forward and adjoint, elapsed", sum(whole.values()), at_most=20.0, unit="s")
    yield figure("peak memory", memory, at_most=8.0, unit="GiB")
    pixels = resolution // 4
    quarter = PlenopticCamera(detector_width=2e-3 * pixels, resolution=(pixels, pixels))
    works = {}
    for count in (1, 2, 4):
        response = Response(quarter, (253.0, 256.0, 259.0, 262.0)[:count], wavelength=WAVELENGTH, oversample=oversample)
        lit = [np.ones(plane.shape, np.float32) for plane in response.planes]
        works[count] = functools.partial(_both, response, lit)
    timings = paired({f"{count} planes": work for count, work in works.items()}, runs)
    for name, timing in timings.items():
        yield figure(f"{name} of {pixels} pixels, forward and adjoint, processor", timing.processor, unit="s")
    ratio = timings["4 planes"].processor_ratio / 4
    yield figure("four planes over four times one, processor", ratio, at_most=1.4)


def _both(response: Response, lit: list[np.ndarray]) -> object:
    return response.adjoint(response.forward(lit))


def _one_plane(
    distance: float, oversample: int, resolution: int, runs: int
) -> tuple[dict[str, float], float, dict[str, float], float]:
    camera = PlenopticCamera(detector_width=2e-3 * resolution, resolution=(resolution, resolution))
    response, planning, _ = once(lambda: Response(camera, [distance], wavelength=WAVELENGTH, oversample=oversample))
    values = np.random.default_rng(0).random(response.shapes[0]).astype(np.float32)
    image = response.forward([values])
    timings = paired({"forward": lambda: response.forward([values]), "adjoint": lambda: response.adjoint(image)}, runs)
    return (
        {name: timing.seconds for name, timing in timings.items()},
        planning,
        {name: timing.processor for name, timing in timings.items()},
        peak_memory(),
    )
