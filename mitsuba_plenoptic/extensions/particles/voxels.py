"""Grids of voxels, particles drawn on them, and what tells how well a reconstructed volume shows the particles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.special import ndtr

from ...camera import PlenopticCamera
from ...errors import put, refuse_if, require_count, require_numbers, suggest_keywords
from ...runtime import MILLIMETRES, POINTS, Doubles, as_array, require_units

MOST_VOXELS = 10**8

_TRUNCATED = 4.0
"""Standard deviations beyond which a drawn particle is left out."""

_NARROWEST = 0.5
"""Standard deviation of a drawn particle at least, in voxels: narrower ones do not show where in a voxel they are."""

_ROUNDING = 2e-7
_SAME = 1e-4
"""Differences of voxels' places, over these and over the voxels' size, that are due to files in single precision."""


@suggest_keywords
@dataclass(frozen=True)
class VoxelGrid:
    """A box cut into equal voxels.

    Parameters
    ----------
    lower, upper : (float, float, float)
        Corners in millimetres of the camera frame.
    shape : (int, int, int)
        Numbers of voxels along z, y and x, as arrays have them.

    Raises
    ------
    InputError
        If the box is empty, or has too many voxels.
    """

    lower: tuple[float, ...]
    upper: tuple[float, ...]
    shape: tuple[int, ...]

    def __post_init__(self) -> None:
        for name in ("lower", "upper"):
            put(self, **{name: require_numbers(name, getattr(self, name), count=3, minimum=-1e9, maximum=1e9)})
        put(self, shape=tuple(require_count("shape", n) for n in require_numbers("shape", self.shape, count=3)))
        refuse_if(
            any(low >= high for low, high in zip(self.lower, self.upper, strict=True)),
            f"lower = {self.lower}, upper = {self.upper}: the volume is empty; upper must be beyond lower",
        )
        refuse_if(math.prod(self.shape) > MOST_VOXELS, f"shape = {self.shape}: {MOST_VOXELS:.0e} voxels at most")

    @property
    def voxel(self) -> Doubles:
        """Size of a voxel along x, y and z in millimetres."""
        return np.subtract(self.upper, self.lower) / np.array(self.shape[::-1])

    @property
    def axes(self) -> list[Doubles]:
        """Centres of the voxels along x, y and z."""
        parts = zip(self.lower, self.voxel, self.shape[::-1], strict=True)
        return [low + size * (np.arange(count) + 0.5) for low, size, count in parts]

    @property
    def points(self) -> Doubles:
        """Centres of all voxels, (n, 3), for a `CaptureOperator`."""
        x, y, z = self.axes
        return np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], -1).reshape(-1, 3)

    def labelled(self, values: NDArray[Any], **attributes: str | float) -> xr.DataArray:
        """Return values of all voxels with their coordinates in millimetres."""
        x, y, z = ((name, axis, {"units": "mm"}) for name, axis in zip("xyz", self.axes, strict=True))
        return xr.DataArray(
            np.reshape(values, self.shape), dims=tuple("zyx"), coords={"z": z, "y": y, "x": x}, attrs=attributes
        )


def values_of(*volumes: xr.DataArray) -> list[Doubles]:
    """Return the values of volumes along z, y and x; refuse different voxels, and values that are not finite."""
    for volume in volumes:
        require_units("volume", volume, dict.fromkeys("zyx", MILLIMETRES))
    for axis in "zyx":
        first, *others = [volume[axis].values for volume in volumes]
        allowed = _SAME * np.ptp(first) / max(len(first) - 1, 1)
        refuse_if(
            any(first.shape != volume.shape or not np.allclose(volume, first, _ROUNDING, allowed) for volume in others),
            f"volumes: they must be on the same voxels, but differ in {axis}",
        )
    values = [as_array("volume", volume, np.float64, tuple("zyx")) for volume in volumes]
    refuse_if(not all(np.isfinite(volume).all() for volume in values), "volumes: their voxels must be finite")
    return values


def require_points(name: str, points: ArrayLike) -> Doubles:
    """Return points (n, 3) as floats; refuse other shapes, and points that are not finite."""
    places = as_array(name, points, np.float64, POINTS, rule="they must be numbers, (n, 3)", units=MILLIMETRES)
    refuse_if(
        places.shape[1:] != (3,) or not np.isfinite(places).all(),
        f"{name} of shape {places.shape}: they must be finite, and (n, 3)",
    )
    return places


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

    Raises
    ------
    InputError
        If curves are narrower, or a position or weight is not finite.
    """
    values = np.zeros(grid.shape)
    deviations = require_numbers("width", width, count=3, minimum=1e-9)
    positions = require_points("positions", positions)
    weights = as_array("weights", weights, np.float64, POINTS)
    refuse_if(
        weights.shape != (len(positions),) or not np.isfinite(weights).all(),
        f"weights of shape {weights.shape}: they must be finite, one for each of {len(positions)} positions",
    )
    refuse_if(
        (deviations < (1 - 1e-9) * _NARROWEST * grid.voxel).any(),
        f"width = {tuple(width)}: it must be half a voxel at least, of {tuple(grid.voxel.tolist())}",
    )
    edges = [np.append(axis - size / 2, axis[-1] + size / 2) for axis, size in zip(grid.axes, grid.voxel, strict=True)]
    for position, weight in zip(positions, weights, strict=True):
        spans = []
        curves = []
        for centre, edge, deviation in zip(position, edges, deviations, strict=True):
            reach = _TRUNCATED * deviation
            first, last = np.searchsorted(edge, [centre - reach, centre + reach])
            spans.append(span := slice(max(first - 1, 0), min(last, len(edge) - 1)))
            away = np.clip((edge[span.start : span.stop + 1] - centre) / deviation, -_TRUNCATED, _TRUNCATED)
            curves.append(np.diff(ndtr(away)) / (2 * ndtr(_TRUNCATED) - 1))
        x, y, z = curves
        values[spans[2], spans[1], spans[0]] += weight * z[:, None, None] * y[:, None] * x
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
    values = np.maximum(values_of(volume)[0], 0)
    total = float(values.sum())
    if not total:
        return 0.0
    lit = np.argwhere(values > 0)
    z, y, x = (volume[name].values[index] for name, index in zip("zyx", lit.T, strict=True))
    positions = require_points("positions", positions)
    if not len(positions):
        return 1.0
    away = cKDTree(positions / semi_axes).query(np.stack([x, y, z], -1) / semi_axes, distance_upper_bound=1.0)[0]
    return float(values[tuple(lit[np.isinf(away)].T)].sum()) / total


def elongation(camera: PlenopticCamera, distance: float) -> float:
    r"""Return how much less precisely the depth of a point is seen than its place across the axis: :math:`\sqrt2 g/a`.

    Each part of the pupil of radius a sees the point from another direction. The slopes of these have the variance
    :math:`(a / g)^2 / 4` along each axis, and both axes tell of the depth, so that the standard deviation of a least
    squares estimate of depth over that of a lateral one is :math:`1 / \sqrt{2 (a / g)^2 / 4}`.
    Slopes before an objective have the mean square :math:`1 / \cos\alpha - 1` over the light, whatever the depth.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    distance : float
        Distance g of the point from the main lens, in mm.
    """
    if camera.objective is not None:
        return (1 / math.cos(camera.objective.half_angle) - 1) ** -0.5
    return math.sqrt(2) * distance / camera.aperture_radius
