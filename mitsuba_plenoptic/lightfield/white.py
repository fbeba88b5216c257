"""The white image of a camera, computed: each pixel's share of the open pupil."""

from __future__ import annotations

import math

import numpy as np

from ..camera import PlenopticCamera
from ..errors import InputError
from ..limits import require_memory
from .geometry import pupil_step
from .grid import LensGrid, lens_grid

# Points across a pixel for the area of what the pupil's edge leaves of it: exact to 0.2 % of the pixel.
_POINTS = 8

# Pixels times points of lenses, an hour.
_MOST_WORK = 1e11


def white_image(camera: PlenopticCamera, grid: LensGrid | None = None) -> np.ndarray:
    r"""Compute what a camera records of a scene of uniform radiance 1.

    Seen through a point m of its lens, a pixel covers a square of the pupil of side :math:`\Delta p\, b/z`, whose
    place moves with m by :math:`1 + b/z - b/f_2` times as much. Its value is the share of the pupil's disc in that
    square, averaged over the lens; where micro-images overlap, their light adds.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    grid : LensGrid, optional
        Micro-image centres; default those of the camera.

    Returns
    -------
    (rows, columns) float32 array

    Raises
    ------
    InputError
        If micro-images are so wide or so much out of focus that it would take an hour, or too much memory.
    """
    grid = lens_grid(camera) if grid is None else grid
    radius = camera.aperture_radius / pupil_step(camera)
    b, z = camera.mla_distance, camera.detector_distance
    # Full width, in pixels, over which the lens smears a pixel's view of the pupil.
    smear = camera.mla_pitch * abs(1 + b / z - b / camera.mla_focal_length) / pupil_step(camera)
    points = 1 + 2 * round(smear)

    half = math.ceil(radius + smear / 2 + 1)
    rows, columns = camera.shape
    work = float(min(grid.shape[0], rows + 2 * half)) * grid.shape[1] * (2 * half + 1) ** 2 * points**2
    if not work <= _MOST_WORK:
        raise InputError(
            f"camera: its white image takes {work:.2g} evaluations, at most {_MOST_WORK:.2g} are made: micro-images "
            f"are {2 * radius:.3g} pixels wide and smeared over {smear:.3g}"
        )
    require_memory(
        4.0 * (rows + 2 * half) * (columns + 2 * half) + 64.0 * grid.shape[1] * (2 * half + 1) ** 2,
        f"white image of {columns} x {rows} pixels, {2 * half + 1} x {2 * half + 1} for each lens",
    )
    shifts = ((np.arange(points) + 0.5) / points - 0.5) * smear
    image = np.zeros((rows + 2 * half, columns + 2 * half), dtype=np.float32)
    window = np.arange(-half, half + 1)
    for row in grid.centres():
        # Those whose micro-image reaches the detector.
        row = row[((row > -half) & (row < [columns + half, rows + half])).all(1)]
        base = np.floor(row).astype(np.int64)
        # Centre of each pixel from the centre of the micro-image.
        x, y = (base[:, axis, None] + window + 0.5 - row[:, axis, None] for axis in (0, 1))
        share = np.zeros((len(base), window.size, window.size))
        for dy in shifts:
            for dx in shifts:
                share += _square_in_disc(x[:, None, :] + dx, y[:, :, None] + dy, radius)
        down = base[:, 1, None, None] + window[:, None] + half
        across = base[:, 0, None, None] + window + half
        keep = (down >= 0) & (down < image.shape[0]) & (across >= 0) & (across < image.shape[1])
        keep &= share > 0
        place = (down * image.shape[1] + across)[keep]
        first = place.min(initial=image.size)
        added = np.bincount(place - first, weights=share[keep] / points**2)
        image.reshape(-1)[first : first + added.size] += added
    return image[half : half + rows, half : half + columns]


def _square_in_disc(x: np.ndarray, y: np.ndarray, radius: float) -> np.ndarray:
    """Share of a unit square centred at (x, y) that lies within a disc of this radius about the origin."""
    x, y = np.broadcast_arrays(x, y)
    distance = np.hypot(x, y)
    share = (distance < radius).astype(np.float64)
    edge = np.abs(distance - radius) < math.sqrt(0.5)
    offsets = (np.arange(_POINTS) + 0.5) / _POINTS - 0.5
    chord = np.sqrt(np.maximum(0, radius**2 - (x[edge][:, None] + offsets) ** 2))
    low, high = y[edge][:, None] - 0.5, y[edge][:, None] + 0.5
    share[edge] = np.maximum(0, np.minimum(high, chord) - np.maximum(low, -chord)).mean(1)
    return share
