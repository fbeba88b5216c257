r"""Rays from scene points through a real main lens to the plane of its exit pupil, to which polynomials are fitted.

A scene point is described by its field, X and Y divided by its distance from the entrance pupil, and by its inverse
distance from there. Both are continuous through infinity, up to light that converges to a point behind the lens. Path,
amplitude and the heights on each surface are smooth functions of the exit pupil position. The polynomial for the path
is the difference from the path of a sphere around the paraxial image (the wave aberration, distortion included:
Welford, "Aberrations of Optical Systems", chapters 7 and 8).

`fit_pupil` fits the rays of points over a whole field and range of distances together, so that the number of rays does
not depend on the number of points; `ExitPupil` those of one point alone, as exactly as polynomials can.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import InputError, refuse_if
from ..optics import guards, in_millimetres
from ..runtime import Array, Doubles, Flags, Pair, Sizes, Triple
from . import sequential
from .accuracy import ACCURACY
from .lens_system import LensSystem
from .pupil import Pupil
from .pupil_polynomials import Degrees, LensLight, Polynomial, PupilPolynomial, Scales, fit


@dataclass(frozen=True)
class PupilRays:
    """Rays from points whose fields lie along y; all arrays have shape (n,) or (2, n)."""

    # Field, and inverse distance in 1/mm, of the point from which each ray comes, (n,).
    field: Doubles
    inverse_distance: Doubles
    # Positions in the planes of the exit and of the entrance pupil, in millimetres, (2, n).
    position: Doubles
    entrance: Doubles
    # Path to the exit pupil less that of the ray through the centre of the entrance pupil, in millimetres, (n,).
    path: Doubles
    # Modulus of the field on the exit pupil, up to a factor that depends on the point alone, (n,).
    amplitude: Doubles
    # Squared distance from the axis over the squared semi-aperture of each surface, (surfaces, n).
    stops: Doubles

    @property
    def open(self) -> Flags:
        """Mask of unvignetted rays."""
        return np.asarray((self.stops <= 1).all(axis=0))

    def take(self, index: Array) -> PupilRays:
        """Return a selection of the rays."""
        return PupilRays(*(np.asarray(getattr(self, name))[..., index] for name in self.__dataclass_fields__))


def entrance_place(lens: LensSystem) -> float:
    """Return the z coordinate of the entrance pupil in the camera frame, in mm."""
    return float(lens.scale * (lens.numbers.front_principal - lens.numbers.entrance_pupil))


def trace(lens: LensSystem, field: Array, inverse_distance: Array, entrance: Array) -> PupilRays:
    """Return the rays of `trace_all` that neither miss a surface nor pass far beyond its edge."""
    rays, valid = trace_all(lens, field, inverse_distance, entrance)
    return rays.take(valid)


def trace_all(lens: LensSystem, field: Array, inverse_distance: Array, entrance: Array) -> tuple[PupilRays, Flags]:
    r"""Return traced rays, and a mask of rays that neither miss a surface nor pass far beyond its edge.

    The amplitude is :math:`\frac{1}{|E v - u|^2 + 1} \sqrt{|dE / dP|}`, with u the field, v the inverse distance, E the
    position on the entrance pupil and P that on the exit pupil: the amplitude that a thin lens in the entrance pupil
    receives (see `ThinLens.amplitude`), transported along the rays.

    `field` and `inverse_distance` have the shape (n,), `entrance` (2, n), the mask (n,).
    """
    position, path, stops, slope = _follow(lens, field, inverse_distance, entrance)
    middle = _follow(lens, field, inverse_distance, np.zeros_like(entrance))[1]
    step = ACCURACY.ray_step * float(lens.aperture_radius)
    (ax, ay), (bx, by) = (
        (
            _follow(lens, field, inverse_distance, entrance + shift)[0]
            - _follow(lens, field, inverse_distance, entrance - shift)[0]
        )
        / (2 * step)
        for shift in (np.array([[step], [0]]), np.array([[0], [step]]))
    )
    with np.errstate(all="ignore"):
        away = (entrance[0] * inverse_distance) ** 2 + (entrance[1] * inverse_distance - field) ** 2 + 1
        amplitude = 1 / (away * np.sqrt(np.abs(ax * by - ay * bx)))
        finite = np.isfinite([*position, path - middle, amplitude]).all(0) & np.isfinite(stops).all(0)
        valid = finite & (stops <= ACCURACY.ray_height**2).all(0) & (slope < ACCURACY.steepest)
    return PupilRays(field, inverse_distance, position, entrance, path - middle, amplitude, stops), valid


def _follow(
    lens: LensSystem, field: Array, inverse_distance: Array, entrance: Array
) -> tuple[Array, Array, Array, Array]:
    """Return exit pupil positions, paths, squared heights over squared semi-apertures, and slopes behind the lens.

    All except the slopes are NaN where a ray misses a surface.
    """
    scale = float(lens.scale)
    numbers = lens.numbers
    x = entrance[0] * inverse_distance
    y = entrance[1] * inverse_distance - field
    length = np.sqrt(x * x + y * y + 1)
    square = (entrance**2).sum(0)
    before = (square * inverse_distance - 2 * entrance[1] * field) / (length + np.sqrt(field * field + 1))
    start = (*(entrance / scale), np.full_like(field, numbers.entrance_pupil))
    heights: list = []
    # Edges are ignored: only rays that miss a surface or are totally reflected are lost.
    elements = [sequential.widened(element, np.inf) for element in lens.forwards]
    with np.errstate(all="ignore"):
        (x, y, z), (L, M, N), met, path = sequential.follow(
            elements, start, (x / length, y / length, 1 / length), heights
        )
        left = (numbers.exit_pupil - z) / N
        position = scale * np.array([x + left * L, y + left * M])
        path = before + scale * (path + left)
        stops = np.array([h / float(e.semi_aperture) ** 2 for h, e in zip(heights, lens.forwards, strict=True)])
        slope = np.hypot(L, M) / N
    lost = np.where(met, 0.0, np.nan)
    return position + lost, path + lost, stops + lost, np.where(met, slope, np.inf)


Tracer = Callable[[Doubles, Doubles, Doubles], PupilRays]
"""Function from fields, inverse distances and positions on the entrance pupil to rays, see `trace`."""


@dataclass(frozen=True)
class Pupils:
    """The paraxial pupils of a lens, and the paraxial images of scene points."""

    # z coordinate of the entrance pupil in the camera frame, in millimetres.
    entrance: float
    # Coordinates on the exit pupil over those on the entrance pupil.
    magnification: float
    # Reciprocal of the distance from the exit pupil to the image of a point at infinity.
    at_infinity: float

    @classmethod
    def of(cls, lens: LensSystem) -> Pupils:
        """Return the pupils of a lens."""
        numbers = lens.numbers
        # The sign of a ray near the axis shows whether the exit pupil is inverted relative to the entrance pupil.
        near = trace(lens, np.zeros(1), np.zeros(1), np.array([[1e-3 * float(lens.aperture_radius)], [0.0]]))
        size = numbers.exit_radius / numbers.entrance_radius
        image = 1 / float(lens.vergence(math.inf)) + float(lens.pupil.distance) - float(lens.mla_distance)
        return cls(entrance_place(lens), float(math.copysign(size, near.position[0, 0])), 1 / image)

    def field(self, points: Doubles) -> Pair:
        """Return the fields (n, 2) and inverse distances (n,) of scene points (n, 3)."""
        inverse_distance = 1 / (points[:, 2] - self.entrance)
        return points[:, :2] * inverse_distance[:, None], inverse_distance

    def slope(self, field: Any) -> Any:
        """Return the slope from the exit pupil's centre to the paraxial image of a field."""
        return -field / self.magnification

    def convergence(self, inverse_distance: Any) -> Any:
        """Return the reciprocal of the distance from the exit pupil to the paraxial image, in 1/mm."""
        return self.at_infinity - inverse_distance / self.magnification**2

    def sphere_path(self, rays: PupilRays) -> Doubles:
        """Return the path of a perfect wave to the exit pupil, less the path to the pupil's centre, (n,)."""
        x, y = rays.position
        w = self.convergence(rays.inverse_distance)
        s = self.slope(rays.field)
        length = np.sqrt((x * w) ** 2 + (y * w - s) ** 2 + 1) + np.sqrt(s * s + 1)
        return (2 * y * s - (x * x + y * y) * w) / length


@dataclass(frozen=True)
class PupilFit:
    """Polynomials fitted to the light on the exit pupil, with the error of the fit."""

    # Paraxial pupils and images, which are the reference of the polynomials.
    pupils: Pupils
    # Path beyond that of a sphere around the paraxial image, in millimetres, and amplitude.
    aberration: Polynomial
    brightness: Polynomial
    # Squared distance from the axis over the squared semi-aperture, for each vignetting surface.
    stops: tuple[Polynomial, ...]
    # Indices of these surfaces.
    cutting: Sizes
    # Root mean square error of the path, in waves, of the worst point that checks the fit.
    error: float


def covered(tracer: Tracer, radius: float, field: float, inverse_distance: Pair) -> float:
    """Return the largest field, up to `field`, from which light passes the lens at both inverse distances."""
    fields = np.linspace(0, field, ACCURACY.covered_fields)
    across = np.linspace(-ACCURACY.fitted_radius, ACCURACY.fitted_radius, 2 * ACCURACY.fitted_rays) * radius
    least = field
    for near in inverse_distance:
        F, Y = (values.ravel() for values in np.meshgrid(fields, across))
        rays = tracer(F, np.full_like(F, near), np.stack([0 * Y, Y]))
        lit = rays.field[rays.open]
        least = min(least, float(lit.max()) if lit.size else 0.0)
    return least


def fit_pupil(
    tracer: Tracer,
    pupils: Pupils,
    radius: float,
    field: float,
    inverse_distance: Pair,
    wavelength: float,
    good: float = ACCURACY.path_error,
) -> PupilFit:
    """Return traced rays and polynomials of rising degree, until the path's error is at most `good` waves."""
    rays = tracer(*nodes(radius, field, inverse_distance))
    judges = tracer(*_random(radius, field, inverse_distance))
    is_open = rays.open
    refuse_if(not is_open.any(), "main_lens: no ray gets through it from where the scene points lie")
    judges = judges.take(judges.open)
    low, high = inverse_distance
    scales = Scales(float(np.hypot(*rays.position[:, is_open]).max()), field, (low + high) / 2, (high - low) / 2)

    def fitted(degrees: Degrees, *values: Doubles) -> list[Polynomial]:
        return fit(scales, degrees, rays.position, rays.field, rays.inverse_distance, np.stack(values))

    path = rays.path - pupils.sphere_path(rays)
    left = judges.path - pupils.sphere_path(judges)
    for degrees in itertools.starmap(Degrees, ACCURACY.degrees):
        aberration, brightness = fitted(degrees, path, rays.amplitude)
        error = _error(aberration, judges, left) / in_millimetres(wavelength)
        if error <= good:
            break
    # A surface that lets all traced rays through does not vignette.
    cutting = np.flatnonzero(rays.stops.max(1) > 1)
    stops = fitted(Degrees(*ACCURACY.stop_degrees), *rays.stops[cutting]) if cutting.size else []
    return PupilFit(pupils, aberration, brightness, tuple(stops), tuple(cutting.tolist()), error)


def nodes(radius: float, field: float, inverse_distance: Pair) -> Triple:
    """Return fields, inverse distances and positions of rays to fit, at Chebyshev nodes that include both ends.

    Only one side of the plane through axis and point is sampled, since the other side is its mirror image.
    """

    def between(low: float, high: float, count: int) -> Doubles:
        return (low + high) / 2 - (high - low) / 2 * np.cos(np.pi * np.arange(count) / (count - 1))

    axis = np.linspace(-ACCURACY.fitted_radius, ACCURACY.fitted_radius, ACCURACY.fitted_rays) * radius
    fields = np.sqrt(between(0, field**2, ACCURACY.fitted_fields))
    F, D, X, Y = np.meshgrid(
        fields, between(*inverse_distance, ACCURACY.fitted_depths), axis[axis >= 0], axis, indexing="ij"
    )
    within = np.hypot(X, Y) <= ACCURACY.fitted_radius * radius
    return F[within], D[within], np.stack([X[within], Y[within]])


def _random(radius: float, field: float, inverse_distance: Pair) -> Triple:
    """Return fields, inverse distances and positions of random rays that check a fit, sorted by point."""
    random = np.random.default_rng(0)
    F = np.repeat(field * np.sqrt(random.random(ACCURACY.checked_points)), ACCURACY.checking_rays)
    D = np.repeat(
        inverse_distance[0] + (inverse_distance[1] - inverse_distance[0]) * random.random(ACCURACY.checked_points),
        ACCURACY.checking_rays,
    )
    away = ACCURACY.fitted_radius * radius * np.sqrt(random.random(len(F)))
    angle = 2 * math.pi * random.random(len(F))
    return F, D, np.stack([away * np.cos(angle), away * np.sin(angle)])


def _error(aberration: Polynomial, rays: PupilRays, path: Doubles) -> float:
    """Return the path's root mean square error in mm for the worst point, apart from a constant."""
    worst = 0.0
    for field in np.unique(rays.field):
        some = rays.field == field
        if np.count_nonzero(some) < ACCURACY.least_open_rays:
            continue
        direction = np.array([[0.0, field]])
        near = rays.inverse_distance[some][:1]
        coefficients = [np.array(coefficient) for coefficient in aberration.at(direction, near)[0]]
        x, y = rays.position[:, some]
        fitted = aberration.over_pupil(coefficients, (0.0, field)).value((x, y))
        worst = max(worst, float(np.std(fitted - path[some])))
    return worst


@dataclass(frozen=True)
class ExitPupil(LensLight):
    """The light of one scene point on the exit pupil, fitted to rays of this point alone."""

    # The exit pupil, with a radius that contains its open part.
    pupil: Pupil
    # Positions (n, 2) and direction cosines (n, 2) of the rays that pass the lens.
    bundle: Pair
    # Root mean square error of the path in waves.
    error: float

    @classmethod
    def of(cls, lens: LensSystem, point: Triple) -> ExitPupil:
        """Return the light of a point on the exit pupil of a lens, fitted to traced rays.

        Raises
        ------
        InputError
            If the point does not lie before the lens, or no light of it passes the lens.
        PhysicsError
            If the path cannot be fitted.
        """
        front = max(lens.front_bounds[1])
        if not point[2] > front:
            raise InputError(f"position: g = {point[2]:g}: it must lie before the main_lens, beyond {front:.6g}")
        pupils = Pupils.of(lens)
        (direction,), (near,) = pupils.field(np.array([point]))
        field = float(np.hypot(*direction))
        axis = np.linspace(-ACCURACY.fitted_radius, ACCURACY.fitted_radius, ACCURACY.single_rays) * float(
            lens.aperture_radius
        )
        entrance = np.stack([plane.ravel() for plane in np.meshgrid(axis, axis)])
        count = entrance.shape[1]
        rays = trace(lens, np.full(count, field), np.full(count, near), entrance)
        is_open = rays.open
        if not is_open.any():
            raise InputError(f"position = ({', '.join(f'{c:g}' for c in point)}): no light of it passes the main_lens")
        # The beam's middle lies in the plane of axis and point.
        middle = float(rays.position[1, is_open].mean())
        radius = float(np.hypot(rays.position[0], rays.position[1] - middle).max())
        # On the axis there is no direction on which the light could depend.
        scales = Scales(radius + abs(middle), field or 1.0, near, 1.0)
        degrees = Degrees(ACCURACY.single_degree, ACCURACY.single_degree * (field > 0), 0)
        along = float(direction[0]), float(direction[1])

        def fitted(some: Any, *values: Doubles) -> list[PupilPolynomial]:
            subset = rays.take(some)
            polynomials = fit(
                scales, degrees, subset.position, subset.field, subset.inverse_distance, np.stack(values), alone=True
            )
            return [polynomial.over_pupil(polynomial.coefficients[0, 0].tolist(), along) for polynomial in polynomials]

        path = rays.path - pupils.sphere_path(rays)
        checking = np.arange(len(path)) % 2 == 1
        (aberration,) = fitted(~checking, path[~checking])
        left = path - replace(aberration, field=(0.0, field)).value((rays.position[0], rays.position[1]))
        error = float(np.std(left[checking & is_open])) / in_millimetres(lens.light)
        guards.check(guards.MAIN_LENS, -math.expm1(-((2 * math.pi * error) ** 2)))
        # A surface that lets all traced rays through does not vignette.
        brightness, *stops = fitted(slice(None), rays.amplitude, *rays.stops[rays.stops.max(1) > 1])
        # Nothing is inside beyond the circle around the rays.
        shift = middle / scales.field
        circle = np.array([scales.radius**2 / 2, scales.radius**2 / 2 + middle**2, -2 * shift / scales.mixed])
        stops.append(PupilPolynomial(scales, Degrees(2, 1, 0), (circle / radius**2).tolist(), along))
        # From the frame in which the point lies along y to that of the camera.
        u, v = direction / scales.field if field else (0.0, 1.0)
        x, y = rays.position[:, is_open]
        places = np.column_stack([x * v + y * u, y * v - x * u])
        open_radius = float(np.hypot(x, y).max()) + radius / ACCURACY.single_rays
        slope = pupils.slope(direction).tolist()
        convergence = float(pupils.convergence(near))
        light = float(lens.pupil.distance), (slope[0], slope[1]), convergence, aberration, brightness, stops
        cosines = np.column_stack(LensLight(*light).cosines((places[:, 0], places[:, 1]), None))
        return cls(*light, Pupil(open_radius, light[0]), (places, cosines), error)
