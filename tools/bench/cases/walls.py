"""White walls and ramps, refocused at their own distance by every method: every bin that is reached, to the border.

A wall of radiance 1 and one whose radiance rises from 0.5 to 1.5 across the field stand at a distance, or are the sky.
Ray captures are refocused by rays without a white reference, all others with that of another white wall, at 400 mm, so
that white walls are judged, too. The worst bin is compared with the known radiance. Bins that are NaN are not reached.

Where the worst bin of a wave capture is beyond its limit, the image is compared with what the diffraction of the
microlenses leaves of the wall (`diffraction`): rows within the limit of that are explained by "diffraction".

Where a coherent or partially coherent image is still beyond it, its difference from the image in which no two lenses
interfere (`auto`) is judged. That difference must have no mean where bins are weighted by their white, since
interference moves power between bins and makes none; its RMS must be at most half as much again as predicted for lenses
of random phases (a field of few fringes scatters by that much); and the image without it must be within the limit.
Such rows are explained by "interference". All others beyond their limit fail.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from mitsuba_plenoptic import Capture, PlenopticCamera, reconstruct

from .. import Pivot, Row, at_most, case, pick
from ..scenes import walls
from ..scenes.wall_diffraction import expected, interference_shift
from ..timing import once

LIMITS = {"ray": 0.02, "wave": 0.03}
LATTICES: dict[str, dict[str, Any]] = {"square": {}, "hexagonal": {"mla_lattice": "hexagonal"}}

METHODS: dict[str, dict[str, Any]] = {
    "ray": {"method": "ray"},
    "coherent": {"method": "coherent"},
    "K = 2": {"method": "partial", "interleave": 2},
    "auto": {"method": "partial", "interleave": "auto"},
}

INTERFERING = ("coherent", "K = 2")

FREE_OF_MEAN = 0.1
"""Mean over RMS that the difference by interference may have."""

PREDICTED = 1.5
"""RMS of that difference over the predicted one."""

REFERENCE = 400.0
"""Distance of the wall by whose capture the others are divided: none of theirs."""


@case(
    "walls",
    "White walls and ramps that fill the view, refocused by every method: the worst bin against the known radiance",
    {
        "lattice": "{lattice}", "lenses": "{lenses}", "g (mm)": "{distance:g}", "capture": "{model}",
        "method": "{method}", "wall": "{wall}", "worst bin": "{worst:.4f}", "limit": "{limit:g}",
        "explained by": "{explained}", "not reached": "{unreached:.1%}", "s": "{seconds:.1f}",
        "from what diffraction leaves": "{diffraction:.4f}", "contrast of white": "{contrast:.2f}",
        "RMS of interference": "{rms:.4f}", "predicted": "{predicted:.4f}", "mean": "{mean:.4f}",
        "worst bin without": "{without:.4f}",
    },
    (at_most("unexplained", "limit"),),
    page="docs/theory/image_quality.md",
    pivot=Pivot("{lenses} lenses, {model} capture, {lattice}, {wall}, {method}", "{distance:g} mm", "{worst:.3f}"),
    quick={"lenses": (12,), "lattices": ("square",), "distances": (210.0,), "methods": ("ray", "coherent")},
)  # fmt: skip
def compare(
    *,
    lenses: tuple[int, ...] = (24, 128),
    pixels: int = 32,
    distances: tuple[float, ...] = (150.0, 210.0, 280.0, 1000.0, math.inf),
    lattices: tuple[str, ...] = (),
    models: tuple[str, ...] = tuple(LIMITS),
    methods: tuple[str, ...] = (),
    spp: int = 16,
) -> Iterator[Row]:
    """Capture and refocus all combinations."""
    for count, lattice, model in itertools.product(lenses, pick(LATTICES, lattices), models):
        camera = PlenopticCamera(detector_width=0.064 * count, resolution=(pixels * count,) * 2, **LATTICES[lattice])
        reference = walls.capture(camera, REFERENCE, "white", model, spp)
        for distance in distances:
            pair = Walls(camera, distance, model, spp, reference)
            for method in pick(METHODS, methods):
                yield from ({"lattice": lattice, "lenses": count, **row} for row in pair.compare(method))


class Walls:
    """The captures of both walls by one camera, and what reconstructions make of them."""

    def __init__(self, camera: PlenopticCamera, distance: float, model: str, spp: int, reference: Capture) -> None:
        self._camera, self._distance, self._model, self._reference = camera, distance, model, reference
        self._free: dict[str, np.ndarray] = {}
        self._captures = {wall: walls.capture(camera, distance, wall, model, spp) for wall in walls.WALLS}

    def compare(self, method: str) -> Iterator[Row]:
        """Refocus the captures by one method, and find the worst bin of each."""
        white = self._reference if method != "ray" or self._model == "wave" else None
        for wall, taken in self._captures.items():
            image, _, seconds = once(lambda taken=taken: self._refocus(taken, method, white))
            worst, limit = self._worst(image, wall), LIMITS[self._model]
            yield {
                "distance": self._distance,
                "model": self._model,
                "method": method + (", white reference" if white else ""),
                "wall": wall,
                "worst": worst,
                "limit": limit,
                "unreached": float(np.isnan(image).mean()),
                "seconds": seconds,
                "unexplained": worst,
                **(self._explanation(image, wall, method, limit) if worst > limit else {}),
            }

    def _explanation(self, image: np.ndarray, wall: str, method: str, limit: float) -> Row:
        """Look for diffraction and interference in an image beyond its limit."""
        found: dict[str, Any] = {}
        if self._model == "wave":
            found["diffraction"] = self._from_expected(image, wall)
            if found["diffraction"] <= limit:
                return found | {"explained": "diffraction", "unexplained": found["diffraction"]}
        if method not in INTERFERING:
            return found
        bright = self._refocus(self._reference, method, None)
        free = self._without_interference(wall)
        difference = image - free
        found["contrast"] = float(np.nanstd(bright) / np.nanmean(bright))
        found["rms"], found["mean"] = _mean(difference**2, bright) ** 0.5, _mean(difference, bright)
        shift = interference_shift(self._camera, self._distance, walls.WAVELENGTH, self._model)
        found["predicted"] = found["contrast"] * shift * walls.SLOPE
        found["without"] = self._worst(free, wall)
        if self._model == "wave":
            found["without"] = min(found["without"], self._from_expected(free, wall))
        predicted = found["rms"] <= PREDICTED * found["predicted"]
        if predicted and abs(found["mean"]) <= FREE_OF_MEAN * found["rms"]:
            found |= {"explained": "interference", "unexplained": found["without"]}
        return found

    def _without_interference(self, wall: str) -> np.ndarray:
        if wall not in self._free:
            self._free[wall] = self._refocus(self._captures[wall], "auto", self._reference)
        return self._free[wall]

    def _refocus(self, taken: Capture, method: str, white: Capture | None) -> np.ndarray:
        wavelength = None if method == "ray" else walls.WAVELENGTH
        options = METHODS[method]
        image = reconstruct(taken, self._distance, wavelength=wavelength, white=white, **options).image
        return image.astype(np.float64)

    def _from_expected(self, image: np.ndarray, wall: str) -> float:
        known = expected(self._camera, self._distance, walls.WAVELENGTH, wall)
        return float(np.nanmax(np.abs(image - known)))

    def _worst(self, image: np.ndarray, wall: str) -> float:
        return float(np.nanmax(np.abs(image - walls.known_radiance(self._camera, wall))))


def _mean(values: np.ndarray, weights: np.ndarray) -> float:
    return float(np.nansum(values * weights) / np.nansum(weights))
