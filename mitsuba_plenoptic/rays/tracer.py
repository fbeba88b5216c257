"""The walk of rays between detector, microlens array, main lens and scene, in either direction.

Ray captures, signed rays, rays of points, splatting and geometric projections all use it. It works on NumPy and Dr.Jit
arrays, whose gradients it propagates. `optics.rays` has the formulas and the symbols.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import drjit as dr
import mitsuba as mi
import numpy as np

from ..array import Lenslet
from ..camera import PlenopticCamera
from ..lenses import MainLens, Traced, cached_main_lens, chief_points, main_lens
from ..optics import rays
from ..runtime import Pair, array_module, drjit_array, fft, minimum

if TYPE_CHECKING:
    from ..fields import OpticalSystem
    from ..lenses import RealLens

_LANES = 2**22
"""Rays that are followed at once."""


class Passage(NamedTuple):
    """The passage of rays through the microlens array."""

    point: Pair
    lens: Lenslet


class Ray(NamedTuple):
    """Rays from detector points p through points m of the array and points P of the pupil into the scene."""

    p: Pair
    # Without an array, m = p.
    m: Pair
    P: Pair
    # Weight of the light, and whether the ray reaches the scene.
    weight: Any
    valid: Any
    # Start in front of the main lens, and slope; None before the ray is traced, as each wavelength has its own.
    origin: Any = None
    slope: Any = None

    def aside(self, start: Pair) -> Any:
        """Return how far sideways the rays go from points in front of the detector to it."""
        return dr.hypot(start[0] - self.p[0], start[1] - self.p[1])


@dataclass(frozen=True)
class Walk:
    """The optical elements that rays of a camera pass; parameters that may carry gradients are Dr.Jit arrays.

    Without a microlens array there is a main lens alone, before the plane of the detector.
    """

    # The camera with plain values, for the parameters without gradients.
    camera: PlenopticCamera
    lens: MainLens
    lattice: Any = None
    # Focal lengths of the microlenses in air, one for each type or one for all.
    focal_lengths: Any = None
    # Distance from the array to the detector, and the refractive index of the medium between them.
    detector_distance: Any = None
    medium: Any = 1.0

    @classmethod
    def of(cls, camera: PlenopticCamera, lens: MainLens | None = None) -> Walk:
        """Return the walk with a camera's plain values, by default through the main lens at its design wavelength."""
        lens = main_lens(camera) if lens is None else lens
        lengths = np.array(camera.mla_focal_lengths)
        return cls(camera, lens, camera.lattice, lengths, camera.detector_distance, camera.mla_medium)

    # -- the main lens -------------------------------------------------------------------------------

    def into_scene(self, position: Pair, slope: Pair, height: Any) -> Traced:
        """Return rays traced from array positions, at a height above the array's plane, through the main lens."""
        if not isinstance(height, float) or height:
            position = position[0] - height * slope[0], position[1] - height * slope[1]
        return self.lens.trace(position, slope)

    def through_pupil(self, pupil: Pair, position: Pair, height: Any = 0.0) -> Traced:
        """Return rays traced from array positions, at a height above the array's plane, through pupil points."""
        x, y = position
        if not isinstance(height, float) or height:
            x, y = (m - height * self.lens.pupil.slope(P, m, height) for P, m in zip(pupil, position, strict=True))
        # The pupil points stay as they are: rounded differently they would miss a small pupil.
        return self.lens.ray(pupil, (x, y))

    def round_pupil(self, pupil: Pair, centre: Pair) -> Pair:
        """Return points of the round pupil for pupil points seen from lenses; points outside stay outside."""
        if self.lens.is_uniform:
            return pupil
        table = cast("RealLens", self.lens).round_map
        x, y = pupil
        cx, cy = centre
        field = dr.sqrt(cx * cx + cy * cy)
        # The map is defined for fields along x.
        c = dr.select(field > 0, cx / field, 1)
        s = dr.select(field > 0, cy / field, 0)
        fields, across, _, _ = table.points.shape
        u = x * c + y * s
        v = y * c - x * s
        at = [(value / table.half + 1) * ((across - 1) / (2 * across)) + 0.5 / across for value in (u, v)]
        # Outside its border the map continues with the border's values, which lie outside the pupil.
        u, v, away = self._round_map.eval(mi.Point3f(*at, field / table.field * ((fields - 1) / fields) + 0.5 / fields))
        # Between fields, points in opposite directions would average to one near the centre.
        u, v = (value * away * dr.rsqrt(dr.maximum(u * u + v * v, dr.smallest(mi.Float))) for value in (u, v))
        lit = field < table.closed
        outside = 2 * self.lens.pupil.radius
        return dr.select(lit, u * c - v * s, outside), dr.select(lit, u * s + v * c, outside)

    def transmittance(self, pupil: Pair, position: Pair) -> Any:
        """Return the transmitted part of the power of rays through an uneven or vignetted pupil."""
        if self.camera.has_even_pupil:
            return 1.0
        # The map to the round pupil is that of a lens of plain numbers.
        plain = Walk(self.camera, cached_main_lens(self.camera))
        x, y = (P / self.camera.pupil_radius for P in plain.round_pupil(pupil, position))
        return self.camera.pupil_power((x, y), position)

    @functools.cached_property
    def _round_map(self) -> Any:
        return mi.Texture3f(
            drjit_array(mi.TensorXf, cast("RealLens", self.lens).round_map.points),
            filter_mode=dr.FilterMode.Linear,
            wrap_mode=dr.WrapMode.Clamp,
        )

    # -- the array -----------------------------------------------------------------------------------

    def chief_cell(self, pixel: Pair) -> tuple[Pair, Pair]:
        """Return where the chief rays of detector points cross the array, and the indices of the lenses there."""
        x, y = chief_points(self.lens, pixel, self.detector_distance, self.medium)
        if any(self.camera.mla_tilt):
            height = self.camera.array_height(x, y)
            x = x + height * self.lens.pupil.slope(0.0, x)
            y = y + height * self.lens.pupil.slope(0.0, y)
        return (x, y), self.lattice.cell(x, y)

    def lenslet(self, i: Any, j: Any) -> Lenslet:
        """Return the lenses of some indices."""
        return self.camera.lenslet(i, j, self.lattice, self.focal_lengths / self.medium)

    def deflection(self, passage: Passage) -> Pair:
        """Return the changes that lenses cause in rays' direction cosines, or slopes, at given points."""
        (mx, my), ((cx, cy), focal_length, *_) = passage
        x, y = self.camera.microlens.deflection(self.lattice, mx - cx, my - cy, focal_length)
        if (error := self.camera.figure_error) is not None:
            right, up = error.slopes(mx, my)
            x = x + right
            y = y + up
        return x, y

    def _chief(self, centre: Pair, height: Any) -> Pair | None:
        """Return the chief rays' slopes at lens centres, for lenses that turn slopes; None if they turn cosines."""
        if deflects_cosines(self.camera):
            return None
        return self.lens.pupil.slope(0.0, centre[0], height), self.lens.pupil.slope(0.0, centre[1], height)

    # -- towards the scene ---------------------------------------------------------------------------

    def out_of_array(self, pixel: Pair, passage: Passage) -> tuple[Pair, Any, Any]:
        """Return slopes before the array of rays from detector points, weights, and which rays leave the medium.

        The weights make rays from all points of the detector uniform over the pupil; see `optics.rays.etendue_factor`.
        """
        height = passage.lens.height
        z = self.detector_distance + height if any(self.camera.mla_tilt) else self.detector_distance
        chief = self._chief(passage.lens.centre, height)
        behind = (passage.point[0] - pixel[0]) / z, (passage.point[1] - pixel[1]) / z
        slope, emerges = rays.out_of_medium(behind, self.deflection(passage), chief, self.medium)
        return slope, rays.etendue_factor(slope, behind, chief, self.medium), emerges

    def trace(self, pixel: Pair, passage: Passage) -> Traced:
        """Return traced rays from detector points through points of the array and through the main lens."""
        slope, _, emerges = self.out_of_array(pixel, passage)
        point, slope, is_open = self.into_scene(passage.point, slope, passage.lens.height)
        return point, slope, is_open & emerges

    def outline(self, pixel: Pair, passage: Passage) -> Pair:
        """Return how far rays as those of `trace` pass inside the nearest edge, in any unit, and their light inside it.

        The distance is negative for blocked rays, and smooth about an edge.
        """
        m, lens = passage
        slope, weight, emerges = self.out_of_array(pixel, passage)
        pupil = tuple(self.lens.window.point(at, t, lens.height) for at, t in zip(m, slope, strict=True))
        inside = math.inf
        power = 1.0
        if self.lens.is_uniform or not self.camera.has_even_pupil:
            x, y = (P / self.camera.pupil_radius for P in self.round_pupil(pupil, m))
            inside, power = self.camera.pupil_outline((x, y), m)
        if not self.lens.is_uniform:
            position = m[0] - lens.height * slope[0], m[1] - lens.height * slope[1]
            inside = minimum(cast("RealLens", self.lens).clearance(position, slope), inside)
        return inside, dr.select(emerges, power * weight * lens.gain, 0.0)

    def through_centre(self, offset: Pair, height: Any) -> tuple[Pair, Any]:
        """Return slopes before the array, and weights, of rays through lens centres at offsets from detector points.

        Lenses are thin phases, which do not turn the rays through their centres; weights as in `out_of_array`.
        """
        behind = tuple(value / (self.detector_distance + height) for value in offset)
        slope = behind if self.medium == 1 else rays.refracted((behind[0], behind[1]), self.medium)
        return (slope[0], slope[1]), rays.etendue_factor(slope, behind, None, self.medium)

    # -- towards the detector ------------------------------------------------------------------------

    def onto_detector(self, pupil: Pair, passage: Passage) -> tuple[Pair, Any]:
        """Return landing points and weights, as in `out_of_array`, of rays through the window and an upright array."""
        mx, my = passage.point
        before = self.lens.window.slope(pupil[0], mx), self.lens.window.slope(pupil[1], my)
        chief = self._chief(passage.lens.centre, 0.0)
        behind = rays.into_medium(before, self.deflection(passage), chief, self.medium)
        z = self.detector_distance
        return (mx - z * behind[0], my - z * behind[1]), rays.etendue_factor(before, behind, chief, self.medium)


def deflects_cosines(camera: PlenopticCamera) -> bool:
    """Return whether the microlenses deflect direction cosines of rays, not slopes."""
    return camera.lens_model != "ideal" or not camera.microlens.is_parabolic


def walks_of(systems: Iterable[OpticalSystem]) -> list[tuple[Walk, list[int]]]:
    """Return one walk for each group of systems whose rays from the pupil follow the same paths, and their indices."""
    groups: dict[float, tuple[Walk, list[int]]] = {}
    for index, system in enumerate(systems):
        # Glasses refract the rays of each wavelength in their own way; other lenses are known by their focal length.
        camera = system.camera
        refraction = system.wavelength if camera.lens_data.disperses else camera.focal_length
        walk = Walk(system.camera, system.lens.opaque(functools.partial(dr.opaque, mi.Float)))
        groups.setdefault(refraction, (walk, []))[1].append(index)
    return list(groups.values())


def on_plane(traced: Traced, distance: Any, mla_distance: Any) -> Pair:
    """Return where rays in the scene meet an object plane, which may be at infinity, times -b / g in millimetres."""
    (x, y, z), (tx, ty), _ = traced
    forward = 1 - z / distance
    return tuple(-mla_distance * rays.object_direction(X, forward * t, distance) for X, t in ((x, tx), (y, ty)))


def follow_back(p: Any, m: Any, c: Any, distance: float, camera: PlenopticCamera) -> Pair:
    """Follow rays from p through m of the lens at c back to an object plane by paraxial optics, linear in p, m and c.

    One axis at a time; returns the points of the pupil, and those of the plane, which may be at infinity, times -b / g.
    """
    # The slope after the microlens: (m - p)/z - (m - c)/f2.
    t = (m - p) / camera.reduced_distance - (m - c) / (camera.mla_focal_lengths[0] / camera.mla_medium)
    P = rays.pupil_point(m, t, camera.mla_distance)
    slope = rays.main_lens_slope(t, P, camera.focal_length)
    return P, -camera.mla_distance * rays.object_direction(P, slope, distance)


def detector_rows(camera: PlenopticCamera, rays: int = 1) -> Iterator[tuple[slice, Any, Any]]:
    """Yield slices of rows with x and y of the centres of their pixels, of some rays each, in mm, as Dr.Jit arrays."""
    types = array_module()
    rows, columns = camera.shape
    x, y = (drjit_array(types.Float64, camera.pixel_coordinates(axis)) for axis in (0, 1))
    together = max(1, _LANES // (rays * columns))
    for first in range(0, rows, together):
        last = min(rows, first + together)
        row, column = fft.rows_and_columns(types, last - first, columns)
        px = dr.gather(types.Float64, x, column)
        py = dr.gather(types.Float64, y, row + dr.opaque(types.UInt32, first))
        yield slice(first, last), px, py
