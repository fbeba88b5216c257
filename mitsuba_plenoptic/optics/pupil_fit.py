"""Polynomials of a real main lens's exit pupil, fitted to rays of points at all fields and distances in question."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .lens_system import LensSystem
from .phase import in_millimetres
from .pupil_polynomials import Degrees, Polynomial, Scales, fit
from .pupil_rays import PupilRays, entrance_place, trace

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
    """The pupils of a lens by paraxial optics, and with them the image of a scene point.

    Attributes
    ----------
    entrance : float
        Place z of the entrance pupil in the camera frame, in millimetres.
    magnification : float
        Places on the exit pupil over those on the entrance pupil.
    at_infinity : float
        Reciprocal of the distance from the exit pupil to the image of infinity.
    """

    entrance: float
    magnification: float
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
    """What is fitted; `pupils` is what it is told with.

    Attributes
    ----------
    pupils : Pupils
        Paraxial pupils and images.
    aberration, brightness : Polynomial
        Path beyond that of a sphere around the paraxial image, in millimetres, and amplitude.
    stops : tuple of Polynomial
        Squares of the distances from the axis, over those of the edges, for each surface that cuts beams.
    cutting : tuple of int
        The numbers of these surfaces.
    error : float
        Root mean square error of the path, in waves, of the worst of the points that judge it.
    """

    pupils: Pupils
    aberration: Polynomial
    brightness: Polynomial
    stops: tuple[Polynomial, ...]
    cutting: tuple[int, ...]
    error: float


def covered(tracer: Tracer, radius: float, field: float, nearness: tuple[float, float]) -> float:
    """Return the largest field, up to a given one, from which light gets through at all distances.

    Parameters
    ----------
    tracer : callable
        Follows rays.
    radius : float
        Of the entrance pupil in millimetres.
    field : float
        The largest field.
    nearness : (float, float)
        Range of the nearnesses in 1/mm.
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

    Parameters
    ----------
    tracer : callable
        Follows rays.
    pupils : Pupils
        Paraxial pupils and images.
    radius : float
        Of the entrance pupil in millimetres.
    field : float
        The largest field.
    nearness : (float, float)
        Range of the nearnesses in 1/mm.
    wavelength : float
        Wavelength in nanometres.
    good : float
        Waves root mean square to which the path is met, if the highest degrees can.

    Raises
    ------
    InputError
        If no ray gets through.
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
