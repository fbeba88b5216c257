"""White walls and ramps, refocused at their own distance by every method: every bin that is reached, to the border.

A wall of radiance 1 and one whose radiance rises from 0.5 to 1.5 across the field stand at a distance, or are the sky.
They fill all that the camera sees, and the ramp goes on beyond the field. They are captured by rays and by waves
through square and hexagonal lattices. Each capture is refocused to the wall by every method, ray captures by rays
without a white reference, all others with that of another white wall, at 400 mm, as one: so that white walls are
judged, too. The worst bin is compared with the radiance that is known. Bins that are NaN are not reached; their part is
told.

Where an image of a capture by waves is beyond its limit, it is compared with what the diffraction of the microlenses
leaves of the wall (`diffraction`, from the picture of a lens and the pupil alone): rows that are within the limit of
that are told as "diffraction".

Where a coherent or partially coherent image is beyond it still, the table says what of it is
interference, which these methods have by their nature: its difference from the image in which no two lenses interfere
(`auto`). That difference must have no mean where bins are weighted by what they get of white, since interference moves
power between bins and makes none; its RMS must be no more than half as much again as `interference` predicts for lenses
of random phases (a field of few fringes scatters by that much); and the image without it must be within the limit, of
the radiance or of what diffraction leaves of it. Such rows are told as "interference", all others beyond their limit as
"BROKEN".

    python tools/reconstruction_accuracy.py --output out [--quick] [--lenses 24] [--distances 210 inf] [--models ray]
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
import time
from typing import Any

import accuracy
import diffraction
import interference
import numpy as np
import walls

from mitsuba_plenoptic import Capture, PlenopticCamera, reconstruct

LIMITS = {"ray": 0.02, "wave": 0.03}
LATTICES: dict[str, dict[str, Any]] = {"square": {}, "hexagonal": {"mla_lattice": "hexagonal"}}
METHODS: dict[str, dict[str, Any]] = {
    "ray": {"method": "ray"},
    "coherent": {"method": "coherent"},
    "K = 2": {"method": "partial", "interleave": 2},
    "auto": {"method": "partial", "interleave": "auto"},
}
INTERFERING = ("coherent", "K = 2")
COLUMNS = {
    "lattice": "{lattice}",
    "lenses": "{lenses}",
    "g (mm)": "{distance:g}",
    "capture": "{model}",
    "method": "{method}",
    "wall": "{wall}",
    "worst bin": "{worst:.4f}",
    "limit": "{limit:g}",
    "verdict": "{verdict}",
    "not reached": "{unreached:.1%}",
    "s": "{seconds:.1f}",
    "from what diffraction leaves": "{expected}",
    "contrast of white": "{contrast}",
    "RMS of interference": "{rms}",
    "predicted": "{predicted}",
    "mean": "{mean}",
    "worst bin without": "{without}",
}
FREE_OF_MEAN = 0.1
"""Mean over RMS that the difference by interference may have."""

PREDICTED = 1.5
"""RMS of that difference over the predicted one."""

REFERENCE = 400.0
"""Distance of the wall by whose capture the others are divided: none of theirs."""

_NONE = dict.fromkeys(("expected", "contrast", "rms", "predicted", "mean", "without"), "")


def main() -> int:
    """Capture, refocus, compare, and write the table; 1 if a bin is beyond its limit by more than interference."""
    parser = accuracy.options("reconstruction_accuracy", __doc__)
    parser.add_argument("--quick", action="store_true", help="24 square lenses, 210 and 1000 mm, without auto")
    parser.add_argument("--lenses", type=int, nargs="*", default=[24, 128])
    parser.add_argument("--pixels", type=int, default=32, help="pixels across a lens")
    parser.add_argument("--distances", type=float, nargs="*", default=[150.0, 210.0, 280.0, 1000.0, math.inf])
    parser.add_argument("--lattices", nargs="*", choices=LATTICES, default=list(LATTICES))
    parser.add_argument("--models", nargs="*", choices=LIMITS, default=list(LIMITS))
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=list(METHODS))
    parser.add_argument("--spp", type=int, default=16, help="samples per pixel")
    arguments = accuracy.start(parser)
    if arguments.quick:
        arguments.lenses, arguments.lattices, arguments.distances = [24], ["square"], [210.0, 1000.0]
        arguments.methods = [name for name in METHODS if name != "auto"]
    rows = _rows(arguments)
    accuracy.finish(arguments, rows, accuracy.markdown(COLUMNS, rows))
    return int(any(row["verdict"] == "BROKEN" for row in rows))


def _rows(arguments: argparse.Namespace) -> list[accuracy.Row]:
    """Compare all; rows are printed and kept as they come, since the whole takes hours."""
    rows: list[accuracy.Row] = []
    for lenses, lattice, model in itertools.product(arguments.lenses, arguments.lattices, arguments.models):
        camera = PlenopticCamera(
            detector_width=0.064 * lenses, resolution=(arguments.pixels * lenses,) * 2, **LATTICES[lattice]
        )
        reference = walls.capture(camera, REFERENCE, "white", model, arguments.spp)
        for distance in arguments.distances:
            pair = Walls(camera, distance, model, arguments.spp, reference)
            for method in arguments.methods:
                for row in pair.compare(method):
                    rows.append({"lattice": lattice, "lenses": lenses, **row})
                    print(accuracy.markdown(COLUMNS, rows[-1:]).splitlines()[-1], flush=True)
            (arguments.output / "reconstruction_accuracy.part.json").write_text(json.dumps(rows, indent=1))
    return rows


class Walls:
    """The captures of both walls by one camera, and what reconstructions make of them."""

    def __init__(self, camera: PlenopticCamera, distance: float, model: str, spp: int, reference: Capture) -> None:
        self._camera, self._distance, self._model, self._reference = camera, distance, model, reference
        self._free: dict[str, np.ndarray] = {}
        self._captures = {wall: walls.capture(camera, distance, wall, model, spp) for wall in walls.WALLS}

    def compare(self, method: str) -> list[accuracy.Row]:
        """Refocus the captures by one method, and find the worst bin of each."""
        referred = method != "ray" or self._model == "wave"
        white = self._reference if referred else None
        found = []
        for wall, taken in self._captures.items():
            start = time.process_time()
            image = self._refocus(taken, method, white)
            seconds = time.process_time() - start
            row: accuracy.Row = {
                "distance": self._distance,
                "model": self._model,
                "method": method + (", white reference" if referred else ""),
                "wall": wall,
                "worst": self._worst(image, wall),
                "limit": LIMITS[self._model],
                "unreached": float(np.isnan(image).mean()),
                "seconds": seconds,
            }
            found.append(row | self._verdict(row, image, method))
        return found

    def _verdict(self, row: accuracy.Row, image: np.ndarray, method: str) -> accuracy.Row:
        """Judge a row, and look at what is beyond the limit for interference."""
        if row["worst"] <= row["limit"]:
            return {"verdict": "kept", **_NONE}
        if self._model == "ray":
            expected, found = math.nan, _NONE
        else:
            expected = self._from_expected(image, row["wall"])
            found = _NONE | {"expected": f"{expected:.4f}"}
        if expected <= row["limit"]:
            return {"verdict": "diffraction", **found}
        if method not in INTERFERING:
            return {"verdict": "BROKEN", **found}
        wall = row["wall"]
        bright = self._refocus(self._reference, method, None)
        contrast = float(np.nanstd(bright) / np.nanmean(bright))
        free = self._without_interference(wall)
        difference = image - free
        rms, mean = (_mean(difference**2, bright) ** 0.5, _mean(difference, bright))
        shift = interference.shift(self._camera, self._distance, walls.WAVELENGTH, self._model)
        predicted = contrast * shift * walls.SLOPE
        without = self._worst(free, wall)
        if self._model == "wave":
            without = min(without, self._from_expected(free, wall))
        alone = without <= row["limit"] and abs(mean) <= FREE_OF_MEAN * rms and rms <= PREDICTED * predicted
        figures = {"rms": rms, "predicted": predicted, "mean": mean, "without": without}
        return found | {
            "verdict": "interference" if alone else "BROKEN",
            "contrast": f"{contrast:.2f}",
            **{name: f"{figure:.4f}" for name, figure in figures.items()},
        }

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
        expected = diffraction.expected(self._camera, self._distance, walls.WAVELENGTH, wall)
        return float(np.nanmax(np.abs(image - expected)))

    def _worst(self, image: np.ndarray, wall: str) -> float:
        return float(np.nanmax(np.abs(image - walls.known_radiance(self._camera, wall))))


def _mean(values: np.ndarray, weights: np.ndarray) -> float:
    return float(np.nansum(values * weights) / np.nansum(weights))


if __name__ == "__main__":
    sys.exit(main())
