"""Interference by each reading of ambiguous statements in the paper: the four subsets, and the microlens phase.

The subsets of lenses are labels of the pixels of a square array, which may be turned.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix

from ...errors import InputError
from ...io import Cache, Capture
from ...rays import follow_back
from ...refocus import reconstruct
from ...report import Experiment, metrics
from ...runtime import Array, Named, Progress
from ...views import capture_white, lenses_of_pixels


def quarters(i: Array, j: Array) -> Array:
    """Return the quarter of the array, counted from 0, of the lenses with given indices."""
    return (i >= 0) + 2 * (j >= 0)


def diagonals(i: Array, j: Array) -> Array:
    """Return the subset, from 0 to 3, of lenses on every fourth diagonal.

    Of the regular subsets of one lens in four they interfere least: neighbours are a diagonal apart, and a bin averages
    their fringes along both axes.
    """
    return (i + j) % 4


def measure_readings(experiment: Experiment, store: Cache, near: str, far: str) -> list[Named]:
    """Return the interference in images of the shapes `near` and `far`, each refocused to the distance of the other.

    Each row has the interference with four subsets, the quarters of the array or the diagonals; the number of subsets
    in which no images of lit lenses overlap; the interference without the second microlens phase (`literal`); and the
    difference from the ray image of the coherent image and of its part without interference.
    """
    first, *_, last = experiment.settings.distances
    blurred = [(near, last), (far, first)]

    def measure(progress: Progress) -> Named:
        return {"rows": [_row(experiment, shape, distance) for shape, distance in blurred]}

    return list(store.facts("readings", {"capture": experiment.wave_key, "blurred": blurred}, measure)["rows"])


def _row(experiment: Experiment, shape: str, distance: float) -> Named:
    window = metrics.shape_window(experiment.camera, *experiment.boxes[shape])
    if window is None:
        raise InputError(f"{shape}: it is not in the camera's view")
    capture = surroundings(experiment.wave, window, distance)

    def literal(method: str, **options: Any) -> Array:
        return reconstruct(capture, distance, method=method, relay=False, **options).image

    rays_alone = experiment.images["ray", distance]
    limit = experiment.images["limit", distance]
    literal_limit = literal("partial", interleave="auto")
    compared = {
        "quarters": (of_subsets(capture, distance, quarters), limit),
        "sublattice": (of_subsets(capture, distance, diagonals), limit),
        "literal_coherent": (literal("coherent"), literal_limit),
        "literal_partial": (literal("partial", interleave=2), literal_limit),
        "coherent_from_rays": (experiment.images["coherent", distance], rays_alone),
        "limit_from_rays": (limit, rays_alone),
    }
    values = {name: round(metrics.interference(*pair, window), 5) for name, pair in compared.items()}
    return {"shape": shape, "distance": distance, "colours": colour_count(experiment.wave, distance), **values}


def surroundings(capture: Capture, window: tuple[slice, slice], distance: float) -> Capture:
    """Return a capture with the light of those lenses alone that reaches a window of bins at a distance."""
    camera = capture.camera
    # Lenses around a letter whose light its blurred image needs besides half the blur, for diffraction.
    margin = math.ceil(camera.blur_diameter(distance) / camera.row_pitch / 2) + 4
    needed = np.ones(camera.shape, bool)
    for bins, index, count in zip(window[::-1], lenses_of_pixels(camera), camera.bin_count, strict=True):
        first, end = (bin - count // 2 for bin in (bins.start - margin, bins.stop + margin))
        needed &= (index >= first) & (index < end)
    return replace(capture, image=np.where(needed, capture.image, np.float32(0)))


def of_subsets(capture: Capture, distance: float, label: Callable[[Array, Array], Array], oversample: int = 1) -> Any:
    """Return the summed intensities of one coherent wave for each label of lenses, by their indices i and j."""
    labels = label(*lenses_of_pixels(capture.camera))
    # Each image is divided by white of one wave; white of the same subsets takes its place.
    light, white = (
        sum(
            reconstruct(
                replace(capture, image=np.where(labels == k, image, np.float32(0))),
                distance, method="coherent", oversample=oversample,
            ).image
            for k in range(4)
        )
        for image in (capture.image, capture_white(capture, 1).reshape(labels.shape))
    )  # fmt: skip
    return light / white


def colour_count(capture: Capture, distance: float) -> int:
    """Return the number of subsets of lit lenses in which no two images overlap at a distance.

    Two lenses' images overlap where their pixels, followed back by rays, come to the same bins; an image is enlarged by
    one bin on each side, for the width of the lens and for diffraction. Lenses are coloured one by one, from the middle
    outwards, which takes fewer colours than row by row, each with the first free colour.
    """
    camera = capture.camera
    y, x = np.nonzero(capture.image > 0)
    i, j = (index[y, x] for index in lenses_of_pixels(camera))
    centres = camera.lattice.centre(i.astype(float), j.astype(float))
    (across, u), (down, v) = (
        follow_back(camera.pixel_coordinates(axis)[pixel], centre, centre, distance, camera)
        for axis, (pixel, centre) in enumerate(zip((x, y), centres, strict=True))
    )
    passes = down**2 + across**2 <= camera.lit_radius**2
    column, row = (index[passes] - index.min() for index in (i, j))
    # Bins of the pixels' places, counted from 1.
    u, v = (np.floor(place[passes] / camera.row_pitch).astype(np.int64) for place in (u, v))
    u, v = (bins - bins.min(initial=0) + 1 for bins in (u, v))
    lenses = int(column.max()) + 1
    width = int(u.max()) + 2
    shape = (int(row.max()) + 1) * lenses, (int(v.max()) + 2) * width
    light = csr_matrix((capture.image[y, x][passes].astype(np.float64), (row * lenses + column, v * width + u)), shape)
    narrow = light.tocoo()
    around = [dv * width + du for dv in (-1, 0, 1) for du in (-1, 0, 1)]
    bins = np.concatenate([narrow.col + step for step in around])
    root = csr_matrix((np.tile(narrow.data / 9, 9), (np.tile(narrow.row, 9), bins)), shape).sqrt()
    common = (root @ root.T).tocsr()
    scale = np.sqrt(np.asarray(light.sum(1)).ravel())
    # Light of a lens over that of the brightest from which on it is coloured.
    lit = np.flatnonzero(scale**2 >= max(1e-3 * float(scale.max()) ** 2, np.finfo(float).tiny))
    position = np.stack([lit // lenses, lit % lenses])
    away = np.hypot(*(position - position.mean(axis=1, keepdims=True)))
    colours = np.full(len(scale), -1)
    for lens in lit[np.argsort(away, kind="stable")]:
        entries = slice(*common.indptr[lens : lens + 2])
        others = common.indices[entries]
        # Overlap of two lenses' light (the coefficient of Bhattacharyya) up to which their images count as separate.
        overlapping = common.data[entries] > 0.01 * scale[lens] * scale[others]
        neighbour_colours = set(colours[others[overlapping]].tolist())
        colours[lens] = next(colour for colour in itertools.count() if colour not in neighbour_colours)
    return int(colours.max()) + 1
