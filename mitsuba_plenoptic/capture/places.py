"""Places from which light comes, and from which it seems to come."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .child import channel_mean


@dataclass
class Place:
    """From where light seems to come, and from where it comes.

    Attributes
    ----------
    distance : Float
        Distance, along the ray that has found it, of the place from which it seems to come: infinite where that is at
        infinity, negative where the light converges to a place behind the ray's start.
    astigmatism : Float
        Difference of the reciprocal distances in the two principal sections.
    curved : Bool
        Whether it has come through refracting or curved surfaces.
    point : Point3f
        Where it comes from, in the world.
    normal : Normal3f
        The surface's normal there.
    apparent : Vector3f
        The normal as it is seen from the ray's start; zero where there is no surface, or curved ones show it bent.
    escaped : Bool
        Whether it comes from infinity instead.
    scattered : Bool
        Whether it has been scattered by a medium there.
    signature : UInt32
        Equal for equal chains.
    """

    distance: Any
    astigmatism: Any
    curved: Any
    point: Any
    normal: Any
    apparent: Any
    escaped: Any
    scattered: Any
    signature: Any


@dataclass
class Vertex:
    """The first vertex of each of many rays.

    Attributes
    ----------
    radiance : UnpolarizedSpectrum
        Its mean is the radiance that the child finds along the ray.
    place : Place
        Where it comes from.
    key : UInt32
        The key of the chain that leads there.
    """

    radiance: Any
    place: Place
    key: Any


@dataclass
class Kept:
    """A place drawn among those of a light path, each with a chance proportional to its radiance.

    Attributes
    ----------
    place : Place
        The place.
    radiance : UnpolarizedSpectrum
        Its own radiance.
    total : Float
        Mean over the channels of the radiance of all that have been offered.
    """

    place: Place
    radiance: Any
    total: Any

    def offer(self, place: Place, radiance: Any, number: Any) -> Kept:
        """Add a place; `number` is random."""
        power = channel_mean(radiance)
        total = self.total + power
        taken = number * total < power
        return Kept(dr.select(taken, place, self.place), dr.select(taken, radiance, self.radiance), total)

    def radiance_of_all(self) -> Any:
        """Return the radiance of all places, in the colour of the one that has been drawn."""
        power = channel_mean(self.radiance)
        return dr.select(power > 0, self.radiance * (self.total / power), 0)


def seen_directly(si: Any) -> Place:
    """Return the places that rays have met, where nothing branches."""
    distance = dr.select(si.is_valid(), si.t, dr.inf)
    no = mi.Bool(False)
    apparent = dr.select(si.is_valid(), mi.Vector3f(si.n), 0)
    return Place(distance, mi.Float(0), no, si.p, si.n, apparent, ~si.is_valid(), no, mi.UInt32(0))
