"""Which part of an image to show, how bright, and where to look closely."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..camera import PlenopticCamera
from .experiment import Experiment


class Window(NamedTuple):
    """A part of an image in fractions of its height and width."""

    top: float
    bottom: float
    left: float
    right: float

    def of(self, image: np.ndarray) -> np.ndarray:
        """Cut the part out of an image."""
        rows, columns = image.shape[:2]
        return image[
            round(self.top * rows) : round(self.bottom * rows), round(self.left * columns) : round(self.right * columns)
        ]

    @property
    def aspect(self) -> float:
        """Height over width, for a square image."""
        return (self.bottom - self.top) / (self.right - self.left)


class Zoom(NamedTuple):
    """A place on the detector to look at closely: a title, and a window of whole pixels."""

    title: str
    rows: slice
    columns: slice


def lit_window(images: Sequence[np.ndarray], *, fraction: float = 0.03, margin: float = 0.05) -> Window:
    """Find the part of the field, the same distance from its middle on both sides, that holds the light of images."""
    reach = []
    for axis in (1, 0):
        ends = []
        for image in images:
            lit = np.flatnonzero(image.max(axis=axis) > fraction * image.max())
            middle = image.shape[1 - axis] / 2
            if lit.size:
                ends.append(max(abs(lit[0] - middle), abs(lit[-1] + 1 - middle)) / (2 * middle))
        reach.append(min(0.5, max(ends, default=0.5) + margin))
    return Window(0.5 - reach[0], 0.5 + reach[0], 0.5 - reach[1], 0.5 + reach[1])


def common_peak(images: Sequence[np.ndarray], window: Window) -> float:
    """Choose the value that becomes white: all but glints stay below it."""
    return max(float(np.nanquantile(window.of(image), 0.997)) for image in images)


def letter_zooms(experiment: Experiment, letters: Mapping[str, str], lenses: int = 8) -> list[Zoom]:
    """Look closely at the micro-images in the middle of each of some shapes, given with titles by their ids."""
    zooms = []
    for name, title in letters.items():
        low, high = experiment.boxes[name]
        middle = (low + high) / 2
        zooms.append(_zoom(title, experiment.camera, -middle[:2] / middle[2], lenses))
    return zooms


def brightest_zoom(experiment: Experiment, lenses: int = 8) -> Zoom:
    """Look closely at where a capture has most contrast from lens to lens."""
    camera = experiment.camera
    columns, rows = camera.bin_count
    means = _resize_mean(experiment.ray.image, rows, columns)
    gradient = np.hypot(*np.gradient(means))
    half = lenses // 2
    inner = gradient[half : rows - half, half : columns - half]
    row, column = np.unravel_index(np.argmax(inner), inner.shape) if inner.size else (0, 0)
    slopes = (np.array([column, row]) + half - np.array([columns, rows]) / 2) * camera.mla_pitch / camera.mla_distance
    return _zoom(f"{lenses} x {lenses} lenses", camera, slopes, lenses)


def _zoom(title: str, camera: PlenopticCamera, slopes: np.ndarray, lenses: int) -> Zoom:
    """Window of whole micro-images around where the chief ray of given slopes (x, y) meets the detector."""
    half = lenses / 2 * camera.micro_image_pitch / camera.pixel_size
    pitch = camera.micro_image_pitch
    spans = []
    for axis in (1, 0):
        at = round(slopes[axis] * camera.mla_distance / camera.mla_pitch) * pitch / camera.pixel_size
        middle = camera.resolution[axis] / 2 + at
        size = round(2 * half)
        first = min(max(0, round(middle - half)), max(0, camera.resolution[axis] - size))
        spans.append(slice(first, first + size))
    return Zoom(title, spans[0], spans[1])


def _resize_mean(image: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Average an image over a grid of cells."""
    by_row = np.stack([part.mean(axis=0) for part in np.array_split(image, rows, axis=0)])
    return np.stack([part.mean(axis=1) for part in np.array_split(by_row, columns, axis=1)], axis=1)
