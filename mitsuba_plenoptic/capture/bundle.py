r"""Light close to a ray, followed through mirrors and refracting surfaces to find from where it seems to come.

Igehy, "Tracing ray differentials" (SIGGRAPH 1999); for the matrices Siegman, "Lasers", chapter 15.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

_PLANE = 1e-3
"""Relative change of the angles between rays up to which they have met plane surfaces only."""


@dataclass
class Bundle:
    """How place and direction of a ray change with those with which it has started.

    Attributes
    ----------
    places, directions : lists of 4 Vector3f
        Change of place and of direction for each of the starting values: place along two directions across the ray,
        then direction along the same two.
    """

    places: list[Any]
    directions: list[Any]

    @classmethod
    def start(cls, direction: Any) -> Bundle:
        """Return the bundle of rays that start in one direction, or from one place."""
        across = mi.coordinate_system(direction)
        zeros = [dr.zeros(mi.Vector3f, dr.width(direction)) for _ in range(2)]
        return cls([*(mi.Vector3f(axis) for axis in across), *zeros], [*map(mi.Vector3f, zeros), *across])

    def transfer(self, distance: Any) -> Bundle:
        """Go on along the ray."""
        return Bundle(
            [dP + distance * dD for dP, dD in zip(self.places, self.directions, strict=True)], self.directions
        )

    def bend(self, si: Any, before: Any, after: Any, eta: Any) -> Bundle:
        r"""Reflect or refract at a surface, at which the bundle has arrived.

        With the normal N, D the direction before and D' after, both obey
        :math:`D' = \eta D - \mu N`, :math:`\mu = \eta D \cdot N - D' \cdot N`; for a mirror :math:`\eta = 1`.

        Parameters
        ----------
        si : SurfaceInteraction3f
            Where, with the derivatives of the shading normal.
        before, after : Vector3f
            Directions.
        eta : Float
            Refractive index behind the surface over that before it; 1 for a mirror.
        """
        eta = dr.rcp(eta)
        normal = _normal(si, before, after, eta)
        turned = dr.select(dr.dot(normal, si.sh_frame.n) < 0, -1.0, 1.0)
        cos_before, cos_after = dr.dot(before, normal), dr.dot(after, normal)
        mu = eta * cos_before - cos_after
        slope = eta - eta * eta * cos_before / cos_after
        dPs, dDs = [], []
        for dP, dD in zip(self.places, self.directions, strict=True):
            # along the ray to the surface's tangent plane
            on_surface = dP - before * (dr.dot(dP, si.n) / dr.dot(before, si.n))
            dN = _normal_change(si, on_surface) * turned
            dmu = slope * (dr.dot(dD, normal) + dr.dot(before, dN))
            dPs.append(on_surface)
            dDs.append(eta * dD - mu * dN - dmu * normal)
        return Bundle(dPs, dDs)

    def vergence(self, direction: Any, escaped: Any) -> tuple[Any, Any]:
        r"""Return the curvature, at the start, of the wavefront of light that comes from one place of the ray's end.

        Rays from one place satisfy :math:`A r + B \theta = 0`, so that the wavefront has the curvature
        :math:`B^{-1} A`; rays that end in one direction have :math:`D^{-1} C`.

        Parameters
        ----------
        direction : Vector3f
            Direction of the ray's end.
        escaped : Bool
            Whether the light comes from infinity.

        Returns
        -------
        mean, difference : Float
            Mean of the two principal curvatures in reciprocal lengths, positive where the light seems to diverge from
            a place before the start; and by how much they differ.
        """
        axes = mi.coordinate_system(direction)
        ends = [dr.select(escaped, dD, dP) for dP, dD in zip(self.places, self.directions, strict=True)]
        (a, b), (c, d) = ([dr.dot(axis, end) for end in ends[:2]] for axis in axes)
        (e, f), (g, h) = ([dr.dot(axis, end) for end in ends[2:]] for axis in axes)
        scale = dr.rcp(e * h - f * g)
        (p, q), (r, s) = ((h * a - f * c, h * b - f * d), (e * c - g * a, e * d - g * b))
        return 0.5 * (p + s) * scale, dr.sqrt(dr.maximum(dr.square(p - s) + 4 * q * r, 0)) * dr.abs(scale)

    def apparent(self, start: Any, direction: Any, normal: Any) -> Any:
        """Return a normal at the ray's end as it is seen from the start: turned back through plane mirrors and panes.

        Parameters
        ----------
        start, direction : Vector3f
            Directions of the ray at its start and at its end.
        normal : Vector3f
            The normal.

        Returns
        -------
        Vector3f
            Zero behind what changes the angles between rays.
        """
        changes = self.directions[2:]
        seen = start * dr.dot(direction, normal)
        for axis, change in zip(mi.coordinate_system(start), changes, strict=True):
            seen += mi.Vector3f(axis) * dr.dot(change, normal)
        plane = [dr.abs(dr.norm(change) - 1) < _PLANE for change in changes]
        return dr.select(plane[0] & plane[1], seen, 0)


def _normal(si: Any, before: Any, after: Any, eta: Any) -> Any:
    """Return the normal about which a ray has turned, which bump and normal maps may have tilted."""
    bend = eta * before - after
    size = dr.norm(bend)
    return dr.select(size > 1e-4, bend / size, mi.Vector3f(si.sh_frame.n))


def _normal_change(si: Any, change: Any) -> Any:
    """Return by how much the shading normal changes with a small change of place on the surface."""
    E, F, G = dr.squared_norm(si.dp_du), dr.dot(si.dp_du, si.dp_dv), dr.squared_norm(si.dp_dv)
    along_u, along_v = dr.dot(si.dp_du, change), dr.dot(si.dp_dv, change)
    determinant = E * G - F * F
    scale = dr.select(determinant > 1e-12 * E * G, dr.rcp(determinant), 0)
    u, v = (G * along_u - F * along_v) * scale, (E * along_v - F * along_u) * scale
    return mi.Vector3f(si.dn_du * u + si.dn_dv * v)
