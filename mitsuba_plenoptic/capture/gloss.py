"""Radiance over the pupil of what shines by gloss: surfaces whose lobes are hardly wider than the pupil."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .chains import Optics, leads_to
from .child import channel_mean, random_numbers
from .entrance import Entrances
from .places import Vertex
from .visibility import LANES, PUPIL_CELLS, aimed_at, tolerance

NARROW = 1 / 4
"""Part of a lobe that goes through the pupil, from which on the radiance counts as different over the pupil."""

_SAMPLES = 4
"""Light paths of a cell of the pupil."""


def glossy(optics: Optics, vertex: Vertex, ray: Any, radius: float) -> NDArray[np.bool_]:
    """Return which places lie on surfaces with narrow lobes, and without null or delta ones.

    Parameters
    ----------
    optics : Optics
        Scene and child.
    vertex : Vertex
        The places.
    ray : Ray3f
        The rays that have found them.
    radius : float
        Of the pupil.
    """
    place = vertex.place
    if not optics.gloss:
        return np.zeros(dr.width(ray), bool)
    if not optics.plain:
        _, chain, _ = leads_to(optics, ray, vertex.key, place, tolerance(place))
        ray = chain.ray
    si = optics.scene.ray_intersect(ray)
    bsdf = si.bsdf(ray)
    candidate = si.is_valid() & ~place.escaped & ~place.scattered & ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)
    candidate &= mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy)
    context = mi.BSDFContext()
    densest = dr.maximum(*(bsdf.pdf(context, si, wo, candidate) for wo in (mi.reflect(si.wi), -si.wi)))
    pupil = math.pi * radius**2 / dr.square(place.distance)
    return np.asarray((candidate & (densest * pupil > NARROW)).numpy())


def pupil_radiance(
    optics: Optics, to_world: Any, vertex: Vertex, ray: Any, entrances: Entrances, radius: float, seed: int
) -> NDArray[np.float32]:
    """Return the radiance of places towards the cells of the pupil, (n, PUPIL_CELLS, PUPIL_CELLS).

    It is the mean of a few light paths from points of each cell; 0 where the place is hidden.
    """
    cells = PUPIL_CELLS**2
    count = dr.width(ray)
    result = np.empty((count, cells), np.float32)
    batch = max(1, LANES // (16 * cells * _SAMPLES))
    for start in range(0, count, batch):
        stop = min(start + batch, count)
        lane = dr.arange(mi.UInt32, (stop - start) * cells * _SAMPLES)
        which = lane // (cells * _SAMPLES) + dr.opaque(mi.UInt32, start)
        cell = lane // _SAMPLES % cells
        sampler = random_numbers(seed + start, dr.width(lane))
        within = sampler.next_2d()
        x, y = (
            (mi.Float(index) + number) * (2 * radius / PUPIL_CELLS) - radius
            for index, number in ((cell % PUPIL_CELLS, within.x), (cell // PUPIL_CELLS, within.y))
        )
        found, primary = dr.gather(Vertex, vertex, which), dr.gather(mi.Ray3f, ray, which)
        shadow = aimed_at(found, primary, to_world @ entrances.at(x, y, which))
        arrived, chain, weight = leads_to(optics, shadow, found.key, found.place, tolerance(found.place))
        child = optics.child
        dr.eval(arrived, chain, weight)
        hidden = child.lamps_hidden(chain.events, chain.null_events)
        radiance = child.sample(
            optics.scene, seed + start, chain.ray, chain.medium, chain.used(child), hidden, arrived, optics.media
        )
        mean = dr.block_sum(channel_mean(weight * radiance), _SAMPLES) / _SAMPLES
        result[start:stop] = mean.numpy().reshape(-1, cells)
    return result.reshape(-1, PUPIL_CELLS, PUPIL_CELLS)
