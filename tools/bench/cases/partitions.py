"""How many propagations a partially coherent reconstruction needs, by the partition of the lenses.

The wave capture of the letters is refocused with every partition. Interference is the RMS distance of a letter from the
image in which every lens is propagated alone, over its mean, in the bins that hold the letter.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mitsuba_plenoptic import Capture, load_scene, read_capture, reconstruct
from mitsuba_plenoptic.extensions.paper.partitions import blocks, coloured, refocused, sublattice
from mitsuba_plenoptic.report.experiment import bounding_boxes
from mitsuba_plenoptic.report.images import write_png
from mitsuba_plenoptic.report.metrics import interference, shape_window

from .. import Pivot, Row, case
from .reconstructions import DISTANCES, letters_captures

LETTERS = {"8": "eight", "F": "f", "#": "hash"}
WAVELENGTH = 633.0
SUFFICIENT = 0.01
KINDS = ("interleaved", "blocks", "sublattice", "colours")


@dataclasses.dataclass(frozen=True)
class Refocused:
    """Images of a capture, by distance, and the bins of each letter."""

    capture: Capture
    windows: dict[str, Any]

    def images(self, distances: tuple[float, ...], **options: Any) -> dict[float, np.ndarray]:
        """Return partially coherent images."""
        results = reconstruct(self.capture, list(distances), method="partial", **options)
        return {each.distance: each.image for each in results}

    def runs(self, kind: str, counts: tuple[int, ...]) -> Iterator[tuple[int, dict[float, np.ndarray]]]:
        """Yield the images by one kind of partition with the count of propagations."""
        camera = self.capture.camera
        for count in counts:
            if kind == "interleaved":
                yield count**2, self.images(DISTANCES, interleave=count)
            elif kind == "blocks":
                yield count**2, refocused(self.capture, DISTANCES, blocks(camera, count))
            else:
                labels = {distance: sublattice(camera, distance, count, WAVELENGTH) for distance in DISTANCES}
                found = [refocused(self.capture, (distance,), each) for distance, each in labels.items()]
                yield count, {distance: image for each in found for distance, image in each.items()}


@case(
    "partitions",
    "Interference that partitions of the lenses leave in the letters, the fewest propagations that leave less than 1 % "
    "(0 where none does), and the subsets that a colouring takes in which no images of lit lenses overlap",
    {
        "partition": "{kind}", "propagations": "{propagations}", "g (mm)": "{distance:g}", "letter": "{letter}",
        "interference": "{shown}",
    },
    page="docs/theory/image_quality.md",
    pivot=Pivot("{kind}, {propagations}", "{letter} at {distance:g} mm", "{shown}"),
    quick={"size": 1024, "periods": (1, 2, 3), "grids": (2,), "counts": (2, 4, 7)},
)  # fmt: skip
def partitions(
    output: Path,
    *,
    size: int = 4096,
    capture: str = "",
    periods: tuple[int, ...] = (1, 2, 3, 4, 5, 6),
    grids: tuple[int, ...] = (2, 3, 4),
    counts: tuple[int, ...] = (2, 3, 4, 5, 6, 7, 8),
) -> Iterator[Row]:
    """Refocus with interleaved subsets, blocks and the best sublattices, and colour the lit lenses."""
    taken = read_capture(capture) if capture else letters_captures(capture, size)["wave"]
    # All channels of a grey film are alike.
    taken = dataclasses.replace(taken, image=np.ascontiguousarray(np.atleast_3d(taken.image)[..., 0]))
    boxes = bounding_boxes(load_scene("letters", parameters={"letter_scale": str(size / 4096)}))
    windows = {letter: shape_window(taken.camera, *boxes[name]) for letter, name in LETTERS.items()}
    refocused = Refocused(taken, windows)
    limits = refocused.images(DISTANCES, interleave="auto")
    pictures: dict[tuple[str, int], np.ndarray] = {}
    for kind, chosen in zip(KINDS, (periods, grids, counts), strict=False):
        fewest = {(distance, letter): 0 for distance in DISTANCES for letter in LETTERS}
        for propagations, images in refocused.runs(kind, chosen):
            pictures[kind, propagations] = images[DISTANCES[-1]]
            for distance, letter in fewest:
                left = interference(images[distance], limits[distance], windows[letter])
                if left < SUFFICIENT and not fewest[distance, letter]:
                    fewest[distance, letter] = propagations
                yield _row(kind, propagations, distance, letter, f"{left:.2%}", interference=left)
        for (distance, letter), count in fewest.items():
            yield _row(kind, "fewest below 1 %", distance, letter, str(count), fewest=count)
    for distance in DISTANCES:
        colours = int(coloured(taken, distance).max()) + 1
        yield from (
            _row("colours", "no overlap", distance, letter, str(colours), colours=colours) for letter in LETTERS
        )
    write_png(output / "partitions.png", _sheet(pictures, limits[DISTANCES[-1]]))


def _sheet(pictures: dict[tuple[str, int], np.ndarray], limit: np.ndarray) -> np.ndarray:
    """Return the images at the last distance, above four times what they add to the limit on grey, from 0 to 1."""
    names = (("interleaved", 1), ("interleaved", 4), ("blocks", 4), ("sublattice", 4), ("sublattice", 7))
    peak = float(np.nanmax(limit))
    columns = [
        np.concatenate([pictures[name], peak / 2 + 4 * (pictures[name] - limit)]) for name in names if name in pictures
    ]
    return np.nan_to_num(np.concatenate(columns, 1) / peak).clip(0, 1).repeat(4, 0).repeat(4, 1)


def _row(kind: str, propagations: int | str, distance: float, letter: str, shown: str, **values: float) -> Row:
    return {
        "kind": kind, "propagations": propagations, "distance": distance, "letter": letter, "shown": shown, **values
    }  # fmt: skip
