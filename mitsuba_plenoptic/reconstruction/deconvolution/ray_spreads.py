"""The response of bins by rays: where the rays from all of a bin through all of the pupil land."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...capture.accuracy import band_for
from ...capture.grid import Grid
from ...capture.scene_points import sample_pairs
from ...optics.main_lens import main_lens
from ...optics.microlenses import upright
from ...optics.rays import cosines_to_slopes
from ...runtime.batches import Box, Part
from .cells import Cells
from .wave_spreads import bin_weight, finite_distance

_RAYS = 256
"""Square root of the rays of a bin."""

_NO_WAVE = 1.0
"""Wavelength, in nanometres, that the grid is told; nothing depends on it."""


def ray_grid(camera: PlenopticCamera) -> Grid:
    """Lay a grid whose samples are at most half as wide as pixels."""
    turned = upright(camera)
    steps = np.array(turned.lattice.grid_step) * (turned.micro_image_pitch / turned.mla_pitch)
    origin = -np.array([camera.detector_width, camera.detector_height]) / 2
    pitch = steps / np.ceil(2 * steps / camera.pixel_size)
    return Grid(turned, main_lens(camera), camera.mla_rotation, _NO_WAVE, band_for(0.5, 1), 0.0, pitch, origin)


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
    lens, lattice = main_lens(camera), camera.lattice
    pairs, b, z = _pairs(), camera.mla_distance, camera.detector_distance
    q = batch.corner + pairs[:, :2] * cells.bin_sizes
    radius, angle = lens.pupil_radius * np.sqrt(pairs[:, 2]), 2 * np.pi * pairs[:, 3]
    pupil = radius * np.cos(angle), radius * np.sin(angle)
    g = finite_distance(camera, batch.distance)
    point = -q[:, 0] * g / b, -q[:, 1] * g / b, np.full(len(q), g)
    if camera.lens_model == "ideal":
        m = lens.land(pupil, point)
    else:
        slopes = cosines_to_slopes(*lens.cosines(pupil, point))
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
