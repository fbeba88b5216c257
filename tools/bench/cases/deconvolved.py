"""Deconvolution at the paper's size: where points come to lie, letters, time and memory."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mitsuba_plenoptic import Capture, CaptureOperator, PlenopticCamera, load_scene, reconstruct
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.points.units import radiance_weight
from mitsuba_plenoptic.refocus.deconvolution.response import Response
from mitsuba_plenoptic.report.experiment import thin_lens_image
from mitsuba_plenoptic.report.images import write_png

from .. import Row, at_least, at_most, case, figure, pick
from ..timing import in_process, once, paired, peak_memory
from .reconstructions import letters_captures

WAVELENGTH = 633.0
PLANES = (-30.0, -13.0, 13.0, 20.0, 30.0, 40.0)

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
    page="docs/deconvolution.md",
    quick={"planes": (13.0,), "windows": ("middle",), "iterations": 30},
)  # fmt: skip
def points(*, planes: tuple[float, ...] = PLANES, windows: tuple[str, ...] = (), iterations: int = 60) -> Iterator[Row]:
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
    page="docs/deconvolution.md",
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
    page="docs/deconvolution.md",
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
    values = np.random.default_rng(0).random(response.planes[0].shape).astype(np.float32)
    image = response.forward([values])
    timings = paired({"forward": lambda: response.forward([values]), "adjoint": lambda: response.adjoint(image)}, runs)
    return (
        {name: timing.seconds for name, timing in timings.items()},
        planning,
        {name: timing.processor for name, timing in timings.items()},
        peak_memory(),
    )
