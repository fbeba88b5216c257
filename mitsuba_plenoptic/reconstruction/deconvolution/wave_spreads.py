"""The response of bins by waves: means of exact point spreads."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...capture.accuracy import band_for
from ...capture.grid import Grid, place
from ...capture.patch_batches import Fields, Scatter
from ...capture.tile import Copies
from ...capture.units import radiance_weight
from ...design import resolution_limit
from ...optics.fitted_lens import FittedLens, farthest_points
from ...optics.open_pupil import open_fraction
from .cells import Cells

_ACCURACY = 0.01
"""Relative error for which the grid, and what is kept of the diffracted light, are chosen."""

_MANY = 2**20

_RADIATORS, _MOST_RADIATORS = 8, 32
"""Points along a lens, at least and at most, whose mean stands for the light of its bins."""

_RADIATORS_PER_LINE = 4
"""The same along a period of the finest lines that the plane's light tells apart."""

_INFINITY = 1e6
"""Focal lengths at which light counts as collimated."""


def wave_grid(camera: PlenopticCamera, distances: Sequence[float], wavelength: float) -> Grid:
    """Lay the grid that holds the light of planes at some distances."""
    depths = [finite_distance(camera, distance) for distance in distances]
    points = np.array([[0.0, 0.0, depth] for depth in depths])
    if camera.prescription is not None:
        points = np.concatenate([points, farthest_points(camera, wavelength, depths)])
    return Grid.of(camera, wavelength, band_for(_ACCURACY, _MANY), points)


def wave_batches(cells: Cells, distance: float, cell: NDArray[np.int64]) -> list[list[Scatter]]:
    """Return for each bin of a cell the batches whose sums, added, are its response.

    Parameters
    ----------
    cells : Cells
        The cells.
    distance : float
        Of the object plane.
    cell : int64 array (2,)
        The cell.

    Returns
    -------
    list of lists of Scatter
        Sums over samples of the grid, as intensity per square millimetre of a bin of radiance 1.
    """
    grid = cells.grid
    depth = finite_distance(cells.camera, distance)
    lens = grid.lens
    nearness = float(lens.nearness(np.array([[0.0, 0.0, depth]]))[0])
    places = cells.bin_places(cell, math.ceil(_points(cells, distance) / cells.oversample))
    weight = bin_weight(cells) / places.shape[1]
    if isinstance(lens, FittedLens):
        weight *= float(open_fraction(cells.camera, *places.mean((0, 1))[:, None])[0])
        places = lens.within(places)
    batches = []
    for points in places:
        positions = lens.points(points, np.full(len(points), nearness))
        placement = place(grid, positions)
        groups = [np.flatnonzero(placement.samples == size) for size in np.unique(placement.samples)]
        copy = Copies(np.zeros((1, 2), np.int64), np.full((1, 1), weight, np.float32))
        batches.append(
            [
                Scatter(
                    Fields(grid, placement.take(some), positions[some], None), np.ones(len(some)), [copy] * len(some)
                )
                for some in groups
            ]
        )
    return batches


def _points(cells: Cells, distance: float) -> int:
    """Return how many points along a lens stand for its bins."""
    camera = cells.camera
    limit = resolution_limit(camera, distance, cells.grid.wavelength)
    lines = 0.0 if limit.in_focus else limit.frequency / (2 * limit.lenses)  # along a lens
    return max(_RADIATORS, min(_MOST_RADIATORS, math.ceil(_RADIATORS_PER_LINE * lines)))


def bin_weight(cells: Cells) -> float:
    """Return what all pixels together record of a bin of radiance 1, where no light is lost."""
    return radiance_weight(cells.camera, cells.bin_sizes[0] * cells.bin_sizes[1])


def finite_distance(camera: PlenopticCamera, distance: float) -> float:
    """Return a distance; infinity is so far that light is collimated."""
    return min(distance, _INFINITY * camera.focal_length)
