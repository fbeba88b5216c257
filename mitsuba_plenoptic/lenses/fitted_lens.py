r"""A real main lens for waves from many points: its exit pupil as polynomials of pupil position, field and distance.

`ExitPupil` traces and fits the light of one point. This module fits rays of points over the whole field and range of
distances together, so that the number of rays does not depend on the number of points. One polynomial is the difference
of the path from that of a sphere around the paraxial image (the wave aberration, distortion included: Welford,
"Aberrations of Optical Systems", chapters 7 and 8); others are the amplitude and the edge of each vignetting surface.
Rays of other points within the same range check the fit.

Derivatives with respect to focal length, aperture radius and wavelength are fitted to the same rays, traced through two
slightly different lenses. Along a ray a fitted function F changes by :math:`F' + \nabla F \cdot P'`, where P' is the
change of the ray's position P on the exit pupil and F' the change at a fixed position; polynomials of the same degrees
are fitted to F'. The scene point is fixed in the camera frame, whereas the entrance pupil moves with the focal length.
All quantities refer to the pupils of the unchanged lens.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import numpy as np

from ..camera import PlenopticCamera
from ..errors import put, refuse_if
from ..optics import in_millimetres
from ..runtime import Doubles, Facts, Integers, Named, Pair, Triple, drjit_array, single_threaded_blas, turn
from .accuracy import ACCURACY
from .protocol import Entrance, Traced
from .pupil import Pupil
from .pupil_fit import PupilFit, PupilRays, entrance_place, nodes, trace_all
from .pupil_polynomials import LensLight, Polynomial, PupilPolynomial, fit

FAR = 1e13
"""Distance in millimetres at which light counts as collimated."""


@dataclass(frozen=True)
class ImageStretch:
    """Ratio of the array positions of object points' chief rays to the positions that reconstruction bins assume."""

    # Distances of object points from the axis on the scale of the bins, :math:`X b / g`, in the lit field, (n,).
    places: Doubles
    # Distances of the chief rays from the axis over `places`, (n,).
    ratio: Doubles
    # Local magnification of areas, (n,).
    area: Doubles


@dataclass(frozen=True, eq=False)
class FittedLens:
    """A real main lens at one wavelength, for scene points within a range of fields and distances."""

    system: Any
    # Radius in millimetres of a circle about the axis that contains the open exit pupil for the whole detector.
    reach: float
    fitted: PupilFit
    # Derivatives by parameters, cached by name; see `lens_change`.
    changes: dict[str, LensChange] = field(default_factory=dict, init=False, repr=False)

    is_uniform = False

    @functools.cached_property
    def pupil(self) -> Pupil:
        """Exit pupil, with the radius `reach`."""
        return Pupil(self.reach, float(self.system.pupil.distance))

    @property
    def window(self) -> Pupil:
        """The exit pupil, which bounds the directions of rays at the array."""
        return self.pupil

    @property
    def entrance(self) -> Entrance:
        """Entrance pupil of the lens."""
        return self.system.entrance

    def vergence(self, distance: Any) -> Any:
        """Return the reciprocal of the distance from the rear principal plane to the image of an object plane."""
        return self.system.vergence(distance)

    def convergence(self, distance: Any) -> Any:
        """Return the reciprocal of the distance from the exit pupil to the image of an object plane."""
        return self.fitted.pupils.convergence(1 / (distance - self.fitted.pupils.entrance))

    def trace(self, position: Pair, slope: Pair) -> Traced:
        """Return the ray from a position on the MLA to the scene, as `MainLens.trace` does."""
        return self.system.trace(position, slope)

    def ray(self, pupil: Pair, position: Pair) -> Traced:
        """Return the ray from a position on the MLA through a pupil point, as `MainLens.ray` does."""
        return self.system.ray(pupil, position)

    def open_fraction(self, x: Doubles, y: Doubles) -> Doubles:
        """Return the open fraction of the pupil, seen from positions on the MLA, as `MainLens.open_fraction` does."""
        return self.system.open_fraction(x, y)

    def bind(self, points: Doubles, index: Any = None, changes: Sequence[tuple[Any, LensChange]] = ()) -> LensLight:
        """Return the light of some points, as `MainLens.bind` does, with gradients of each amount of a change."""
        fitted = self.fitted
        pupils = self.fitted.pupils
        field, inverse_distance = pupils.field(points)

        def lanes(column: Doubles) -> Any:
            if index is None:
                return np.ascontiguousarray(column)[:, None]
            Float64 = dr.float64_array_t(type(index))
            return dr.gather(Float64, drjit_array(Float64, column), index)

        positions = lanes(field[:, 0]), lanes(field[:, 1])

        def over_pupil(polynomial: Polynomial, *slopes: Polynomial) -> PupilPolynomial:
            coefficients = [lanes(column) for column in polynomial.at(field, inverse_distance).T]
            for (amount, _), slope in zip(changes, slopes, strict=True):
                along = [lanes(column) for column in slope.at(field, inverse_distance).T]
                coefficients = [c + amount * change for c, change in zip(coefficients, along, strict=True)]
            return polynomial.over_pupil(coefficients, positions)

        slope = pupils.slope(field)
        return LensLight(
            self.pupil.distance,
            (lanes(slope[:, 0]), lanes(slope[:, 1])),
            lanes(pupils.convergence(inverse_distance)),
            over_pupil(fitted.aberration, *(change.aberration for _, change in changes)),
            over_pupil(fitted.brightness, *(change.brightness for _, change in changes)),
            [over_pupil(*stops) for stops in zip(fitted.stops, *(change.stops for _, change in changes), strict=True)],
        )

    def varying(self, numbers: Facts, names: Container[str], turned: Any) -> Any:
        """Return the lens with the gradients of its parameters, as `MainLens.varying` does."""
        changed = {name: numbers[name] for name in LENS_NUMBERS if name in names}
        return VaryingLens(self, numbers["mla_distance"], changed, turned)

    def opaque(self, convert: Callable[[Any], Any]) -> FittedLens:
        """Return this lens, whose parameters are stored in arrays and are opaque already."""
        return self

    def image_stretch(self, camera: PlenopticCamera, distance: float) -> ImageStretch:
        """Return the stretch of an object plane's image, up to the corners of the bins."""
        g = min(distance, FAR)
        near = float(self.fitted.pupils.field(np.array([[0.0, 0.0, g]]))[1][0])
        corner = math.hypot(*camera.bin_count) / 2 * camera.row_pitch
        corner = min(corner, ACCURACY.used_field * self.fitted.aberration.scales.field / near * camera.mla_distance / g)
        positions = np.linspace(0, corner, ACCURACY.stretch_fields)[1:]
        points = np.column_stack([0 * positions, -positions * g / camera.mla_distance, np.full(len(positions), g)])
        images = self.images(points)[:, 1]
        growth = np.gradient(np.append(0, images), np.append(0, positions))[1:]
        refuse_if(
            images.min() <= 0 or growth.min() <= 0,
            f"distance = {distance:g}: the main_lens distorts so that the image of this plane folds",
        )
        ratio = images / positions
        return ImageStretch(positions, ratio, ratio * growth)

    def images(self, points: Doubles) -> Doubles:
        """Return the positions (n, 2) on the MLA of the rays from scene points through the exit pupil's centre."""
        zero = np.zeros((len(points), 1))
        return np.concatenate(self.bind(points).land((zero, zero), None), axis=1)

    def points(self, images: Doubles, inverse_distance: Doubles) -> Doubles:
        """Return the scene points (n, 3) with given images and inverse distances."""
        pupils = self.fitted.pupils
        distance = 1 / inverse_distance
        depth = distance + pupils.entrance
        field = -images * (pupils.magnification / self.pupil.distance)
        reached = field
        for _ in range(ACCURACY.inversions):
            reached = self.images(np.column_stack([field * distance[:, None], depth]))
            square = (reached**2).sum(1)
            far = square > 0
            field = field * np.where(far, (reached * images).sum(1) / np.where(far, square, 1), 1)[:, None]
        return np.column_stack([field * distance[:, None], depth])

    def within(self, images: Doubles) -> Doubles:
        """Return positions (..., 2) on the MLA, moved to the edge of the illuminated field if they lie outside."""
        away = np.hypot(images[..., 0], images[..., 1])[..., None]
        return images * np.minimum(1, self._covered / np.maximum(away, 1e-12))

    @functools.cached_property
    def _covered(self) -> float:
        """Distance in mm from the axis up to which light from points at every distance reaches the array."""
        scales = self.fitted.aberration.scales
        entrance = self.fitted.pupils.entrance
        distances = [
            min(1 / max(near, 1e-300), FAR) for near in (scales.middle - scales.half, scales.middle + scales.half)
        ]
        ends = [[0.0, scales.field * distance, distance + entrance] for distance in distances]
        return ACCURACY.used_field * float(np.hypot(*self.images(np.array(ends)).T).min())

    def path_change(self, radius: Any, step: Any, wavelength: float) -> Any:
        """Return the difference, in waves, of wavefronts whose images lie a step apart, as `MainLens.path_change` does.

        The motion of vignetting edges contributes, too.
        """
        positions, paths, edges = self._changes
        path = np.interp(radius, positions, paths)
        edge = np.interp(radius, positions, edges)
        across = ACCURACY.edge_weight * edge * step / self.pupil.distance
        return (ACCURACY.path_weight * path + across) * (step / in_millimetres(wavelength))

    @functools.cached_property
    def _changes(self) -> Triple:
        """Largest changes of path and edge per motion of an image, by the distance of the image from the axis.

        The maximum is taken over object distances and over radial and tangential motion. Changes are per millimetre of
        motion: of the path in millimetres, without the tilt at the centre, and of the position of an edge on the pupil.
        """
        scales = self.fitted.aberration.scales
        angle = 2 * math.pi * (np.arange(ACCURACY.compared_angles) + 0.5) / ACCURACY.compared_angles
        circle = ACCURACY.compared_rim * self.reach * np.stack([np.cos(angle), np.sin(angle)])
        x, y = (
            circle[:, None] * (np.arange(1, ACCURACY.compared_radii + 1) / ACCURACY.compared_radii)[:, None]
        ).reshape(2, 1, -1)
        heights = np.linspace(0, scales.field, ACCURACY.compared_fields)
        middle = (0.0, 0.0)
        positions, paths, edges = np.zeros((3, ACCURACY.compared_fields))
        for inverse_distance in scales.middle + scales.half * np.array([-1.0, 0.0, 1.0]):
            distance = 1 / (inverse_distance or 1e-12)
            points = np.column_stack([0 * heights, heights * distance, np.full(ACCURACY.compared_fields, distance)])
            points[:, 2] += self.fitted.pupils.entrance
            images = self.images(points)
            here = self.bind(points)
            positions = np.maximum(positions, np.hypot(*images.T))
            step = 1e-3 * float(np.hypot(*images.T).max())
            edge = here.inside((x, y))
            for aside in (np.array([0.0, step]), np.array([step, 0.0])):
                there = self.bind(self.points(images + aside, np.full(ACCURACY.compared_fields, 1 / distance)))
                tilt = [b - a for a, b in zip(here.cosines(middle, None), there.cosines(middle, None), strict=True)]
                path = there.length((x, y)) - here.length((x, y)) - x * tilt[0] - y * tilt[1]
                paths = np.maximum(paths, np.abs(np.where(edge > 0, path, 0)).max(1) / step)
                moved = np.where(np.abs(edge) < ACCURACY.edge_distance * self.reach, there.inside((x, y)) - edge, 0)
                edges = np.maximum(edges, np.abs(moved).max(1) / step)
        return positions, paths, edges


_TOGETHER = 16
"""Points that are computed together."""


def open_area(lens: FittedLens, points: Doubles) -> Doubles:
    """Return the unvignetted area of the exit pupil for points (n, 3), in square millimetres, (n,)."""

    def measured(some: Doubles) -> Doubles:
        step, edge, pupil = places(lens)
        _, least = edges(lens.bind(some), pupil)
        return np.clip(least / edge + 0.5, 0, 1).sum(1) * step**2

    return at_all(lens, points, measured)


def places(lens: FittedLens) -> tuple[float, float, Pair]:
    """Return the sampling step on the exit pupil, the width of softened edges, and the sample positions."""
    step = 2 * lens.reach / ACCURACY.area_samples
    beyond = round(ACCURACY.area_edge)
    axis = (np.arange(-beyond, ACCURACY.area_samples + beyond) + 0.5) * step - lens.reach
    x, y = (plane.reshape(1, -1) for plane in np.meshgrid(axis, axis))
    return step, ACCURACY.area_edge * step, (x, y)


def edges(light: LensLight, pupil: Pair) -> tuple[Integers, Doubles]:
    """Return the index of the edge nearest to each position, and the position's distance from it, positive inside."""
    away = np.stack([replace(light, stops=[stop]).inside(pupil) for stop in light.stops])
    return away.argmin(0), away.min(0)


def at_all(lens: FittedLens, points: Doubles, measured: Callable[[Doubles], Doubles]) -> Doubles:
    """Return a measured quantity of each point, interpolated over field and inverse distance if points are many."""
    from scipy.interpolate import RegularGridInterpolator

    if len(points) <= ACCURACY.area_fields * ACCURACY.area_depths:
        parts = [measured(points[first : first + _TOGETHER]) for first in range(0, len(points), _TOGETHER)]
        return np.concatenate([np.empty(0), *parts])
    field, inverse_distance = lens.fitted.pupils.field(points)
    heights = np.hypot(*field.T)
    scales = lens.fitted.aberration.scales
    # The ranges are widened so that they are never empty.
    axes = (
        np.linspace(0, heights.max() + 1e-9 * scales.field, ACCURACY.area_fields),
        np.linspace(inverse_distance.min(), inverse_distance.max() + 1e-9 * scales.half, ACCURACY.area_depths),
    )
    u, near = (plane.ravel() for plane in np.meshgrid(*axes, indexing="ij"))
    nodes = np.column_stack([0 * u, u / near, 1 / near + lens.fitted.pupils.entrance])
    table = at_all(lens, nodes, measured).reshape(ACCURACY.area_fields, ACCURACY.area_depths)
    return RegularGridInterpolator(axes, table, bounds_error=False)((heights, inverse_distance))


LENS_NUMBERS = ("focal_length", "aperture_radius", "wavelength")
"""Parameters that change the light on the exit pupil."""


@dataclass(frozen=True, eq=False)
class LensChange:
    """Derivatives of a `FittedLens` with respect to one parameter."""

    # Derivative of the distance from the exit pupil to the MLA, in millimetres.
    pupil_distance: float
    aberration: Polynomial
    brightness: Polynomial
    stops: tuple[Polynomial, ...]


def lens_change(lens: FittedLens, name: str) -> LensChange:
    """Return the derivatives of a fitted lens with respect to one of `LENS_NUMBERS`, cached by the lens."""
    if name in lens.changes:
        return lens.changes[name]
    system = lens.system
    fitted = lens.fitted
    scales = fitted.aberration.scales
    step = ACCURACY.derivative_step * float(getattr(system, name))
    sides = [replace(system, **{name: getattr(system, name) + amount}) for amount in (step, -step)]
    depths = scales.middle - scales.half, scales.middle + scales.half
    start = nodes(float(system.aperture_radius), scales.field, depths)
    rays, valid = trace_all(system, *start)
    moved = []
    for changed_lens in sides:
        # From points of the same fields and inverse distances for the unchanged lens.
        field, inverse_distance, entrance = start
        nearer = 1 / (1 - inverse_distance * (entrance_place(changed_lens) - entrance_place(system)))
        moved.append(trace_all(changed_lens, field * nearer, inverse_distance * nearer, entrance)[0])
    for side in moved:
        valid &= np.isfinite([*side.position, side.path, side.amplitude]).all(0) & np.isfinite(side.stops).all(0)
    rays = rays.take(valid)
    more, less = [side.take(valid) for side in moved]
    # All refer to the field and inverse distance of the point with respect to the unchanged lens.
    more, less = (replace(side, field=rays.field, inverse_distance=rays.inverse_distance) for side in (more, less))
    shift = (more.position - less.position) / (2 * step)

    def values(side: PupilRays) -> list[Doubles]:
        path = side.path - fitted.pupils.sphere_path(side)
        return [path, side.amplitude, *side.stops[list(fitted.cutting)]]

    def changed(polynomial: Polynomial, high: Doubles, low: Doubles) -> Doubles:
        along = polynomial.at(np.column_stack([0 * rays.field, rays.field]), rays.inverse_distance).T
        _, x, y = polynomial.over_pupil(list(along), (0.0, rays.field)).gradient((rays.position[0], rays.position[1]))
        return (high - low) / (2 * step) - x * shift[0] - y * shift[1]

    polynomials = [fitted.aberration, fitted.brightness, *fitted.stops]
    changes = [changed(*parts) for parts in zip(polynomials, values(more), values(less), strict=True)]
    fits = []
    with single_threaded_blas():
        for some in (slice(0, 2), slice(2, None)):
            if changes[some]:
                degrees = polynomials[some][0].degrees
                targets = np.stack(changes[some])
                fits += fit(scales, degrees, rays.position, rays.field, rays.inverse_distance, targets)
    high, low = (float(side.pupil.distance) for side in sides)
    lens.changes[name] = LensChange((high - low) / (2 * step), fits[0], fits[1], tuple(fits[2:]))
    return lens.changes[name]


def open_area_slopes(lens: FittedLens, name: str, points: Doubles) -> Doubles:
    """Return the derivatives (n,) of the logarithm of the open area of each point with respect to a camera parameter.

    Points and lens are fixed; derivatives with respect to parameters outside `LENS_NUMBERS` are 0.
    """
    if name not in LENS_NUMBERS:
        return np.zeros(len(points))
    changes = lens_change(lens, name).stops

    def measured(some: Doubles) -> Doubles:
        _, edge, pupil = places(lens)
        light = lens.bind(some)
        stop, least = edges(light, pupil)
        fields, inverse_distance = lens.fitted.pupils.field(some)
        moved = np.zeros_like(least)
        for index, change in enumerate(changes):
            lanes = [column[:, None] for column in change.at(fields, inverse_distance).T]
            _, x, y = light.stops[index].gradient(pupil)
            # An edge is where the squared height is 1; it moves by the change of that square over its slope.
            value = change.over_pupil(lanes, (fields[:, :1], fields[:, 1:])).value(pupil)
            moved = np.where(stop == index, -value / np.sqrt(np.maximum(x * x + y * y, 1e-20)), moved)
        area = np.clip(least / edge + 0.5, 0, 1).sum(1)
        return np.where(np.abs(least) < edge / 2, moved, 0).sum(1) / (edge * area)

    return at_all(lens, points, measured)


@dataclass(frozen=True)
class VaryingLens:
    """A fitted lens with gradients; it offers the part of `MainLens` that `points.patch_factors` uses."""

    # The lens for plain parameters.
    base: FittedLens
    mla_distance: Any
    # Dr.Jit values with gradients, by names of `LENS_NUMBERS`; parameters that are absent are fixed.
    numbers: Named
    # Counter-clockwise rotation, in degrees, of the frame of the points against the scene.
    turned: Any = 0.0
    pupil: Pupil = field(init=False)
    _changes: list[tuple[Any, LensChange]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        system = self.base.system
        changes = []
        distance = self.base.pupil.distance + (self.mla_distance - float(system.mla_distance))
        for name in LENS_NUMBERS:
            if name in self.numbers:
                value = self.numbers[name]
                change = lens_change(self.base, name)
                amount = value - dr.detach(value)
                changes.append((amount, change))
                distance = distance + amount * change.pupil_distance
        # A circle about the axis contains the exit pupil, and scales with vignetting edges.
        radius = self.base.reach
        if "aperture_radius" in self.numbers:
            value = self.numbers["aperture_radius"]
            # 1, with the relative gradient of the value.
            radius = value / dr.detach(value) * float(radius)
        put(self, pupil=Pupil(radius, distance), _changes=changes)

    def bind(self, points: Doubles, index: Any) -> LensLight:
        """Return the light of some points, as `MainLens.bind` does for Dr.Jit, without gradients of `LensLight.land`.

        The light's coefficients are c + a c' with amounts a that are zero and carry the gradients.
        """
        light = self.base.bind(points, index, self._changes)

        def with_scene(polynomial: PupilPolynomial) -> PupilPolynomial:
            return replace(polynomial, field=turn(*polynomial.field, -self.turned))

        return replace(
            light,
            slope=turn(*light.slope, -self.turned),
            aberration=with_scene(light.aberration),
            brightness=with_scene(light.brightness),
            stops=[with_scene(stop) for stop in light.stops],
        )
