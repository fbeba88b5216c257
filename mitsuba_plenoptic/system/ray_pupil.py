"""The exit pupil of the main lens, as seen by rays from the detector through the microlenses."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .optical_system import OpticalSystem

Pair = tuple[Any, ...]


@dataclass(frozen=True)
class RayPupil:
    """The exit pupil of a camera, and the rays through it."""

    # The camera and its wavelength, which affects main lenses with surfaces.
    system: OpticalSystem

    @property
    def radius(self) -> float:
        """Radius of the pupil near the axis in millimetres."""
        return self.system.camera.pupil_radius

    @property
    def reach(self) -> float:
        """Radius of a circle about the axis that contains the pupil as seen from anywhere on the detector."""
        return self.system.lens.reach

    def chief_point(self, p: Any, detector_distance: Any) -> Any:
        """Return the positions where rays from the detector to the pupil's centre cross the array."""
        return self.system.lens.chief_point(p, detector_distance)

    def distance_from(self, detector_distance: float) -> float:
        """Return the pupil's distance from a plane behind the array, which converts directions into pupil points."""
        return self.system.lens.pupil_distance_from(detector_distance)

    def seen(self, detector: Pair, centre: Pair, detector_distance: float, height: Any) -> Pair:
        """Return the points of the pupil that the detector sees through the centres of lenses.

        The centres lie by a height nearer to the main lens than `detector_distance` before the detector.
        """
        slopes = ((c - p) / (detector_distance + height) for c, p in zip(centre, detector, strict=True))
        lens = self.system.lens
        return tuple(lens.pupil_point(c, slope, height) for c, slope in zip(centre, slopes, strict=True))

    def trace(self, place: Pair, pupil: Pair, height: Any) -> tuple[tuple[Any, Any, Any], Pair]:
        """Return start points and slopes in the scene of rays from positions on the array through points of the pupil.

        The positions lie by a height nearer to the main lens than the array on the axis.
        """
        lens = self.system.lens
        x, y = (lens.slope_to(P, m, height) for P, m in zip(pupil, place, strict=True))
        start = tuple(m - height * t for m, t in zip(place, (x, y), strict=True))
        point, slope, _ = lens.trace((start[0], start[1]), (x, y))
        return point, slope

    def inner(self, pupil: Pair, centre: Pair) -> Pair:
        """Map points of the pupil, seen from lenses, to the round pupil; points outside map to points outside."""
        found = self.system.lens.round_map
        if found is None:
            return pupil
        (x, y), (cx, cy) = pupil, centre
        field = dr.sqrt(cx * cx + cy * cy)
        # The map is defined for fields along x.
        c, s = dr.select(field > 0, cx / field, 1), dr.select(field > 0, cy / field, 0)
        fields, across, _, _ = found.points.shape
        u, v = x * c + y * s, y * c - x * s
        at = [(value / found.half + 1) * ((across - 1) / (2 * across)) + 0.5 / across for value in (u, v)]
        u, v = self._map.eval(mi.Point3f(*at, field / found.field * ((fields - 1) / fields) + 0.5 / fields))
        return u * c - v * s, u * s + v * c

    @functools.cached_property
    def _map(self) -> Any:
        found = self.system.lens.round_map
        assert found is not None
        # Outside its border the map continues with the border's values, which lie outside the pupil.
        return mi.Texture3f(
            mi.TensorXf(found.points),
            filter_mode=dr.FilterMode.Linear,
            wrap_mode=dr.WrapMode.Clamp,
        )
