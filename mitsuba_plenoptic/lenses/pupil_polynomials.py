r"""Polynomials over pupil, field and distance for a lens that is rotationally symmetric.

A scalar of such a lens depends on the position P on the pupil and on the field u of a scene point only through the
invariants :math:`P^2`, :math:`P \cdot u` and :math:`u^2` (Welford, "Aberrations of Optical Systems", section 7.1), and
on the point's inverse distance v.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..optics import in_millimetres
from ..runtime import Doubles, Pair, Shape, Triple, minimum, safe_sqrt


@dataclass(frozen=True)
class Scales:
    """Scales of the variables, so that the arguments of all powers lie between -1 and 1."""

    # Radius of the pupil, in millimetres, and largest field.
    radius: float
    field: float
    # Centre of the range of inverse distances and half its width, in 1/mm.
    middle: float
    half: float

    def of_pupil(self, square: Any) -> Any:
        """Return the invariant of the pupil alone from the squared distance of a position from the axis."""
        return square * (2 / self.radius**2) - 1

    def of_points(self, square: Any, inverse_distance: Any) -> Pair:
        """Return the invariant of the field alone and the scaled inverse distance, both from -1 to 1."""
        return square * (2 / self.field**2) - 1, (inverse_distance - self.middle) * (1 / self.half)

    @property
    def mixed(self) -> float:
        """Factor on the scalar product of pupil position and field."""
        return 1 / (self.radius * self.field)


@dataclass(frozen=True)
class Degrees:
    """Degrees of a polynomial: the largest powers of pupil, of field, and of inverse distance."""

    pupil: int
    field: int
    depth: int

    @cached_property
    def pairs(self) -> list[Shape]:
        """Pairs of powers, of the pupil's invariant and of the mixed invariant, that occur in the polynomial."""
        powers = range(min(self.pupil, self.field) + 1)
        return [(b, c) for c in powers for b in range((self.pupil - c) // 2, -1, -1)]


@dataclass(frozen=True)
class Polynomial:
    """A polynomial in the inverse distance and the invariants of field and pupil."""

    scales: Scales
    degrees: Degrees
    # Coefficients of the powers, (depth + 1, field / 2 + 1, pairs).
    coefficients: Doubles

    def at(self, field: Doubles, inverse_distance: Doubles) -> Doubles:
        """Return the coefficients (n, pairs) of the pupil polynomial at fields (n, 2) and inverse distances (n,)."""
        f, d = self.scales.of_points((field**2).sum(1), inverse_distance)
        depth, fields, pairs = self.coefficients.shape
        powers = np.vander(d, depth, increasing=True)[:, :, None] * np.vander(f, fields, increasing=True)[:, None]
        return powers.reshape(len(f), depth * fields) @ self.coefficients.reshape(-1, pairs)

    def over_pupil(self, coefficients: list, field: Pair) -> PupilPolynomial:
        """Return the pupil polynomial of points with given fields, from the coefficients that `at` returns."""
        return PupilPolynomial(self.scales, self.degrees, coefficients, field)


def fit(
    scales: Scales,
    degrees: Degrees,
    position: Doubles,
    field: Doubles,
    inverse_distance: Doubles,
    values: Doubles,
    *,
    alone: bool = False,
) -> list[Polynomial]:
    """Return polynomials fitted to the values (k, n) of k functions by least squares.

    `position` (2, n) are those on the pupil, for points with fields along y; `alone` leaves out powers of the field
    alone, if all rays come from one point.
    """
    f, d = scales.of_points(field**2, inverse_distance)
    s = scales.of_pupil((position**2).sum(0))
    t = position[1] * field * scales.mixed
    terms = [(b, c, a) for b, c in degrees.pairs for a in range(1 if alone else (degrees.field - c) // 2 + 1)]
    highest = (degrees.pupil, degrees.field, degrees.field)
    powers = [np.vander(x, n + 1, increasing=True).T for x, n in zip((s, t, f), highest, strict=True)]
    base = np.stack([powers[0][b] * powers[1][c] * powers[2][a] for b, c, a in terms])
    depth = np.vander(d, degrees.depth + 1, increasing=True).T
    basis = (depth[:, None] * base).reshape(-1, len(s)).T
    orthogonal, triangle = np.linalg.qr(basis)
    solution = np.linalg.solve(triangle, orthogonal.T @ values.T).T.reshape(len(values), len(depth), len(terms))
    coefficients = np.zeros((len(values), len(depth), degrees.field // 2 + 1, len(degrees.pairs)))
    index = {pair: k for k, pair in enumerate(degrees.pairs)}
    for k, (b, c, a) in enumerate(terms):
        coefficients[:, :, a, index[b, c]] = solution[:, :, k]
    return [Polynomial(scales, degrees, fitted) for fitted in coefficients]


@dataclass(frozen=True)
class PupilPolynomial:
    """A polynomial over the pupil for one point, or for one point per lane."""

    scales: Scales
    degrees: Degrees
    # The arguments of `Polynomial.over_pupil`.
    coefficients: list
    field: Pair

    def value(self, pupil: Pair) -> Any:
        """Return the values at positions on the pupil, (x, y) in millimetres."""
        s, t = self._invariants(pupil)
        total = 0.0
        row = 0.0
        rows = []
        for (b, _), term in zip(self.degrees.pairs, self.coefficients, strict=True):
            row = row * s + term
            if b == 0:
                rows.append(row)
                row = 0.0
        for row in reversed(rows):
            total = total * t + row
        return total

    def gradient(self, pupil: Pair) -> Triple:
        """Return the values at pupil positions, and their derivatives along x and y, by Horner's rule as in `value`."""
        s, t = self._invariants(pupil)
        rows = []
        value = 0.0 * s
        slope = 0.0 * s
        for (b, _), term in zip(self.degrees.pairs, self.coefficients, strict=True):
            value, slope = value * s + term, slope * s + value
            if b == 0:
                rows.append((value, slope))
                value = 0.0 * s
                slope = 0.0 * s
        value = 0.0 * s
        along_s = 0.0 * s
        along_t = 0.0 * s
        for row, slope in reversed(rows):
            along_t = along_t * t + value
            value = value * t + row
            along_s = along_s * t + slope
        along_s = along_s * (4 / self.scales.radius**2)
        along_t = along_t * self.scales.mixed
        x, y = (P * along_s + u * along_t for P, u in zip(pupil, self.field, strict=True))
        return value, x, y

    def _invariants(self, pupil: Pair) -> Pair:
        x, y = pupil
        u, v = self.field
        return self.scales.of_pupil(x * x + y * y), (x * u + y * v) * self.scales.mixed


@dataclass(frozen=True)
class LensLight:
    """The light of one scene point for each row of NumPy arrays or each lane of Dr.Jit arrays."""

    # Distance from the exit pupil to the MLA in millimetres.
    pupil_distance: float
    # Slopes of the ray from the centre of the exit pupil to the paraxial image, (array, array).
    slope: Pair
    # Reciprocal of that image's distance from the exit pupil.
    convergence: Any
    # Path beyond that of a sphere around the paraxial image, in millimetres, and amplitude.
    aberration: PupilPolynomial
    brightness: PupilPolynomial
    # Squared distance from the axis over the squared semi-aperture, for each vignetting surface.
    stops: list[PupilPolynomial]

    def length(self, pupil: Pair) -> Any:
        """Return the path in mm to a position on the exit pupil, less a constant of the point."""
        x, y = pupil
        sx, sy = self.slope
        w = self.convergence
        sphere = 2 * (x * sx + y * sy) - (x * x + y * y) * w
        return sphere / (self._secant(pupil) + safe_sqrt(sx * sx + sy * sy + 1)) + self.aberration.value(pupil)

    def path(self, pupil: Pair, point: Any, wavelength: float) -> Any:
        """Return the path in waves, as `Light.path` does; the point must be the one to which the light is bound."""
        return self.length(pupil) * (1 / in_millimetres(wavelength))

    def amplitude(self, pupil: Pair, point: Any) -> Any:
        """Return the amplitude, as `Light.amplitude` does; the point must be the one to which the light is bound."""
        return self.brightness.value(pupil)

    def inside(self, pupil: Pair) -> Any:
        """Return the distance in mm of a position from the nearest edge, positive inside; accurate near edges."""
        least: Any = None
        for stop in self.stops:
            square, along_x, along_y = stop.gradient(pupil)
            # (1 - r) / |grad r| with r the root; the centre of the stop has no gradient
            root = safe_sqrt(square)
            away = (1 - root) * 2 * root / safe_sqrt(along_x * along_x + along_y * along_y)
            least = away if least is None else minimum(least, away)
        return least

    def is_open(self, pupil: Pair) -> Any:
        """Return whether light passes a position, as `Light.is_open` does."""
        result = True
        for stop in self.stops:
            result = (stop.value(pupil) <= 1) & result
        return result

    def cosines(self, pupil: Pair, point: Any) -> Pair:
        """Return the direction cosines of the light at the exit pupil, as `Light.cosines` does."""
        secant = self._secant(pupil)
        _, *change = self.aberration.gradient(pupil)
        cx, cy = (
            (s - P * self.convergence) / secant + more for s, P, more in zip(self.slope, pupil, change, strict=True)
        )
        return cx, cy

    def land(self, pupil: Pair, point: Any) -> Pair:
        """Return the positions on the MLA of rays through positions of the exit pupil, as `Light.land` does."""
        cosines = self.cosines(pupil, point)
        along = self.pupil_distance / safe_sqrt(1 - cosines[0] * cosines[0] - cosines[1] * cosines[1])
        x, y = (P + along * c for P, c in zip(pupil, cosines, strict=True))
        return x, y

    def _secant(self, pupil: Pair) -> Any:
        x, y = (P * self.convergence - s for P, s in zip(pupil, self.slope, strict=True))
        return safe_sqrt(x * x + y * y + 1)
