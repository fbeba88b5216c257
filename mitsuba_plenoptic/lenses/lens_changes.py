r"""How the light on the exit pupil of a real main lens changes with its focal length, its opening and the wavelength.

The rays to which a lens was fitted (see `fitted_lens`) are traced through two lenses that are a little different. Along
a ray a fitted function F changes by :math:`F' + \nabla F \cdot P'`, where the ray's place P on the exit pupil changes,
too; F', the change at the place, is what polynomials of the same degrees are fitted to. The scene point stands still in
the camera frame, whereas with the focal length the entrance pupil moves against it. All is told with the pupils of the
lens as it is.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..lattice import turn
from ..optics.phase import in_millimetres
from ..runtime.limits import single_threaded_blas
from .common import FinitePupil
from .fitted_lens import FittedLens
from .lens_system import LensSystem
from .open_pupil import at_all, edges, places
from .pupil_fit import PupilRays, entrance_place, nodes, trace_all
from .pupil_polynomials import LensLight, Place, Polynomial, PupilPolynomial, fit

LENS_NUMBERS = ("focal_length", "aperture_radius", "wavelength")
"""Numbers with which the light on the exit pupil changes."""

_STEP = 1e-4
"""Relative change of a number on either side."""


@dataclass(frozen=True, eq=False)
class LensChange:
    """What changes, for a change by 1, of a `FittedLens`."""

    # Distance from the exit pupil to the MLA, in millimetres.
    pupil_distance: float
    aberration: Polynomial
    brightness: Polynomial
    stops: tuple[Polynomial, ...]


def lens_change(lens: FittedLens, name: str) -> LensChange:
    """Return how a fitted lens changes with one of `LENS_NUMBERS`, which the lens holds once it is found."""
    if name not in lens.changes:
        lens.changes[name] = _found_change(lens, name)
    return lens.changes[name]


def _found_change(lens: FittedLens, name: str) -> LensChange:
    system, fitted = lens.system, lens.fitted
    scales = fitted.aberration.scales
    step = _STEP * float(getattr(system, name))
    sides = [replace(system, **{name: getattr(system, name) + amount}) for amount in (step, -step)]
    depths = scales.middle - scales.half, scales.middle + scales.half
    start = nodes(float(system.aperture_radius), scales.field, depths)
    rays, kept = trace_all(system, *start)
    moved = [_seen_from(system, side, *start) for side in sides]
    for side in moved:
        kept &= np.isfinite([*side.place, side.path, side.amplitude]).all(0) & np.isfinite(side.stops).all(0)
    rays, (more, less) = rays.take(kept), [side.take(kept) for side in moved]
    # All are told with the field and nearness that the point has before the lens as it is.
    more, less = (replace(side, field=rays.field, nearness=rays.nearness) for side in (more, less))
    shift = (more.place - less.place) / (2 * step)

    def values(side: PupilRays) -> list[NDArray[np.float64]]:
        path = side.path - fitted.pupils.sphere_path(side)
        return [path, side.amplitude, *side.stops[list(fitted.cutting)]]

    def changed(polynomial: Polynomial, high: NDArray[np.float64], low: NDArray[np.float64]) -> NDArray[np.float64]:
        along = polynomial.at(np.column_stack([0 * rays.field, rays.field]), rays.nearness).T
        _, x, y = polynomial.over_pupil(list(along), (0.0, rays.field)).gradient((rays.place[0], rays.place[1]))
        return np.asarray((high - low) / (2 * step) - x * shift[0] - y * shift[1])

    polynomials = [fitted.aberration, fitted.brightness, *fitted.stops]
    changes = [changed(*parts) for parts in zip(polynomials, values(more), values(less), strict=True)]
    made: list[Polynomial] = []
    with single_threaded_blas():
        for some in (slice(0, 2), slice(2, None)):
            if changes[some]:
                degrees, found = polynomials[some][0].degrees, np.stack(changes[some])
                made += fit(scales, degrees, rays.place, rays.field, rays.nearness, found)
    high, low = (float(side.pupil_distance) for side in sides)
    return LensChange((high - low) / (2 * step), made[0], made[1], tuple(made[2:]))


def _seen_from(lens: LensSystem, other: LensSystem, field: NDArray, nearness: NDArray, entrance: NDArray) -> PupilRays:
    """Trace rays through another lens from the points that have some fields and nearnesses before the first."""
    nearer = 1 / (1 - nearness * (entrance_place(other) - entrance_place(lens)))
    return trace_all(other, field * nearer, nearness * nearer, entrance)[0]


def open_area_slopes(lens: FittedLens, name: str, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the derivatives of the logarithms of these areas by a number of the camera; (n,).

    The points and the lens stand still; by other numbers than `lens_changes.LENS_NUMBERS` the derivative is 0.
    """
    if name not in LENS_NUMBERS:
        return np.zeros(len(points))
    changes = lens_change(lens, name).stops

    def measured(some: NDArray[np.float64]) -> NDArray[np.float64]:
        _, edge, pupil = places(lens)
        light = lens.bind(some)
        stop, least = edges(light, pupil)
        fields, nearness = lens.fitted.pupils.field(some)
        moved = np.zeros_like(least)
        for number, change in enumerate(changes):
            lanes = [column[:, None] for column in change.at(fields, nearness).T]
            _, x, y = light.stops[number].gradient(pupil)
            # An edge is where the square is 1, and moves by its change over its slope.
            value = change.over_pupil(lanes, (fields[:, :1], fields[:, 1:])).value(pupil)
            moved = np.where(stop == number, -value / np.sqrt(np.maximum(x * x + y * y, 1e-20)), moved)
        area = np.clip(least / edge + 0.5, 0, 1).sum(1)
        return np.asarray(np.where(np.abs(least) < edge / 2, moved, 0).sum(1) / (edge * area))

    return at_all(lens, points, measured)


@dataclass(frozen=True)
class VaryingLens(FinitePupil):
    """A fitted lens; what it offers is what `capture.patch_factors` asks of a `MainLens`."""

    # The lens by plain numbers.
    base: FittedLens
    mla_distance: Any
    # Dr.Jit numbers by name, of `lens_changes.LENS_NUMBERS`, that carry gradients; others are held.
    numbers: dict[str, Any]
    # Degrees by which the frame of the points turns, counter-clockwise, against the scene.
    turned: Any = 0.0
    pupil_distance: Any = field(init=False)
    _changes: list[tuple[Any, LensChange]] = field(init=False, repr=False)

    is_round = True

    def __post_init__(self) -> None:
        system = self.base.system
        changes, distance = [], self.base.pupil_distance + (self.mla_distance - float(system.mla_distance))
        for name in LENS_NUMBERS:
            if name in self.numbers:
                number = self.numbers[name]
                change, amount = lens_change(self.base, name), number - dr.detach(number)
                changes.append((amount, change))
                distance = distance + amount * change.pupil_distance
        object.__setattr__(self, "pupil_distance", distance)
        object.__setattr__(self, "_changes", changes)

    @property
    def pupil_radius(self) -> Any:
        """Radius of a circle about the axis that holds the exit pupil: what hides parts of the pupil grows with it."""
        if "aperture_radius" not in self.numbers:
            return self.base.pupil_radius
        return grown(self.numbers["aperture_radius"]) * float(self.base.pupil_radius)

    def convergence(self, distance: Any) -> Any:
        """Return the reciprocal of the distance from the exit pupil to an object plane's image, which is held."""
        return self.base.convergence(distance)

    def bind(self, points: NDArray[np.float64], which: Any) -> VaryingLight:
        """Return the light of some points, as `MainLens.bind` does for Dr.Jit."""
        light = self.base.bind(points, which)
        fields, nearness = self.base.fitted.pupils.field(points)
        Float64 = dr.float64_array_t(type(which))

        def bound(polynomial: Any) -> PupilPolynomial:
            lanes = [
                dr.gather(Float64, Float64(np.ascontiguousarray(c)), which) for c in polynomial.at(fields, nearness).T
            ]
            return polynomial.over_pupil(lanes, light.aberration.field)

        changes = [
            Shown(amount, bound(c.aberration), bound(c.brightness), [bound(stop) for stop in c.stops])
            for amount, c in self._changes
        ]

        def with_scene(polynomial: PupilPolynomial) -> PupilPolynomial:
            return replace(polynomial, field=turn(*polynomial.field, -self.turned))

        base = replace(
            light,
            slope=turn(*light.slope, -self.turned),
            aberration=with_scene(light.aberration),
            brightness=with_scene(light.brightness),
            stops=[with_scene(stop) for stop in light.stops],
        )
        return VaryingLight(base, changes)


def grown(number: Any) -> Any:
    """Return by how much a number has grown: 1, with its gradient."""
    return number / dr.detach(number)


@dataclass(frozen=True)
class Shown:
    """The changes that one number makes over the pupil: `amount` is zero, and carries the gradient."""

    amount: Any
    aberration: PupilPolynomial
    brightness: PupilPolynomial
    stops: list[PupilPolynomial]


@dataclass(frozen=True)
class VaryingLight:
    """The light of one scene point a lane, as `LensLight`, and how it changes with some numbers."""

    # The light by plain numbers, of points that may turn.
    base: LensLight
    changes: list[Shown]

    def path(self, pupil: Place, point: Any, wavelength: Any) -> Any:
        """Return the path in waves, as `Light.path` does; the point must be the light's own."""
        length, held = self.base.length(pupil), dr.detach(pupil)
        for change in self.changes:
            length += change.amount * change.aberration.value(held)
        return length * (1 / in_millimetres(wavelength))

    def amplitude(self, pupil: Place, point: Any) -> Any:
        """Return the amplitude, as `Light.amplitude` does; the point must be the light's own."""
        result, held = self.base.amplitude(pupil, point), dr.detach(pupil)
        for change in self.changes:
            result += change.amount * change.brightness.value(held)
        return result

    def inside(self, pupil: Place) -> Any:
        """Return how far within the edges a place lies, as `Light.inside` does; near the edges with its changes."""
        least, held = None, dr.detach(pupil)
        for number, stop in enumerate(self.base.stops):
            away = replace(self.base, stops=[stop]).inside(pupil)
            if self.changes:
                _, x, y = stop.gradient(held)
                slope = dr.detach(dr.rsqrt(dr.maximum(x * x + y * y, 1e-20)))
                for change in self.changes:
                    # An edge is where the square is 1, and moves by its change over its slope.
                    away -= change.amount * change.stops[number].value(held) * slope
            least = away if least is None else dr.minimum(least, away)
        return least
