"""Rays from scene points through a real main lens to the plane of its exit pupil, of which polynomials are fitted.

A scene point is told by its field, X and Y over its distance from the entrance pupil, and by the reciprocal of that
distance, its nearness: both go on smoothly through infinity, to light that converges to a point behind the lens.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..optics.phase import in_millimetres
from . import sequential
from .lens_system import LensSystem
from .pupil_polynomials import Degrees, Polynomial, Scales, fit

_BEYOND = 1.1
"""How far beyond the surfaces' edges rays are followed, over their semi-apertures."""

_STEP = 1e-4
"""Distance of neighbouring rays over the pupil's radius, from which the density of rays is found."""

_STEEPEST = 10.0
"""Slope of the reference behind the lens, beyond which nothing is followed."""


@dataclass(frozen=True)
class PupilRays:
    """Rays of points whose fields lie along y; all arrays have shape (n,) or (2, n)."""

    # Of the point that each ray comes from; the nearness in 1/mm; (n,).
    field: NDArray[np.float64]
    nearness: NDArray[np.float64]
    # Where they pass the planes of the exit and of the entrance pupil, in millimetres; (2, n).
    place: NDArray[np.float64]
    entrance: NDArray[np.float64]
    # Path to the exit pupil less that of the ray through the middle of the entrance pupil, in millimetres; (n,).
    path: NDArray[np.float64]
    # Modulus of the field there, but for a factor of each point; (n,).
    amplitude: NDArray[np.float64]
    # For each surface the square of the distance from the axis over that of its edge; (surfaces, n).
    stops: NDArray[np.float64]

    @property
    def open(self) -> NDArray[np.bool_]:
        """Which of them all surfaces let through."""
        return np.asarray((self.stops <= 1).all(axis=0))

    def take(self, which: NDArray[Any]) -> PupilRays:
        """Return some of them."""
        return PupilRays(*(np.asarray(getattr(self, name))[..., which] for name in self.__dataclass_fields__))


def entrance_place(lens: LensSystem) -> float:
    """Return the place z of the entrance pupil in the camera frame."""
    return float(lens.scale * (lens.numbers.front_principal - lens.numbers.entrance_pupil))


def trace(lens: LensSystem, field: NDArray, nearness: NDArray, entrance: NDArray) -> PupilRays:
    """Trace rays as `trace_all` does; those that miss a surface, or pass one far beyond its edge, are left out."""
    rays, kept = trace_all(lens, field, nearness, entrance)
    return rays.take(kept)


def trace_all(
    lens: LensSystem, field: NDArray, nearness: NDArray, entrance: NDArray
) -> tuple[PupilRays, NDArray[np.bool_]]:
    r"""Trace rays, and tell which of them neither miss a surface nor pass one far beyond its edge.

    The amplitude is :math:`\frac{1}{|E v - u|^2 + 1} \sqrt{|dE / dP|}`, with u the field, v the nearness, E the place
    on the entrance pupil and P that on the exit pupil: what a thin lens in the entrance pupil takes (see
    `ThinLens.amplitude`), carried along the rays.

    Shapes: `field`, `nearness` (n,), `entrance` (2, n); the result (n,).
    """
    place, path, stops, slope = _follow(lens, field, nearness, entrance)
    middle = _follow(lens, field, nearness, np.zeros_like(entrance))[1]
    step = _STEP * float(lens.aperture_radius)
    (ax, ay), (bx, by) = (
        (_follow(lens, field, nearness, entrance + shift)[0] - _follow(lens, field, nearness, entrance - shift)[0])
        / (2 * step)
        for shift in (np.array([[step], [0]]), np.array([[0], [step]]))
    )
    with np.errstate(all="ignore"):
        away = (entrance[0] * nearness) ** 2 + (entrance[1] * nearness - field) ** 2 + 1
        amplitude = 1 / (away * np.sqrt(np.abs(ax * by - ay * bx)))
        told = np.isfinite([*place, path - middle, amplitude]).all(0) & np.isfinite(stops).all(0)
        kept = told & (stops <= _BEYOND**2).all(0) & (slope < _STEEPEST)
    return PupilRays(field, nearness, place, entrance, path - middle, amplitude, stops), kept


def _follow(
    lens: LensSystem, field: NDArray, nearness: NDArray, entrance: NDArray
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return places on the exit pupil, paths, the squares of the heights over the edges', and slopes behind the lens.

    All but the last are NaN where a ray misses a surface.
    """
    scale, numbers = float(lens.scale), lens.numbers
    x, y = entrance[0] * nearness, entrance[1] * nearness - field
    length = np.sqrt(x * x + y * y + 1)
    square = (entrance**2).sum(0)
    before = (square * nearness - 2 * entrance[1] * field) / (length + np.sqrt(field * field + 1))
    start = (*(entrance / scale), np.full_like(field, numbers.entrance_pupil))
    heights: list[Any] = []
    # No edge: only what misses a surface, or is reflected in whole, is lost.
    elements = [sequential.widened(element, np.inf) for element in lens.forwards]
    with np.errstate(all="ignore"):
        (x, y, z), (L, M, N), met, path = sequential.follow(
            elements, start, (x / length, y / length, 1 / length), heights
        )
        left = (numbers.exit_pupil - z) / N
        place = scale * np.array([x + left * L, y + left * M])
        path = before + scale * (path + left)
        stops = np.array([h / float(e.semi_aperture) ** 2 for h, e in zip(heights, lens.forwards, strict=True)])
        slope = np.hypot(L, M) / N
    lost = np.where(met, 0.0, np.nan)
    return place + lost, path + lost, stops + lost, np.where(met, slope, np.inf)


_DEGREES = (Degrees(6, 4, 4), Degrees(8, 6, 4), Degrees(10, 8, 5))
GOOD = 1e-3
"""Degrees that are tried until the path is met to so many waves root mean square."""

_STOPS = Degrees(4, 4, 2)
"""Degrees of what surfaces leave of beams: low ones, which go on smoothly where no rays are."""

_ACROSS, _WIDER = 21, 1.4
"""Rays across the entrance pupil, and how far out, in its radii, they are tried."""

_FIELDS, _DEPTHS = 11, 7
"""Points of which rays are fitted, along the field and along the nearness."""

_JUDGES, _JUDGING, _LEAST = 40, 300, 20
"""Points that judge a fit, rays of each that are tried, and open ones of them from which on it is heard."""

_COVERED = 64
"""Fields up to the largest one that are tried for light."""

Tracer = Callable[[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]], PupilRays]
"""From fields, nearnesses and places on the entrance pupil to rays, see `pupil_rays.trace`."""


@dataclass(frozen=True)
class Pupils:
    """The pupils of a lens by paraxial optics, and with them the image of a scene point."""

    # Place z of the entrance pupil in the camera frame, in millimetres.
    entrance: float
    # Places on the exit pupil over those on the entrance pupil.
    magnification: float
    # Reciprocal of the distance from the exit pupil to the image of infinity.
    at_infinity: float

    @classmethod
    def of(cls, lens: LensSystem) -> Pupils:
        """Take those of a lens."""
        numbers = lens.numbers
        # A ray near the axis tells whether the pupils are turned against each other.
        near = trace(lens, np.zeros(1), np.zeros(1), np.array([[1e-3 * float(lens.aperture_radius)], [0.0]]))
        size = numbers.exit_radius / numbers.entrance_radius
        image = 1 / float(lens.vergence(math.inf)) + float(lens.pupil_distance) - float(lens.mla_distance)
        return cls(entrance_place(lens), float(math.copysign(size, near.place[0, 0])), 1 / image)

    def field(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return fields (n, 2) and nearnesses (n,) of scene points (n, 3)."""
        nearness = 1 / (points[:, 2] - self.entrance)
        return points[:, :2] * nearness[:, None], nearness

    def slope(self, field: Any) -> Any:
        """Return the slope from the middle of the exit pupil to the image."""
        return -field / self.magnification

    def convergence(self, nearness: Any) -> Any:
        """Return the reciprocal of the distance from the exit pupil to the image."""
        return self.at_infinity - nearness / self.magnification**2

    def sphere_path(self, rays: PupilRays) -> NDArray[np.float64]:
        """Return the path to the exit pupil of a perfect wave towards the image, less that to its middle, (n,)."""
        (x, y), w, s = rays.place, self.convergence(rays.nearness), self.slope(rays.field)
        length = np.sqrt((x * w) ** 2 + (y * w - s) ** 2 + 1) + np.sqrt(s * s + 1)
        return (2 * y * s - (x * x + y * y) * w) / length


@dataclass(frozen=True)
class PupilFit:
    """What is fitted; `pupils` is what it is told with."""

    # Paraxial pupils and images.
    pupils: Pupils
    # Path beyond that of a sphere around the paraxial image, in millimetres, and amplitude.
    aberration: Polynomial
    brightness: Polynomial
    # Squares of the distances from the axis, over those of the edges, for each surface that cuts beams.
    stops: tuple[Polynomial, ...]
    # The numbers of these surfaces.
    cutting: tuple[int, ...]
    # Root mean square error of the path, in waves, of the worst of the points that judge it.
    error: float


def covered(tracer: Tracer, radius: float, field: float, nearness: tuple[float, float]) -> float:
    """Return the largest field, up to a given one, from which light gets through at all distances.

    Shapes: `nearness` (float, float).
    """
    fields, across = np.linspace(0, field, _COVERED), np.linspace(-_WIDER, _WIDER, 2 * _ACROSS) * radius
    least = field
    for near in nearness:
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
    nearness: tuple[float, float],
    wavelength: float,
    good: float = GOOD,
) -> PupilFit:
    """Trace rays and fit polynomials.

    Shapes: `nearness` (float, float).
    """
    rays, judges = tracer(*nodes(radius, field, nearness)), tracer(*_random(radius, field, nearness))
    is_open = rays.open
    if not is_open.any():
        raise InputError("main_lens: no ray gets through it from where the scene points lie")
    judges = judges.take(judges.open)
    low, high = nearness
    scales = Scales(float(np.hypot(*rays.place[:, is_open]).max()), field, (low + high) / 2, (high - low) / 2)

    def fitted(degrees: Degrees, *values: NDArray[np.float64]) -> list[Polynomial]:
        return fit(scales, degrees, rays.place, rays.field, rays.nearness, np.stack(values))

    path = rays.path - pupils.sphere_path(rays)
    left = judges.path - pupils.sphere_path(judges)
    for degrees in _DEGREES:
        aberration, brightness = fitted(degrees, path, rays.amplitude)
        error = _error(aberration, judges, left) / in_millimetres(wavelength)
        if error <= good:
            break
    # What lets all rays through ends no light.
    cutting = np.flatnonzero(rays.stops.max(1) > 1)
    stops = fitted(_STOPS, *rays.stops[cutting])
    return PupilFit(pupils, aberration, brightness, tuple(stops), tuple(cutting.tolist()), error)


def nodes(radius: float, field: float, nearness: tuple[float, float]) -> tuple[NDArray, NDArray, NDArray]:
    """Return fields, nearnesses and places of rays to fit, at the nodes of Chebyshev's polynomials and both ends.

    What lies at one side of the plane through axis and point is the mirror image of the other.
    """

    def between(low: float, high: float, count: int) -> NDArray[np.float64]:
        return (low + high) / 2 - (high - low) / 2 * np.cos(np.pi * np.arange(count) / (count - 1))

    axis = np.linspace(-_WIDER, _WIDER, _ACROSS) * radius
    fields = np.sqrt(between(0, field**2, _FIELDS))
    F, D, X, Y = np.meshgrid(fields, between(*nearness, _DEPTHS), axis[axis >= 0], axis, indexing="ij")
    within = np.hypot(X, Y) <= _WIDER * radius
    return F[within], D[within], np.stack([X[within], Y[within]])


def _random(radius: float, field: float, nearness: tuple[float, float]) -> tuple[NDArray, NDArray, NDArray]:
    """Return fields, nearnesses and places of rays that judge a fit, those of each point in a row."""
    random = np.random.default_rng(0)
    F = np.repeat(field * np.sqrt(random.random(_JUDGES)), _JUDGING)
    D = np.repeat(nearness[0] + (nearness[1] - nearness[0]) * random.random(_JUDGES), _JUDGING)
    away, angle = _WIDER * radius * np.sqrt(random.random(len(F))), 2 * math.pi * random.random(len(F))
    return F, D, np.stack([away * np.cos(angle), away * np.sin(angle)])


def _error(aberration: Polynomial, rays: PupilRays, path: NDArray[np.float64]) -> float:
    """Return the root mean square error of the path, but for a constant, of the worst point, in millimetres."""
    worst = 0.0
    for field in np.unique(rays.field):
        some = rays.field == field
        if np.count_nonzero(some) < _LEAST:
            continue
        one, near = np.array([[0.0, field]]), rays.nearness[some][:1]
        coefficients = [np.array(number) for number in aberration.at(one, near)[0]]
        x, y = rays.place[:, some]
        found = aberration.over_pupil(coefficients, (0.0, field)).value((x, y))
        worst = max(worst, float(np.std(found - path[some])))
    return worst
