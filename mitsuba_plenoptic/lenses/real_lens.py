"""A real main lens in front of a detector, for rays and waves; the wave model uses fits to the rays of points.

How the pupil spreads a ray depends on the distance and direction of the nearest edge. A pupil that is vignetted or
displaced off the axis is therefore mapped to the round pupil near the axis, to points at the same distance and
direction from its edge.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from ..errors import InputError, refuse_if
from ..optics import guards
from ..prescription import Prescription
from ..runtime import Doubles, Flags, Pair, Triple, single_threaded_blas
from .accuracy import ACCURACY
from .common import LensNumbers, builds
from .fitted_lens import FittedLens
from .lens_system import LensSystem
from .protocol import Entrance, RoundMap
from .pupil_fit import ExitPupil, Pupils, covered, fit_pupil, trace


def round_map(lens: LensSystem, reach: float, corner: float) -> RoundMap:
    """Return the map from the exit pupil of a lens to a round pupil."""
    from scipy.spatial import cKDTree

    radius = float(lens.pupil.radius)
    half = ACCURACY.map_extent * reach
    last = ACCURACY.map_extent * corner
    x, y = np.meshgrid(*[np.linspace(-half, half, ACCURACY.centre_rays)] * 2)
    closed = math.inf
    if not _is_open(lens, last, x, y).any():
        # Between an open and a closed field the map would transmit light that the lens blocks.
        last, closed = 0.0, last
        for _ in range(ACCURACY.edge_bisections):
            between = (last + closed) / 2
            last, closed = (between, closed) if _is_open(lens, between, x, y).any() else (last, between)
    heights = np.linspace(0, last, ACCURACY.edge_fields)
    axis = np.linspace(-half, half, ACCURACY.map_nodes)
    nodes = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    # The initial values are points outside the round pupil.
    result = np.full((ACCURACY.edge_fields, len(nodes), 3), 2 * radius, np.float32)
    for index, height in enumerate(heights):
        passed = _is_open(lens, height, x, y)
        if not passed.any():
            continue
        edge = _edge(lens, height, half, (float(x[passed].mean()), float(y[passed].mean())))
        along = np.roll(edge, -1, 0) - np.roll(edge, 1, 0)
        normals = np.stack([along[:, 1], -along[:, 0]], -1)
        # Where nearly all light ends, the edge is a point: any direction leaves it.
        normals[~normals.any(1)] = 1, 0
        normals /= np.hypot(*normals.T)[:, None]
        distance, nearest = cKDTree(edge).query(nodes)
        # Beyond a pupil's corner normals do not tell on which side of the edge a node lies.
        inside = np.where(_is_open(lens, height, *nodes.T), distance, -distance)
        # The round pupil has no points farther from its edge than its centre.
        away = np.maximum(radius - inside, 0)
        result[index] = np.column_stack([normals[nearest] * away[:, None], away])
    refuse_if(not (result[0, :, 2] <= radius).any(), "main_lens: no ray gets through it to the middle of the array")
    return RoundMap(last, closed, half, result.reshape(ACCURACY.edge_fields, ACCURACY.map_nodes, ACCURACY.map_nodes, 3))


def _is_open(lens: LensSystem, height: float, x: Doubles, y: Doubles) -> Flags:
    """Return whether points of the pupil transmit light to a position on the array's x axis."""
    return np.asarray(lens.ray((x, y), (np.full_like(x, height), np.zeros_like(x)))[2])


def _edge(lens: LensSystem, height: float, reach: float, middle: Pair) -> Doubles:
    """Return points of the pupil's edge around its middle, as seen from a position on the array's x axis."""
    angle = 2 * math.pi * np.arange(ACCURACY.edge_angles) / ACCURACY.edge_angles
    low = np.zeros(ACCURACY.edge_angles)
    high = np.full(ACCURACY.edge_angles, 2 * reach)
    for _ in range(ACCURACY.edge_bisections):
        between = (low + high) / 2
        within = _is_open(lens, height, middle[0] + between * np.cos(angle), middle[1] + between * np.sin(angle))
        low = np.where(within, between, low)
        high = np.where(within, high, between)
    dense = 2 * math.pi * np.arange(ACCURACY.edge_directions) / ACCURACY.edge_directions
    distance = np.interp(dense, angle, low, period=2 * math.pi)
    return np.stack([middle[0] + distance * np.cos(dense), middle[1] + distance * np.sin(dense)], -1)


@dataclass(frozen=True, eq=False)
class RealLens(LensSystem):
    """A lens of several surfaces before a detector that sees a part of its field, with cached fits for waves."""

    # Distance of the detector's corners from the axis in millimetres.
    corner: float = 0.0
    _fits: dict[Triple, FittedLens] = field(default_factory=dict, init=False, repr=False)
    _lights: dict[Triple, ExitPupil] = field(default_factory=dict, init=False, repr=False)

    is_uniform = False

    @functools.cached_property
    def reach(self) -> float:
        """Radius in mm of a circle that contains the exit pupil as seen from anywhere on the detector."""
        return self._own.pupil_reach(self.corner)

    @property
    def window(self) -> Any:
        """The exit pupil, which bounds the directions of rays at the array."""
        return self.pupil

    @property
    def _own(self) -> LensSystem:
        """The lens at the prescription's wavelength, for properties assumed equal at all wavelengths."""
        return self if self.wavelength is None else replace(self, wavelength=None)

    @functools.cached_property
    def entrance(self) -> Entrance:
        """Entrance pupil of the lens."""
        pupils = Pupils.of(self)
        radius, depths = self.front_bounds
        return Entrance(pupils.entrance, max(depths), pupils.magnification, radius, depths)

    def opaque(self, convert: Callable[[Any], Any]) -> RealLens:
        """Return this lens, whose surfaces are compiled into kernels."""
        return self

    def open_fraction(self, x: Doubles, y: Doubles) -> Doubles:
        """Return the unvignetted fraction of the circle of radius `reach`, as seen from positions on the MLA."""
        heights, fractions = self._fractions
        return np.interp(np.hypot(x, y), heights, fractions)

    @functools.cached_property
    def _fractions(self) -> Pair:
        radius = self.reach
        lens = self._own
        heights = np.linspace(0, ACCURACY.open_reach * self.corner, ACCURACY.open_fields)
        axis = ((np.arange(ACCURACY.open_rays) + 0.5) * 2 / ACCURACY.open_rays - 1) * radius
        Px, Py = (values[np.hypot(*grid) <= radius] for grid in [np.meshgrid(axis, axis)] for values in grid)
        return heights, np.array(
            [np.mean(lens.ray((Px, Py), (np.zeros_like(Px), np.full_like(Py, height)))[2]) for height in heights]
        )

    @functools.cached_property
    def round_map(self) -> RoundMap:
        """Map from the exit pupil, as positions off the axis see it, to the round pupil near the axis."""
        return round_map(self, self.reach, self.corner)

    def inside(self, pupil: Sequence[Doubles], place: Sequence[Doubles]) -> Doubles:
        """Return the distance in mm of pupil points from the edge that places on the MLA see, positive inside."""
        from scipy.interpolate import interpn

        table = self.round_map
        # The map is for fields along x, and the axis has no direction.
        field = np.hypot(place[0] + 1e-9, place[1])
        c = (place[0] + 1e-9) / field
        s = place[1] / field
        fields, across, _, _ = table.points.shape
        axis = np.linspace(-table.half, table.half, across)
        turned = pupil[1] * c - pupil[0] * s, pupil[0] * c + pupil[1] * s
        within = [field.clip(0, table.field), *(value.clip(-table.half, table.half) for value in turned)]
        nodes = np.linspace(0, table.field, fields), axis, axis
        away = interpn(nodes, table.points[..., 2], np.stack(np.broadcast_arrays(*within), -1))
        return np.where(field < table.closed, float(self.pupil.radius) - away, -table.half)

    # -- waves ---------------------------------------------------------------------------------------

    def waves_of(self, points: Doubles) -> FittedLens:
        """Return the lens for wave propagation from scene points, as `MainLens.waves_of` does."""
        front = self.entrance.front
        within = (points[:, 2] > 0) & (points[:, 2] <= front)
        if within.any():
            raise InputError(
                f"position: g = {points[within][0, 2]:g}: it must lie before the main_lens, beyond {front:.6g}"
            )
        field, inverse_distance = Pupils.of(self).field(points) if len(points) else (np.zeros((1, 2)), np.zeros(1))
        largest = np.hypot(*field.T)
        lens = self._over_field(float(largest.max()), (float(inverse_distance.min()), float(inverse_distance.max())))
        beyond = largest > lens.fitted.aberration.scales.field
        if beyond.any():
            position = ", ".join(f"{c:g}" for c in points[beyond][0])
            raise InputError(f"position = ({position}): no light of it passes the main_lens")
        return _checked(lens)

    def waves_of_one(self, point: Doubles) -> ExitPupil:
        """Return the light of a single scene point, fitted to rays of this point alone."""
        x, y, g = np.asarray(point).tolist()
        if (x, y, g) not in self._lights:
            # 16: Largest number of lights of single points that are cached.
            while len(self._lights) >= 16:
                self._lights.pop(next(iter(self._lights)), None)
            self._lights[x, y, g] = ExitPupil.of(self, (x, y, g))
        return self._lights[x, y, g]

    def over_field(self, field: float, inverse_distance: Pair) -> FittedLens:
        """Return the lens for waves, fitted for inverse distances (low, high) up to a field, or to the largest."""
        return _checked(self._over_field(field, inverse_distance))

    def farthest(self, distances: Sequence[float]) -> Doubles:
        """Return points (n, 3), one at each distance, at the largest field that a detector sees through the lens."""
        depths = np.array(distances)
        near = 1 / (depths - self.entrance.pupil)
        field = ACCURACY.farthest_field * self.corner / self.mla_distance * depths * near
        lens = self.over_field(float(field.max()), (float(near.min()), float(near.max())))
        field = np.minimum(field, ACCURACY.used_field * lens.fitted.aberration.scales.field)
        return np.column_stack([0 * depths, field / near, depths])

    def _over_field(self, field: float, inverse_distance: Pair) -> FittedLens:
        """Return a lens fitted for a field and inverse distances; ranges grow in steps, so that fits are reused."""
        least = ACCURACY.narrowest_field * self.corner / self.mla_distance
        steps = math.ceil(math.log(max(1, field / least)) / math.log(ACCURACY.field_step))
        power = ACCURACY.depth_step / self.focal_length
        low = math.floor(inverse_distance[0] / power)
        high = math.ceil(inverse_distance[1] / power)
        key = least * ACCURACY.field_step**steps, low * power, max(high, low + 1) * power
        if key not in self._fits:
            self._fits[key] = self._fit(*key)
        return self._fits[key]

    def _fit(self, field: float, low: float, high: float) -> FittedLens:
        """Return the lens fitted over a range of inverse distances, up to a field or the edge of the lens's field."""
        tracer = functools.partial(trace, self)
        radius = self.aperture_radius
        inverse_distance = (low, high)
        field = covered(tracer, radius, field, inverse_distance)
        refuse_if(not field > 0, "main_lens: no light of the scene points passes it")
        with single_threaded_blas():  # the matrices are narrow, and its threads wait for each other actively
            fitted = fit_pupil(tracer, Pupils.of(self), radius, field, inverse_distance, self.light)
        return FittedLens(self, self.reach, fitted)


def _checked(lens: FittedLens) -> FittedLens:
    """Return a fitted lens after the guard of main lenses has recorded the error of its path."""
    guards.check(guards.MAIN_LENS, -math.expm1(-((2 * math.pi * lens.fitted.error) ** 2)))
    return lens


@builds(Prescription)
def real_lens(numbers: LensNumbers) -> RealLens:
    """Return the main lens of a camera that has a prescription."""
    camera = numbers.camera
    return RealLens(
        cast(Prescription, camera.main_lens),
        numbers.focal_length,
        numbers.aperture_radius,
        numbers.mla_distance,
        numbers.wavelength,
        corner=math.hypot(camera.detector_width, camera.detector_height) / 2,
    )
