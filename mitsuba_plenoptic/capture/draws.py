"""Light paths of radiators: their means and variances, and the places where the light of each comes from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from . import child
from .chains import Optics
from .first_vertex import first_vertex
from .places import Vertex, seen_directly

if TYPE_CHECKING:
    from .sight import Sight

MOST_PLACES = 4
"""Places, at most, that stand for those where the light of one ray comes from."""

_SAME_PLACE = 1e-4
"""Relative difference of distances below which places of equal chains are the same."""


_ROUNDING = 1e-6
"""Relative variance of light paths that is none."""


@dataclass(frozen=True)
class Found:
    """Places that shine, of the rays of some radiators.

    Attributes
    ----------
    lane : (n,) uint32 array
        A lane of the rays that has found each.
    radiance, variance : (n, channels) float64 arrays
        Mean over the light paths of the ray, and the variance of the mean.
    vertex : Vertex, or None
        The places, n lanes; none where nothing shines.
    """

    lane: NDArray[np.uint32]
    radiance: NDArray[np.float64]
    variance: NDArray[np.float64]
    vertex: Any

    def weighted(self, factor: NDArray[np.float64]) -> Found:
        """Return the places with factors on their radiance; those with none are left out."""
        kept = np.flatnonzero(factor)
        scale = factor[kept, None]
        vertex = dr.gather(Vertex, self.vertex, mi.UInt32(kept.astype(np.uint32)))
        return Found(self.lane[kept], self.radiance[kept] * scale, self.variance[kept] * scale**2, vertex)


def draw(sight: Sight, seed: int, ray: Any, spp: int, dark: bool = False) -> Found:
    """Follow light paths, `spp` neighbouring lanes for each ray, and gather those of equal places.

    Parameters
    ----------
    sight : Sight
        Scene and child.
    seed : int
        Of the random numbers.
    ray : Ray3f
        Rays from the camera, each `spp` times.
    spp : int
        Light paths of a ray.
    dark : bool
        Whether to keep what does not shine, too, of scenes in which nothing branches.

    Returns
    -------
    Found
    """
    return (
        _draw_plain(sight, seed, ray, spp, dark) if sight.optics.plain else _draw_places(sight.optics, seed, ray, spp)
    )


def _draw_plain(sight: Sight, seed: int, ray: Any, spp: int, dark: bool) -> Found:
    """Ask the child alone: all light of a ray comes from where it first hits."""
    optics, radiances = sight.optics, []
    for light in sight.lights(ray):
        # The same numbers lead light of all wavelengths along the same paths.
        sampler = child.random_numbers(seed, dr.width(ray))
        found = child.sample(optics.child.integrator, optics.scene, sampler, light, None, mi.Bool(True))
        dr.eval(found)
        radiances.append(found)
    spectrum = sight.spectrum(radiances)
    sums = [
        np.stack([dr.block_sum(value, spp).numpy() for value in values], axis=-1)
        for values in (spectrum, [value * value for value in spectrum])
    ]
    shines = ~(sums[0].max(axis=-1) <= 0)
    if dark:
        shines |= _may_shine(optics, ray, spp)
    shining = np.flatnonzero(shines).astype(np.uint32)
    mean, variance = _moments(sums[0][shining], sums[1][shining], spp)
    lane = shining * np.uint32(spp)
    if not lane.size:
        return Found(lane, mean, variance, None)
    si = optics.scene.ray_intersect(dr.gather(mi.Ray3f, ray, mi.UInt32(lane)))
    return Found(lane, mean, variance, Vertex(mi.UnpolarizedSpectrum(0), seen_directly(si), mi.UInt32(0)))


def _may_shine(optics: Optics, ray: Any, spp: int) -> NDArray[np.bool_]:
    """Return which rays, each `spp` lanes, meet anything."""
    if optics.scene.environment() is not None:
        return np.ones(dr.width(ray) // spp, bool)
    first = dr.arange(mi.UInt32, dr.width(ray) // spp) * spp
    return np.array(optics.scene.ray_intersect(dr.gather(mi.Ray3f, ray, first)).is_valid())


def _draw_places(optics: Optics, seed: int, ray: Any, spp: int) -> Found:
    """Sample the first vertex of every path."""
    vertex = first_vertex(optics, seed, ray, spp)
    dr.eval(vertex)
    values = np.stack([value.numpy() for value in channels(vertex.radiance)], axis=-1).astype(np.float64)
    lane = np.flatnonzero(~(values.max(axis=-1) <= 0))
    if not lane.size:
        return Found(lane.astype(np.uint32), values[lane], values[lane], None)
    place = vertex.place
    distance, signature, scattered = (part.numpy()[lane] for part in (place.distance, place.signature, place.scattered))
    ray_index = lane // spp
    # Media scatter at places that are all different.
    own = np.where(scattered, lane + 1, 0)
    with np.errstate(divide="ignore"):
        step = np.where(np.isfinite(distance), np.rint(np.log(np.abs(distance)) / _SAME_PLACE), np.inf)
    order = np.lexsort([own, step, signature, ray_index])
    keys = [key[order] for key in (ray_index, signature, step, own)]
    new = np.r_[True, np.any([key[1:] != key[:-1] for key in keys], axis=0)]
    first = np.flatnonzero(new)
    sums = [np.add.reduceat(part[lane][order], first, axis=0) for part in (values, values**2)]
    lane, owner = lane[order][first], keys[0][first]
    factor = _thin_out(sums[0].mean(axis=1), owner)
    kept = np.flatnonzero(factor)
    mean, variance = _moments(sums[0][kept], sums[1][kept], spp)
    factor = factor[kept, None]
    index = lane[kept].astype(np.uint32)
    return Found(index, mean * factor, variance * factor**2, dr.gather(Vertex, vertex, mi.UInt32(index)))


def _thin_out(power: NDArray[np.float64], owner: NDArray[np.int64]) -> NDArray[np.float64]:
    """Draw `MOST_PLACES` of the places of each ray that has more, evenly along their sum: factors on their radiance."""
    _, which, count = np.unique(owner, return_inverse=True, return_counts=True)
    total = np.bincount(which, power)[which]
    upto = np.cumsum(power)
    start = (upto - power)[np.r_[True, which[1:] != which[:-1]]][which]
    chance = power / total * MOST_PLACES
    high = (upto - start) / total * MOST_PLACES
    times = np.floor(high + 0.5) - np.floor(high - chance + 0.5)
    return np.where(count[which] > MOST_PLACES, times / chance, 1.0)


def channels(radiance: Any) -> list[Any]:
    """Return the channels of a spectrum; lanes of wavelengths are all of one."""
    return [radiance[0]] if mi.is_spectral else list(radiance)


def _moments(sums: NDArray[Any], squares: NDArray[Any], spp: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean of some numbers and its variance."""
    mean = (sums / spp).astype(np.float64)
    if spp == 1:
        return mean, np.full_like(mean, np.nan)
    spread = squares / spp - mean**2
    # What rounding leaves of paths that are all the same is no spread.
    return mean, np.where(spread > _ROUNDING * mean**2, spread, 0) / (spp - 1)
