"""The numbers of an experiment."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .difference import capture_difference, middle_of_micro_images
from .experiment import METHODS, TITLES, Experiment
from .metrics import common_scale, image_metrics, interference, lit_region, relative_error, shape_window
from .slanted_edge import square_sharpness

# The chart's squares, by the beginning of their ids, and how far they are turned.
_EDGE_PREFIX = "edge_"
_EDGE_TILT = math.radians(5)

_COHERENT = ("coherent", "partial")


def measure(experiment: Experiment) -> dict[str, Any]:
    """Compare the captures with each other and the reconstructions with thin lens and one-lens limit.

    Returns
    -------
    dict
        ``captures``: the ray capture compared with the wave capture: image metrics, and under ``difference`` how far
        they are apart and how much of that is noise, over ``all`` pixels, the ``middle`` of micro-images and their
        ``rim``, and under ``points`` the relative error and the energy of the wave capture against that of points.
        ``reconstructions``: for each method and
        distance image metrics against the thin lens (after one scale per method), energy (before it) and, where waves
        interfere, the distance from the one-lens limit over all that is lit. ``interference``: the same over each
        flat shape. ``edges``: sharpness of the chart's slanted edges, empty for other scenes.
    """
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
