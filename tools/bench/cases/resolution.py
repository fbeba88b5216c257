"""Resolution of every method of reconstruction: contrast of sinusoids, and the width of a slanted edge.

A wall that fills the view radiates a sinusoid of contrast 1, along x or turned by 30 degrees, in two phases, or an edge
turned by 5 degrees. It is captured by rays and by waves, and refocused to its own distance by every method. Contrast is
that of the sinusoid of the known frequency that fits the bins of the middle of the field best. The edge's width is that
between 10 and 90 % of the step, found from all bins by their distance from the edge (ISO 12233).

In focus contrasts are known: a bin is the mean over a lens, and the main lens has the transfer function of a circular
pupil (Goodman, "Introduction to Fourier Optics", section 6.3). Frequencies are given over the lens's own limit, half a
period per lens.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import matplotlib
import mitsuba as mi
import numpy as np
from scipy.optimize import curve_fit
from scipy.special import erf, erfinv

from mitsuba_plenoptic import Capture, PlenopticCamera, reconstruct, render_capture
from mitsuba_plenoptic.design import resolution_limit

from .. import Pivot, Row, at_most, case, pick

WAVELENGTH = 633.0
PATTERNS = ((0.0, 0.0), (30.0, 90.0))
"""Direction and phase of the sinusoids in degrees."""

EDGE_ANGLE = 5.0
TEXELS = 2048
CAMERAS: dict[str, dict[str, Any]] = {
    "paper": {},
    "hexagonal": {"mla_lattice": "hexagonal"},
    "keplerian": {"mla_distance": 117.0, "detector_distance": 0.6, "mla_focal_length": 0.5},
}
SUMS = "sums over lenses"
"""All light of each lens, without refocusing: in focus its contrast is known for waves, too."""

METHODS: dict[str, dict[str, Any]] = {
    SUMS: {},
    "rays, point": {"method": "ray", "footprint": "point"},
    "rays": {"method": "ray"},
    "coherent": {"method": "coherent"},
    "K = 2": {"method": "partial", "interleave": 2},
    "K = 4": {"method": "partial", "interleave": 4},
    "auto": {"method": "partial", "interleave": "auto"},
    "incoherent": {"method": "incoherent"},
    "deconvolved": {"method": "deconvolved"},
}


FIELDS = ("coherent", "K = 2", "K = 4", "auto")
"""Methods that the paper finds to differ from rays by interference alone."""


def camera_of(name: str, lenses: int) -> PlenopticCamera:
    """Return one of the cameras with a detector of some lenses."""
    return PlenopticCamera(detector_width=0.064 * lenses, resolution=(32 * lenses,) * 2, **CAMERAS[name])


def captured(
    camera: PlenopticCamera, distance: float, wall: Callable[..., np.ndarray], model: str, spp: int
) -> Capture:
    """Capture a wall whose radiance is a function of the position of its bin, to the right and downwards on the MLA."""
    half = camera.detector_width / 2 + camera.blur_diameter(distance) + 2 * camera.mla_pitch
    size = half * distance / camera.mla_distance
    along = half * (2 * (np.arange(TEXELS) + 0.5) / TEXELS - 1)
    # A rectangle that faces the camera has its u to the right in the image, and its v upwards.
    x, y = np.meshgrid(along, -along)
    values = np.repeat(wall(x, y)[..., None], 3, axis=2).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True}
    scene = {
        "type": "scene",
        "integrator": {"type": "direct"},
        "sensor": camera.to_sensor(),
        "wall": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f()
            .translate([0, 0, distance])
            .rotate([0, 1, 0], 180)
            .scale([size, size, 1]),
            "emitter": {"type": "area", "radiance": texture},
        },
    }
    options = {"wavelength": WAVELENGTH} if model == "wave" else {}
    return render_capture(mi.load_dict(scene), model=model, spp=spp, **options)


def refocused(capture: Capture, distance: float, method: str) -> np.ndarray:
    """Return the bins of a method's image as (rows, columns, channels)."""
    if method == SUMS:
        return sums_over_lenses(capture)
    options = dict(METHODS[method])
    if capture.model == "ray" and options["method"] == "deconvolved":
        options["response"] = "ray"
    elif capture.model == "ray" and options["method"] != "ray":
        options["wavelength"] = WAVELENGTH
    return np.asarray(reconstruct(capture, distance, **options).image, np.float64)


def sums_over_lenses(capture: Capture) -> np.ndarray:
    """Return the mean of the pixels of each lens of a square array."""
    camera = capture.camera
    to_array = camera.mla_distance / (camera.mla_distance + camera.detector_distance)
    count = camera.bin_count
    columns, rows = (
        np.clip(
            np.floor(camera.pixel_coordinates(axis) * to_array / camera.mla_pitch + count[axis] / 2), 0, count[axis] - 1
        )
        for axis in (0, 1)
    )
    index = (rows[:, None] * count[0] + columns).astype(int).ravel()
    channels = np.moveaxis(np.asarray(capture.image, np.float64), -1, 0)
    sums = [np.bincount(index, pixels.ravel()) / np.bincount(index) for pixels in channels]
    return np.stack(sums, axis=-1).reshape(*count[::-1], -1)


def bins(camera: PlenopticCamera, inner: float = 0.5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the positions of bins on the MLA, and which lie in the middle part of the field."""
    x, y = ((np.arange(count) - (count - 1) / 2) * camera.mla_pitch for count in camera.bin_count)
    x, y = np.meshgrid(x, y)
    reach = inner * camera.detector_width / 2
    return x, y, (np.abs(x) < reach) & (np.abs(y) < reach)


def contrast(image: np.ndarray, camera: PlenopticCamera, frequency: float, angle: float) -> float:
    """Return the contrast of the sinusoid of a frequency (cycles per millimetre of the MLA) that fits best."""
    x, y, inner = bins(camera)
    phase = 2 * np.pi * frequency * (x * math.cos(math.radians(angle)) + y * math.sin(math.radians(angle)))
    terms = np.stack([np.ones_like(phase), np.cos(phase), np.sin(phase)], axis=-1)[inner]
    mean, cosine, sine = np.linalg.lstsq(terms, image[inner], rcond=None)[0]
    return float(math.hypot(cosine, sine) / mean)


def edge_width(image: np.ndarray, camera: PlenopticCamera) -> float:
    """Return the width between 10 and 90 % of an edge in lens pitches, of the error function that fits best."""
    x, y, inner = bins(camera)
    angle = math.radians(EDGE_ANGLE)
    aside = ((x * math.cos(angle) + y * math.sin(angle)) / camera.mla_pitch)[inner]

    def step(d: np.ndarray, low: float, high: float, middle: float, width: float) -> np.ndarray:
        return low + (high - low) * (1 + erf((d - middle) / width)) / 2

    values = image[inner]
    start = values[aside < 0].mean(), values[aside > 0].mean(), 0.0, 1.0
    width = curve_fit(step, aside, values, start)[0][3]
    return float(2 * erfinv(0.8) * abs(width))


def in_focus(camera: PlenopticCamera, frequency: float, angle: float, model: str) -> float:
    """Return the contrast of a plane in focus, in cycles per millimetre of the MLA."""
    across = [frequency * trig(math.radians(angle)) * camera.mla_pitch for trig in (math.cos, math.sin)]
    lens = float(np.prod(np.sinc(across)))
    part = frequency * WAVELENGTH * 1e-6 * camera.mla_distance / (2 * camera.aperture_radius)
    pupil = 2 / math.pi * (math.acos(part) - part * math.sqrt(1 - part * part))
    return lens * (pupil if model == "wave" else 1.0)


@case(
    "resolution",
    "Contrast of sinusoids of contrast 1 in the plane of refocusing, the mean over two directions and phases, by the "
    "frequency over half a period per lens; and the width of a slanted edge in lens pitches",
    {
        "camera": "{camera}", "capture": "{model}", "distance (mm)": "{distance:g}", "method": "{method}",
        "contrasts": "{contrasts}", "10-90 % width": "{width:.2f}", "expected": "{expected}", "limits": "{limits}",
    },
    (at_most("difference", 0.02), at_most("apart", 0.05)),
    page="docs/numbers.md",
    pivot=Pivot("{model} capture, {method}", "{distance:g} mm", "{contrasts}, {width:.2f}"),
    quick={"distances": (240.0,), "relative": (0.5,), "methods": ("rays",), "models": ("ray",), "lenses": 12},
)  # fmt: skip
def resolution(
    output: Path,
    *,
    cameras: tuple[str, ...] = ("paper",),
    models: tuple[str, ...] = ("ray", "wave"),
    distances: tuple[float, ...] = (210.0, 230.0, 240.0, 252.0, 280.0, 320.0),
    relative: tuple[float, ...] = (0.25, 0.5, 0.75, 0.9),
    methods: tuple[str, ...] = (),
    lenses: int = 16,
    spp: int = 16,
) -> Iterator[Row]:
    """Measure contrasts, and draw them for each camera and capture model."""
    chosen = pick(METHODS, methods)
    for name in cameras:
        camera = camera_of(name, lenses)
        for model in models:
            rows = []
            for distance in distances:
                found = _of_plane(camera, model, distance, relative, list(chosen), spp)
                rows += [{"camera": name, "model": model, "relative": list(relative), **row} for row in found]
                yield from rows[-len(found) :]
            _draw(output / f"resolution_{name}_{model}.png", rows)


def _of_plane(
    camera: PlenopticCamera, model: str, distance: float, relative: tuple[float, ...], methods: list[str], spp: int
) -> list[Row]:
    """Measure all methods in one plane; captures of three walls are the channels of one."""
    limit = resolution_limit(camera, distance, WAVELENGTH if model == "wave" else None)
    if not limit.in_focus or camera.mla_lattice != "square":
        methods = [method for method in methods if method != SUMS]
    nyquist = 1 / (2 * camera.mla_pitch)
    waves = [(part * nyquist, angle, phase) for part in relative for angle, phase in PATTERNS]
    walls = [*(_sinusoid(*wave) for wave in waves), _edge]
    images = [captured(camera, distance, wall, model, spp).image for wall in walls]
    images += [images[-1]] * (-len(images) % 3)
    captures = [_of_three(images[first : first + 3], camera, model) for first in range(0, len(images), 3)]
    expected = [np.mean([in_focus(camera, part * nyquist, angle, model) for angle, _ in PATTERNS]) for part in relative]
    limits = {"pixels": limit.pixels / limit.lenses, "waves": limit.waves / limit.lenses}
    rows: list[Row] = []
    for method in methods:
        found = np.concatenate([refocused(capture, distance, method) for capture in captures], axis=-1)
        each = [contrast(found[..., number], camera, *wave[:2]) for number, wave in enumerate(waves)]
        values = np.reshape(each, (len(relative), -1)).mean(1)
        width = edge_width(found[..., len(waves)], camera)
        row: Row = {
            "method": method, "distance": distance, "values": values.tolist(), "width": width,
            "contrasts": " ".join(f"{value:.3f}" for value in values), "expected": "",
            "limits": ", ".join(f"{key} {value:.2g}" for key, value in limits.items() if math.isfinite(value)),
        }  # fmt: skip
        if limit.in_focus:
            row["expected"] = " ".join(f"{value:.3f}" for value in expected)
            if method == (SUMS if model == "wave" else "rays"):
                row["difference"] = float(np.abs(values - expected).max())
        rows.append(row)
    by_rays = next((row["values"] for row in rows if row["method"] == "rays"), None)
    for row in rows if model == "wave" and by_rays else ():
        if row["method"] in FIELDS:
            # Up to half the lens limit, waves back resolve what rays back do.
            row["apart"] = max(
                (abs(a - b) for a, b, f in zip(row["values"], by_rays, relative, strict=True) if f <= 0.5), default=None
            )
    return rows


def _of_three(images: list[np.ndarray], camera: PlenopticCamera, model: str) -> Capture:
    """Return a capture whose channels are three captures."""
    wavelength = (WAVELENGTH,) * 3 if model == "wave" else None
    return Capture(np.stack(images, axis=-1), camera, wavelength, model)


def _sinusoid(frequency: float, angle: float, phase: float) -> Callable[..., np.ndarray]:
    turned, shift = math.radians(angle), math.radians(phase)
    return lambda x, y: 1 + np.cos(2 * np.pi * frequency * (x * math.cos(turned) + y * math.sin(turned)) + shift)


def _edge(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    turned = math.radians(EDGE_ANGLE)
    return (x * math.cos(turned) + y * math.sin(turned) > 0).astype(float)


def _draw(path: Path, rows: list[Row]) -> None:
    """Draw contrast against frequency, one panel for each distance and one line for each method."""
    matplotlib.use("agg")
    from matplotlib import pyplot

    distances = list(dict.fromkeys(row["distance"] for row in rows))
    figure, axes = pyplot.subplots(1, len(distances), figsize=(2.6 * len(distances), 2.8), sharey=True, squeeze=False)
    for axis, distance in zip(axes[0], distances, strict=True):
        for row in rows:
            if row["distance"] == distance:
                axis.plot(row["relative"], row["values"], marker=".", label=row["method"])
        axis.set_title(f"{distance:g} mm")
        axis.set_xlabel("frequency / lens limit")
    axes[0][0].set_ylabel("contrast")
    axes[0][-1].legend(fontsize=6)
    figure.savefig(path, dpi=120, bbox_inches="tight")
    pyplot.close(figure)
