"""Number of wavelengths at which point spreads must be computed for light of a band."""

import itertools
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from ..errors import require_number
from ..optics import Spectrum
from ..runtime import Floats
from .operator import CaptureOperator

_COUNTS = (1, 2, 4, 6, 8, 10, 12, 16, 24, 32, 48, 64)
"""Nodes that are tried; more would resolve fringes that no detector does."""


def with_enough_nodes(camera: PlenopticCamera, points: Any, spectrum: Spectrum, error: float) -> Spectrum:
    """Return a spectrum with as few nodes as accurate point spreads need.

    The number is raised in steps until images of each point, in every channel, change by no more than half of the
    error; the other half allows for the remaining error.

    `points` are a few representative points; `error` is relative (L2) and applies to the image of each channel.
    """
    error = require_number("error", error, positive=True)
    points = np.asarray(points, np.float64)
    most = len(set(spectrum.wavelengths))

    def images(count: int, recorded: PlenopticCamera) -> list[Floats]:
        chosen = spectrum.interpolated(count)
        return [
            CaptureOperator(recorded, points[some], spectrum=chosen, accuracy=0.0, virtual=True).forward(
                np.ones((len(some), len(spectrum.wavelengths)))
            )
            for some in np.arange(len(points))[:, None]
        ]

    counts = [count for count in _COUNTS if count < most] + [most] * (most <= _COUNTS[-1])
    last = images(counts[0], camera)
    # What the points light is a small part of a large detector.
    recorded, rows, columns = _recording(camera, last)
    last = [image[rows, columns] for image in last]
    for count, more in itertools.pairwise(counts):
        finer = images(more, recorded)
        # In the channel where the relative difference (L2) is largest.
        norms, changes = (
            np.sqrt(np.sum(np.square(of_points, dtype=np.float64), axis=(1, 2)))
            for of_points in (np.stack(finer), np.subtract(last, finer))
        )
        if (changes <= error / 2 * norms)[norms > 0].all():
            return spectrum.interpolated(count)
        last = finer
    return spectrum.interpolated(counts[-1])


def _recording(camera: PlenopticCamera, images: list[Floats]) -> tuple[PlenopticCamera, slice, slice]:
    """Return a crop of the camera that records all light of the images, and the rows and columns of the crop."""
    lit = np.any([image.any(2) for image in images], axis=0)
    lit_lines = [np.flatnonzero(lit.any(axis)) for axis in (1, 0)]
    rows, columns = (
        slice(int(some[0]), int(some[-1]) + 1) if len(some) else slice(0, size)
        for some, size in zip(lit_lines, camera.shape, strict=True)
    )
    offset = camera.crop_offset[0] + columns.start, camera.crop_offset[1] + rows.start
    size = columns.stop - columns.start, rows.stop - rows.start
    return camera.replace(crop_offset=offset, crop_size=size), rows, columns
