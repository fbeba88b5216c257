"""Number of wavelengths at which point spreads must be computed for light of a band."""

import itertools
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from ..errors import require_number
from ..optics import Spectrum
from ..runtime import Floats
from .operator import CaptureOperator
from .pupil_weights import PupilWeights

_COUNTS = (1, 2, 4, 6, 8, 10, 12, 16, 24, 32, 48, 64)
"""Nodes that are tried; more would resolve fringes that no detector does."""


def with_enough_nodes(
    camera: PlenopticCamera,
    points: Any,
    spectrum: Spectrum,
    error: float,
    pupil_weights: Any = None,
) -> Spectrum:
    """Return a spectrum with as few nodes as accurate point spreads need.

    The number is raised in steps until images of each point, in every channel, change by no more than half of the
    error; the other half allows for the remaining error.

    `points` are a few representative points; `error` is relative (L2) and applies to the image of each channel.
    """
    error = require_number("error", error, positive=True)
    weights = PupilWeights.of(pupil_weights, len(points))
    points = np.asarray(points, np.float64)
    most = len(set(spectrum.wavelengths))

    def images(count: int, recorded: PlenopticCamera) -> list[Floats]:
        chosen = spectrum.interpolated(count)
        return [
            CaptureOperator(
                recorded,
                points[some],
                spectrum=chosen,
                accuracy=0.0,
                pupil_weights=None if weights is None else weights.take(some),
                virtual=True,
            ).forward(np.ones((len(some), len(spectrum.wavelengths))))
            for some in np.arange(len(points))[:, None]
        ]

    counts = [count for count in _COUNTS if count < most] + [most] * (most <= _COUNTS[-1])
    last = images(counts[0], camera)
    # What the points light is a small part of a large detector.
    recorded, rows, columns = _recording(camera, last)
    last = [image[rows, columns] for image in last]
    for count, more in itertools.pairwise(counts):
        finer = images(more, recorded)
        if all(_differ(a, b) <= error / 2 for a, b in zip(last, finer, strict=True)):
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


def _differ(image: Floats, reference: Floats) -> float:
    """Return the relative difference (L2) between images, in the channel where it is largest."""
    norms = np.sqrt(np.sum(np.square(reference, dtype=np.float64), axis=(0, 1)))
    change = np.sqrt(np.sum(np.square(image - reference, dtype=np.float64), axis=(0, 1)))
    return float(np.max(change[norms > 0] / norms[norms > 0], initial=0.0))
