"""Parts of images that figures show: the lit part of the field, and close-ups of whole micro-images."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..camera import PlenopticCamera
from ..runtime import Array
from .experiment import Experiment

_LENSES = 8
"""Microlenses across a close-up."""


class Window(NamedTuple):
    """Part of an image, given in fractions of its height and width."""

    top: float
    bottom: float
    left: float
    right: float
    field_aspect: float = 1.0

    def of(self, image: Array) -> Array:
        """Return the part of an image that the window shows."""
        rows, columns = image.shape[:2]
        return image[
            round(self.top * rows) : round(self.bottom * rows), round(self.left * columns) : round(self.right * columns)
        ]

    @property
    def aspect(self) -> float:
        """Height of the window over its width."""
        return self.field_aspect * (self.bottom - self.top) / (self.right - self.left)


class Zoom(NamedTuple):
    """A close-up of the detector: a title, and a window of whole pixels."""

    title: str
    rows: slice
    columns: slice


def lit_window(images: Sequence[Array], *, fraction: float = 0.03, margin: float = 0.05) -> Window:
    """Return the part of the field, symmetric about its middle, that contains the light of all images."""
    ends = []
    for image in images:
        lit = np.argwhere(image > fraction * np.nanmax(image))[:, :2]
        size = np.array(image.shape[:2])
        if lit.size:
            ends.append((np.abs([lit - size / 2, lit + 1 - size / 2]) / size).max(axis=(0, 1)))
    down, right = np.minimum(0.5, np.max(ends, axis=0) + margin).tolist() if ends else (0.5, 0.5)
    rows, columns = images[0].shape[:2]
    return Window(0.5 - down, 0.5 + down, 0.5 - right, 0.5 + right, rows / columns)


def brightest_zoom(experiment: Experiment) -> Zoom:
    """Return a close-up at the place where a capture has the most contrast from lens to lens."""
    camera = experiment.camera
    columns, rows = (round(count * camera.pixel_size / camera.micro_image_pitch) for count in camera.resolution)
    of_lenses = experiment.ray.image
    for axis, count in enumerate((rows, columns)):
        of_lenses = np.stack([block.mean(axis) for block in np.array_split(of_lenses, count, axis)], axis)
    gradient = np.hypot(*np.gradient(of_lenses))
    half = _LENSES // 2
    inner = gradient[half : rows - half, half : columns - half]
    row, column = np.unravel_index(np.argmax(inner), inner.shape) if inner.size else (0, 0)
    slopes = (np.array([column, row]) + half - np.array([columns, rows]) / 2) * camera.row_pitch / camera.mla_distance
    return zoom_at(f"{_LENSES} x {_LENSES} lenses", camera, slopes)


def zoom_at(title: str, camera: PlenopticCamera, slopes: Array) -> Zoom:
    """Return a close-up of whole micro-images around the detector point of a chief ray with slopes (x, y)."""
    half = _LENSES / 2 * camera.micro_image_pitch / camera.pixel_size
    pitch = camera.micro_image_pitch
    spans = []
    for axis in (1, 0):
        at = round(slopes[axis] * camera.mla_distance / camera.row_pitch) * pitch / camera.pixel_size
        middle = camera.resolution[axis] / 2 + at
        size = round(2 * half)
        first = min(max(0, round(middle - half)), max(0, camera.resolution[axis] - size))
        spans.append(slice(first, first + size))
    return Zoom(title, *spans)
