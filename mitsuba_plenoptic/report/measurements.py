"""The numbers of an experiment."""

from __future__ import annotations

import math
import statistics
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from ..io.captures import Capture
from ..lightfield.white import white_image
from .experiment import METHODS, TITLES, Experiment
from .metrics import common_scale, image_metrics, interference, lit_region, relative_error, shape_window

# Samples of the edge's profile per pixel, as in the standard.
_OVERSAMPLING = 4

# Widths of the windows in which the edge's line is looked for, one after the other, over that of the image.
_WINDOWS = (1.0, 0.7, 0.5, 0.35, 0.25)


@dataclass(frozen=True)
class EdgeSharpness:
    """How sharp edges are."""

    # Distance in pixels from 10 to 90 per cent of the edge's height.
    width: float
    # Frequency in cycles per pixel at which the modulation transfer function falls to one half.
    mtf50: float


def edge_sharpness(image: np.ndarray) -> EdgeSharpness:
    """Measure an edge that runs from top to bottom through the image, a few degrees off the vertical.

    Shapes: `image` (rows, columns).
    """
    image = np.asarray(image, np.float64)
    position, profile = _profile(image)
    low, high = np.mean(profile[:_OVERSAMPLING]), np.mean(profile[-_OVERSAMPLING:])
    if not abs(high - low) > 0.1 * np.abs(profile).max():
        raise ValueError("no edge: both sides are alike")
    step = (profile - low) / (high - low)
    width = _first_crossing(position, step, 0.9) - _first_crossing(position, step, 0.1)

    spread = np.gradient(step) * np.hamming(step.size)
    transfer = np.abs(np.fft.rfft(spread, 16 * spread.size))
    frequency = np.fft.rfftfreq(16 * spread.size, 1 / _OVERSAMPLING)
    # The central difference's own transfer function.
    transfer[1:] /= np.sinc(2 * frequency[1:] / _OVERSAMPLING).clip(min=0.1)
    mtf50 = _first_crossing(frequency, 1 - transfer / transfer[0], 0.5)
    return EdgeSharpness(width=float(width), mtf50=float(mtf50))


def square_sharpness(image: np.ndarray, row: float, column: float, side: float) -> EdgeSharpness:
    """Measure a bright square on dark ground, turned by a few degrees: the median of its four edges.

    The median, because something else may lie near one of them.

    Shapes: `image` (rows, columns).
    """
    # As far along an edge as its slant leaves the corners alone, and halfway to the square's middle across it.
    reach = round(0.3 * side)
    found = []
    for view, r, c in ((image, row, column), (image.T, column, row)):
        for sign in (-1, 1):
            middle = round(c + sign * side / 2)
            first, left = round(r) - reach, middle - reach
            if min(first, left) < 0 or first + 2 * reach > view.shape[0] or left + 2 * reach > view.shape[1]:
                raise ValueError("no edge: it is not in view")
            found.append(edge_sharpness(view[first : first + 2 * reach, left : left + 2 * reach]))
    return EdgeSharpness(
        width=statistics.median(edge.width for edge in found), mtf50=statistics.median(edge.mtf50 for edge in found)
    )


def _profile(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project the pixels along the edge: distances from it and the mean values there."""
    rows, columns = image.shape
    slope = np.abs(np.gradient(image, axis=1))
    tilt, start = 0.0, (columns - 1) / 2
    # Noise beside the edge has slopes, too: the window closes in on the line that was found before.
    for part in _WINDOWS:
        offset = np.arange(columns) - (start + tilt * np.arange(rows))[:, None]
        weight = slope * np.cos(math.pi * np.clip(offset / (part * columns), -0.5, 0.5)) ** 2
        centres = (weight * np.arange(columns)).sum(axis=1) / weight.sum(axis=1).clip(min=1e-30)
        tilt, start = np.polyfit(np.arange(rows), centres, 1)
    distance = (np.arange(columns) - (start + tilt * np.arange(rows))[:, None]) / math.hypot(1, tilt)
    # Only distances that every row has.
    reach = math.floor(min(-distance[:, 0].max(), distance[:, -1].min()) * _OVERSAMPLING)
    if reach < 2 * _OVERSAMPLING:
        raise ValueError("no edge: it does not run from top to bottom")
    index = np.round(distance * _OVERSAMPLING).astype(int) + reach
    inside = (index >= 0) & (index <= 2 * reach)
    count = np.bincount(index[inside], minlength=2 * reach + 1)
    total = np.bincount(index[inside], weights=image[inside], minlength=2 * reach + 1)
    position = (np.arange(2 * reach + 1) - reach) / _OVERSAMPLING
    filled = count > 0
    return position, np.interp(position, position[filled], total[filled] / count[filled])


def _first_crossing(position: np.ndarray, rising: np.ndarray, level: float) -> float:
    """Where a curve first reaches a level, by linear interpolation; infinity if nowhere."""
    above = np.flatnonzero(rising >= level)
    if above.size == 0:
        return math.inf
    i = int(above[0])
    if i == 0:
        return float(position[0])
    part = (level - rising[i - 1]) / (rising[i] - rising[i - 1])
    return float(position[i - 1] + part * (position[i] - position[i - 1]))


_MIDDLE = 0.8
"""Radius of a micro-image's middle, seen through which nothing of the pupil's edge is near, over the whole radius."""

_DEVIATIONS = 3.0
"""Standard deviations beyond which a difference is more than noise."""

_ESTIMATE = 0.03
"""Part of the variances by which they may be wrong themselves: their estimates rest on sixteen numbers a pixel."""


@dataclass(frozen=True)
class Difference:
    """A difference of captures over some pixels; root mean squares over that of the second capture, all pixels."""

    # What is measured, noise and all.
    measured: float
    # What noise alone would give; None if one of the captures does not know its noise.
    noise: float | None
    # The difference without noise.
    true: float | None
    # Whether noise is enough to explain what is measured.
    noise_alone: bool | None

    def to_dict(self) -> dict[str, float | bool | None]:
        """Return the numbers by name, rounded to what they mean."""
        return {name: round(value, 5) if isinstance(value, float) else value for name, value in asdict(self).items()}


def capture_difference(a: Capture, b: Capture, pixels: np.ndarray | None = None) -> Difference:
    """Compare two captures of one camera, over some pixels or over all."""
    where = np.ones(b.image.shape, bool) if pixels is None else pixels
    reference = float(np.sum(np.square(b.image, dtype=np.float64)))
    squares = float(np.sum(np.square(a.image.astype(np.float64) - b.image)[where]))
    measured = _root(squares, reference)
    if a.noise is None or b.noise is None:
        return Difference(measured, None, None, None)
    variances = (np.square(a.noise, dtype=np.float64) + np.square(b.noise, dtype=np.float64))[where]
    expected = float(variances.sum())
    # A squared normal deviate has twice the square of its variance for a variance.
    uncertain = math.sqrt(2 * float(np.sum(variances**2)))
    excess = squares - expected
    alone = excess <= max(_DEVIATIONS * uncertain, _ESTIMATE * expected)
    return Difference(measured, _root(expected, reference), _root(excess, reference), alone)


def middle_of_micro_images(camera: PlenopticCamera) -> np.ndarray:
    """Mark the pixels that see the main lens's middle, within four fifths of its radius; (rows, columns) bool array."""
    return np.asarray(white_image(camera.replace(aperture_radius=_MIDDLE * camera.aperture_radius)) > 0.5)


def _root(squares: float, reference: float) -> float:
    return math.sqrt(max(squares, 0.0) / reference) if reference > 0 else 0.0


# The chart's squares, by the beginning of their ids, and how far they are turned.
_EDGE_PREFIX = "edge_"
_EDGE_TILT = math.radians(5)

_COHERENT = ("coherent", "partial")


def measure(experiment: Experiment) -> dict[str, Any]:
    """Compare the captures with each other and the reconstructions with thin lens and one-lens limit."""
    ray, wave = experiment.ray.image, experiment.wave.image
    return {
        "captures": {
            **image_metrics(ray, wave).to_dict(),
            "relative_error": round(relative_error(ray, wave), 5),
            "difference": _difference(experiment),
            "points": _against_points(experiment),
        },
        "reconstructions": _reconstructions(experiment),
        "interference": _interference(experiment),
        "edges": _edges(experiment),
    }


def _difference(experiment: Experiment) -> dict[str, Any]:
    middle = middle_of_micro_images(experiment.camera)
    pixels = {"all": None, "middle": middle, "rim": ~middle}
    return {
        name: capture_difference(experiment.ray, experiment.wave, where).to_dict() for name, where in pixels.items()
    }


def _against_points(experiment: Experiment) -> dict[str, float] | None:
    if experiment.points is None:
        return None
    wave, points = experiment.wave.image, experiment.points.image
    energy = float(wave.sum(dtype=np.float64) / points.sum(dtype=np.float64))
    return {"relative_error": round(relative_error(wave, points), 5), "energy": round(energy, 5)}


def find(rows: list[dict[str, Any]], **wanted: Any) -> dict[str, Any]:
    """Return the row of a table that has the wanted values."""
    return next(row for row in rows if all(row[name] == value for name, value in wanted.items()))


def _reconstructions(experiment: Experiment) -> list[dict[str, Any]]:
    rows = []
    distances = experiment.settings.distances
    truths = [experiment.truths[distance] for distance in distances]
    for method in METHODS:
        images = [experiment.images[method.name, distance] for distance in distances]
        scale = common_scale(images, truths)
        for distance, image, truth in zip(distances, images, truths, strict=True):
            limit = experiment.images["limit", distance]
            row = {
                "method": method.name,
                "distance": distance,
                "bins": list(image.shape[::-1]),
                "scale": round(scale, 5),
                **image_metrics(scale * image, truth).to_dict(),
                "energy": round(image_metrics(image, truth).energy, 5),
            }
            if method.name in _COHERENT:
                row["interference"] = round(interference(image, limit, lit_region(limit)), 5)
            rows.append(row)
    return rows


def _interference(experiment: Experiment) -> list[dict[str, Any]]:
    rows = []
    for name, (low, high) in experiment.boxes.items():
        window = shape_window(experiment.camera, low, high)
        if high[2] - low[2] > 1e-3 * low[2] or window is None:
            continue
        for distance in experiment.settings.distances:
            limit = experiment.images["limit", distance]
            values = {
                method: round(interference(experiment.images[method, distance], limit, window), 5)
                for method in _COHERENT
            }
            rows.append({"shape": name, "shape_distance": _depth(low), "distance": distance, **values})
    return rows


def _edges(experiment: Experiment) -> list[dict[str, Any]]:
    rows = []
    camera = experiment.camera
    for name, (low, high) in experiment.boxes.items():
        distance = _depth(low)
        if not name.startswith(_EDGE_PREFIX) or distance not in experiment.settings.distances:
            continue
        scale = camera.mla_distance / (low[2] * camera.mla_pitch)
        column, row = (camera.bin_count[axis] / 2 - (low[axis] + high[axis]) / 2 * scale for axis in (0, 1))
        side = float(high[0] - low[0]) / (math.cos(_EDGE_TILT) + math.sin(_EDGE_TILT)) * scale
        for method in TITLES:
            try:
                sharpness = square_sharpness(experiment.image(method, distance), row, column, side)
            except ValueError:
                continue
            bin_size = camera.bin_size(distance)
            rows.append(
                {
                    "shape": name,
                    "distance": distance,
                    "method": method,
                    "width_mm": round(sharpness.width * bin_size, 4),
                    "mtf50_per_mm": round(sharpness.mtf50 / bin_size, 4),
                }
            )
    return rows


def _depth(low: np.ndarray) -> float:
    """Distance of a flat shape, without the noise of single precision."""
    return round(float(low[2]), 3)
