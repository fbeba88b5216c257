"""Grids of voxels, particles drawn on them, and what tells how well a reconstructed volume shows the particles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy.spatial import cKDTree
from scipy.special import ndtr

from ...camera import PlenopticCamera
from ...errors import put, refuse_if, require_count, require_numbers, suggest_keywords
from ...runtime import MILLIMETRES, POINTS, Array, Doubles, Sizes, as_array, require_units
from .seeding import ParticleVolume, as_points

_TRUNCATED = 4.0
"""Standard deviations beyond which a drawn particle is left out."""


@suggest_keywords
@dataclass(frozen=True)
class VoxelGrid(ParticleVolume):
    """A box cut into equal voxels, with the corners `lower` and `upper`.

    Parameters
    ----------
    shape : (int, int, int)
        Numbers of voxels along z, y and x, as arrays have them.
    """

    shape: Sizes

    def __post_init__(self) -> None:
        super().__post_init__()
        put(self, shape=tuple(require_count("shape", n) for n in require_numbers("shape", self.shape, count=3)))
        refuse_if(math.prod(self.shape) > 10**8, f"shape = {self.shape}: 1e+08 voxels at most")

    @property
    def voxel(self) -> Doubles:
        """Size of a voxel along x, y and z in millimetres."""
        return self.size / np.array(self.shape[::-1])

    @property
    def axes(self) -> list[Doubles]:
        """Centres of the voxels along x, y and z."""
        return [(edges[1:] + edges[:-1]) / 2 for edges in self.edges]

    @property
    def edges(self) -> list[Doubles]:
        """Bounds of the voxels along x, y and z."""
        parts = zip(self.lower, self.voxel, self.shape[::-1], strict=True)
        return [low + size * np.arange(count + 1) for low, size, count in parts]

    @property
    def points(self) -> Doubles:
        """Centres of all voxels, (n, 3), in mm; a `CaptureOperator` takes what `Window.apparent` makes of them."""
        x, y, z = self.axes
        return np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], -1).reshape(-1, 3)

    def labelled(self, values: Array, **attributes: str | float) -> xr.DataArray:
        """Return values of all voxels with their coordinates in millimetres."""
        places = {name: (name, axis, {"units": "mm"}) for name, axis in zip("zyx", self.axes[::-1], strict=True)}
        return xr.DataArray(np.reshape(values, self.shape), places, tuple("zyx"), attrs=attributes)


def values_of(*volumes: xr.DataArray) -> list[Doubles]:
    """Return the values of volumes along z, y and x; refuse different voxels, and values that are not finite."""
    for volume in volumes:
        require_units("volume", volume, dict.fromkeys("zyx", MILLIMETRES))
    for axis in "zyx":
        first, *others = (volume[axis].values for volume in volumes)
        # Of a part of a voxel, and of a place in single precision, as files have them.
        allowed = 1e-4 * np.ptp(first) / max(len(first) - 1, 1)
        refuse_if(
            any(first.shape != other.shape or not np.allclose(other, first, 2e-7, allowed) for other in others),
            f"volumes: they must be on the same voxels, but differ in {axis}",
        )
    return [as_array("volume", volume, tuple("zyx"), shape=(None,) * 3) for volume in volumes]


def drawn_particles(grid: VoxelGrid, positions: Doubles, weights: Doubles, width: Sequence[float]) -> xr.DataArray:
    """Return a volume of particles as normal curves, integrated over voxels, which add up to the particles' weights.

    Parameters
    ----------
    grid : VoxelGrid
        The voxels.
    positions : float64 array (n, 3)
        Positions in mm; light beyond the grid is lost.
    weights : float64 array (n,)
        Light of each particle.
    width : (float, float, float)
        Standard deviations along x, y and z in mm, half a voxel at least.
    """
    deviations = require_numbers("width", width, count=3, minimum=1e-9)
    positions = as_points("positions", positions)
    weights = as_array("weights", weights, POINTS, shape=(len(positions),))
    # Narrower ones do not show where in a voxel they are.
    refuse_if(
        (deviations < (1 - 1e-9) * 0.5 * grid.voxel).any(),
        f"width = {tuple(width)}: it must be half a voxel at least, of {tuple(grid.voxel.tolist())}",
    )
    # Parts of each particle's light in the voxels of an axis, (particles, voxels).
    parts = [
        np.diff(ndtr(((edges - centres[:, None]) / deviation).clip(-_TRUNCATED, _TRUNCATED)))
        / (2 * ndtr(_TRUNCATED) - 1)
        for edges, centres, deviation in zip(grid.edges, positions.T, deviations, strict=True)
    ]
    values = np.zeros(grid.shape)
    for weight, *lines in zip(weights, *parts[::-1], strict=True):
        lit = [np.flatnonzero(line) for line in lines]
        z, y, x = (line[voxels] for line, voxels in zip(lines, lit, strict=True))
        values[np.ix_(*lit)] += weight * z[:, None, None] * y[:, None] * x
    return grid.labelled(values)


def quality(volume: xr.DataArray, reference: xr.DataArray) -> float:
    """Return the correlation Q of a volume with its reference, without subtracting means.

    Elsinga, Scarano, Wieneke and van Oudheusden 2006, Experiments in Fluids 41, 933, equation 11. It is 1 for volumes
    that are the same but for a factor.

    Parameters
    ----------
    volume, reference : xarray.DataArray (z, y, x)
        The volumes, on the same voxels.
    """
    first, second = values_of(volume, reference)
    size = math.sqrt(float((first**2).sum()) * float((second**2).sum()))
    return float((first * second).sum()) / size if size else 0.0


def ghost_fraction(volume: xr.DataArray, positions: Doubles, reach: Sequence[float]) -> float:
    """Return the part of a volume's light that is farther than `reach` from every particle.

    Parameters
    ----------
    volume : xarray.DataArray (z, y, x)
        The volume.
    positions : float64 array (n, 3)
        Positions of all particles in mm.
    reach : (float, float, float)
        Semi-axes along x, y and z, in mm, of the ellipsoid around a particle that is its own.
    """
    semi_axes = np.array(require_numbers("reach", reach, count=3, minimum=1e-9))
    positions = as_points("positions", positions)
    values = np.maximum(values_of(volume)[0], 0)
    lit = np.argwhere(values > 0)
    light = values[values > 0]
    if not len(light) or not len(positions):
        return float(len(light) > 0)
    places = np.stack([volume[name].values[index] for name, index in zip("xyz", lit.T[::-1], strict=True)], -1)
    away = cKDTree(positions / semi_axes).query(places / semi_axes, distance_upper_bound=1.0)[0]
    return float(light[np.isinf(away)].sum() / light.sum())


def elongation(camera: PlenopticCamera, distance: float) -> float:
    r"""Return how much less precisely the depth of a point is seen than its place across the axis: :math:`\sqrt2 g/a`.

    Each part of the pupil of radius a sees the point from another direction. The slopes of these have the variance
    :math:`(a / g)^2 / 4` along each axis, and both axes tell of the depth, so that the standard deviation of a least
    squares estimate of depth over that of a lateral one is :math:`1 / \sqrt{2 (a / g)^2 / 4}`.
    Slopes before an objective have the mean square :math:`1 / \cos\alpha - 1` over the light, whatever the depth.
    Behind a `Window`, depths are longer by 1 / `ratio` than those that the camera sees, `seen`.

    Parameters
    ----------
    distance : float
        Distance g of the point from the main lens, in mm, where the camera sees it.
    """
    if camera.objective is not None:
        return (1 / math.cos(camera.objective.half_angle) - 1) ** -0.5
    return math.sqrt(2) * distance / camera.aperture_radius
