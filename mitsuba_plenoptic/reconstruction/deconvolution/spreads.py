"""The response of bins by waves: means of exact point spreads."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...capture.scene_points import sample_pairs
from ...design import resolution_limit
from ...operator.accuracy import band_for
from ...operator.grid import Grid, place
from ...operator.patch_factors import Fields
from ...operator.tile import Copies, Scatter
from ...operator.units import radiance_weight
from ...optics.rays import cosines_to_slopes
from ...runtime.batches import Box, Part
from ...system.microlenses import upright
from ...system.optical_system import OpticalSystem
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
    points, system = np.array([[0.0, 0.0, depth] for depth in depths]), OpticalSystem(camera, wavelength)
    return Grid.of(system, band_for(_ACCURACY, _MANY), np.concatenate([points, system.lens.farthest(depths)]))


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
    weight = bin_weight(cells) / places.shape[1] * float(lens.open_fraction(*places.mean((0, 1))[:, None])[0])
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
    return radiance_weight(cells.camera, cells.grid.lens, cells.bin_sizes[0] * cells.bin_sizes[1])


def finite_distance(camera: PlenopticCamera, distance: float) -> float:
    """Return a distance; infinity is so far that light is collimated."""
    return min(distance, _INFINITY * camera.focal_length)


_RAYS = 256
"""Square root of the rays of a bin."""

_NO_WAVE = 1.0
"""Wavelength, in nanometres, that the grid is told; nothing depends on it."""


def ray_grid(camera: PlenopticCamera) -> Grid:
    """Lay a grid whose samples are at most half as wide as pixels."""
    camera.require_thin("this is done")
    turned = upright(camera)
    steps = np.array(turned.lattice.grid_step) * (turned.micro_image_pitch / turned.mla_pitch)
    origin = -np.array([camera.detector_width, camera.detector_height]) / 2
    pitch = steps / np.ceil(2 * steps / camera.pixel_size)
    system, band = OpticalSystem(turned, _NO_WAVE), band_for(0.5, 1)
    lens = system.waves_of(np.empty((0, 3)))
    return Grid(turned, lens, system.microlenses, camera.mla_rotation, _NO_WAVE, band, 0.0, pitch, origin)


@dataclass(frozen=True)
class RayBatch:
    """The rays of one bin.

    Attributes
    ----------
    cells : Cells
        How bins are gathered.
    distance : float
        Of the object plane.
    corner : float64 array (2,)
        Place of the bin's first corner on the MLA.
    """

    cells: Cells
    distance: float
    corner: NDArray[np.float64]

    @property
    def samples(self) -> int:
        """Rays."""
        return _RAYS**2

    def prepare(self) -> Callable[[], Part]:
        """Return the function that traces the rays."""
        return functools.partial(_trace, self)


def ray_batches(cells: Cells, distance: float, cell: NDArray[np.int64]) -> list[list[RayBatch]]:
    """Return for each bin of a cell the batch whose sum is its response, as `wave_batches` does."""
    half = np.array(cells.bin_sizes) / 2
    return [[RayBatch(cells, distance, places[0] - half)] for places in cells.bin_places(cell)]


@functools.cache
def _pairs() -> NDArray[np.float64]:
    return sample_pairs(_RAYS**2)


def _trace(batch: RayBatch) -> Part:
    """Trace the rays of a bin, and share each among the four samples around."""
    cells, grid, camera = batch.cells, batch.cells.grid, batch.cells.camera
    lens, light, lattice = grid.lens, grid.lens.bind(np.empty((0, 3))), camera.lattice
    pairs, b, z = _pairs(), camera.mla_distance, camera.detector_distance
    q = batch.corner + pairs[:, :2] * cells.bin_sizes
    radius, angle = lens.pupil_radius * np.sqrt(pairs[:, 2]), 2 * np.pi * pairs[:, 3]
    pupil = radius * np.cos(angle), radius * np.sin(angle)
    g = finite_distance(camera, batch.distance)
    point = -q[:, 0] * g / b, -q[:, 1] * g / b, np.full(len(q), g)
    if camera.lens_model == "ideal":
        m = light.land(pupil, point)
    else:
        slopes = cosines_to_slopes(*light.cosines(pupil, point))
        m = tuple(P + b * t for P, t in zip(pupil, slopes, strict=True))
    index = lattice.cell(*m)
    offset = [place - centre for place, centre in zip(m, lattice.centre(*index), strict=True)]
    passes = lattice.in_aperture(*offset)
    types = lattice.lens_type(*index).astype(int) if len(camera.mla_focal_lengths) > 1 else 0
    f2 = np.array(camera.mla_focal_lengths)[types]
    # the inverse of `optics.rays.microlens_slope`
    landed = np.stack([x - z * ((P - x) / b + dx / f2) for x, P, dx in zip(m, pupil, offset, strict=True)], axis=-1)
    place = ((landed - grid.origin) / grid.pitch)[passes]
    below = np.floor(place).astype(np.int64)
    low = below.min(0)
    columns, rows = (below.max(0) - low + 2).tolist()
    sums = np.zeros(rows * columns)
    over = place - below
    for right in (0, 1):
        for down in (0, 1):
            weight = np.abs(1 - right - over[:, 0]) * np.abs(1 - down - over[:, 1])
            number = (below[:, 1] - low[1] + down) * columns + below[:, 0] - low[0] + right
            sums += np.bincount(number, weight, len(sums))
    sums *= bin_weight(cells) / (len(pairs) * grid.pitch.prod())
    return Part(Box(int(low[0]), int(low[1]), columns, rows), sums.reshape(1, rows, columns).astype(np.float32))
