r"""Derivatives of the light on a real main lens's exit pupil by its focal length, aperture radius and wavelength.

The rays to which a lens was fitted (see `fitted_lens`) are traced through two slightly different lenses. Along a ray a
fitted function F changes by :math:`F' + \nabla F \cdot P'`, where P' is the change of the ray's position P on the exit
pupil and F' the change at a fixed position; polynomials of the same degrees are fitted to F'. The scene point is fixed
in the camera frame, whereas the entrance pupil moves with the focal length. All quantities refer to the pupils of the
unchanged lens.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..lattice import turn
from ..optics.waves import in_millimetres
from ..runtime.backend import drjit_array
from ..runtime.limits import single_threaded_blas
from .common import FinitePupil
from .fitted_lens import FittedLens, at_all, edges, places
from .lens_system import LensSystem
from .main_lens import Pair
from .pupil_fit import PupilRays, entrance_place, nodes, trace_all
from .pupil_polynomials import LensLight, Polynomial, PupilPolynomial, fit

LENS_NUMBERS = ("focal_length", "aperture_radius", "wavelength")
"""Parameters that change the light on the exit pupil."""

_STEP = 1e-4
"""Relative change of a parameter on either side."""


@dataclass(frozen=True, eq=False)
class LensChange:
    """Derivatives of a `FittedLens` by one parameter."""

    # Derivative of the distance from the exit pupil to the MLA, in millimetres.
    pupil_distance: float
    aberration: Polynomial
    brightness: Polynomial
    stops: tuple[Polynomial, ...]


def lens_change(lens: FittedLens, name: str) -> LensChange:
    """Return the derivatives of a fitted lens by one of `LENS_NUMBERS`, which the lens caches."""
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
    rays, valid = trace_all(system, *start)
    moved = [_seen_from(system, side, *start) for side in sides]
    for side in moved:
        valid &= np.isfinite([*side.place, side.path, side.amplitude]).all(0) & np.isfinite(side.stops).all(0)
    rays, (more, less) = rays.take(valid), [side.take(valid) for side in moved]
    # All refer to the field and inverse distance of the point with respect to the unchanged lens.
    more, less = (replace(side, field=rays.field, inverse_distance=rays.inverse_distance) for side in (more, less))
    shift = (more.place - less.place) / (2 * step)

    def values(side: PupilRays) -> list[NDArray[np.float64]]:
        path = side.path - fitted.pupils.sphere_path(side)
        return [path, side.amplitude, *side.stops[list(fitted.cutting)]]

    def changed(polynomial: Polynomial, high: NDArray[np.float64], low: NDArray[np.float64]) -> NDArray[np.float64]:
        along = polynomial.at(np.column_stack([0 * rays.field, rays.field]), rays.inverse_distance).T
        _, x, y = polynomial.over_pupil(list(along), (0.0, rays.field)).gradient((rays.place[0], rays.place[1]))
        return np.asarray((high - low) / (2 * step) - x * shift[0] - y * shift[1])

    polynomials = [fitted.aberration, fitted.brightness, *fitted.stops]
    changes = [changed(*parts) for parts in zip(polynomials, values(more), values(less), strict=True)]
    made: list[Polynomial] = []
    with single_threaded_blas():
        for some in (slice(0, 2), slice(2, None)):
            if changes[some]:
                degrees, found = polynomials[some][0].degrees, np.stack(changes[some])
                made += fit(scales, degrees, rays.place, rays.field, rays.inverse_distance, found)
    high, low = (float(side.pupil_distance) for side in sides)
    return LensChange((high - low) / (2 * step), made[0], made[1], tuple(made[2:]))


def _seen_from(
    lens: LensSystem, other: LensSystem, field: NDArray, inverse_distance: NDArray, entrance: NDArray
) -> PupilRays:
    """Return rays through another lens from points whose fields and inverse distances refer to the first lens."""
    nearer = 1 / (1 - inverse_distance * (entrance_place(other) - entrance_place(lens)))
    return trace_all(other, field * nearer, inverse_distance * nearer, entrance)[0]


def open_area_slopes(lens: FittedLens, name: str, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the derivatives (n,) of the logarithms of the open areas by a parameter of the camera.

    The points and the lens are fixed; the derivative by parameters that are not in `LENS_NUMBERS` is 0.
    """
    if name not in LENS_NUMBERS:
        return np.zeros(len(points))
    changes = lens_change(lens, name).stops

    def measured(some: NDArray[np.float64]) -> NDArray[np.float64]:
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
        return np.asarray(np.where(np.abs(least) < edge / 2, moved, 0).sum(1) / (edge * area))

    return at_all(lens, points, measured)


@dataclass(frozen=True)
class VaryingLens(FinitePupil):
    """A fitted lens with gradients; it offers the part of `MainLens` that `points.patch_factors` uses."""

    # The lens for plain parameters.
    base: FittedLens
    mla_distance: Any
    # Dr.Jit values with gradients, by names of `LENS_NUMBERS`; parameters that are absent are fixed.
    numbers: dict[str, Any]
    # Counter-clockwise rotation, in degrees, of the frame of the points against the scene.
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
        """Radius of a circle about the axis that contains the exit pupil: vignetting edges scale with it."""
        if "aperture_radius" not in self.numbers:
            return self.base.pupil_radius
        return grown(self.numbers["aperture_radius"]) * float(self.base.pupil_radius)

    def convergence(self, distance: Any) -> Any:
        """Return the reciprocal of the distance from the exit pupil to the image of a plane, without gradients."""
        return self.base.convergence(distance)

    def bind(self, points: NDArray[np.float64], which: Any) -> VaryingLight:
        """Return the light of some points, as `MainLens.bind` does for Dr.Jit."""
        light = self.base.bind(points, which)
        fields, inverse_distance = self.base.fitted.pupils.field(points)
        Float64 = dr.float64_array_t(type(which))

        def bound(polynomial: Any) -> PupilPolynomial:
            lanes = [
                dr.gather(Float64, drjit_array(Float64, c), which) for c in polynomial.at(fields, inverse_distance).T
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
    """Return a value over its detached copy: 1, with its relative gradient."""
    return number / dr.detach(number)


@dataclass(frozen=True)
class Shown:
    """The changes over the pupil by one parameter: `amount` is zero and carries the gradient."""

    amount: Any
    aberration: PupilPolynomial
    brightness: PupilPolynomial
    stops: list[PupilPolynomial]


@dataclass(frozen=True)
class VaryingLight:
    """The light of one scene point per lane, as `LensLight`, and its changes with parameters."""

    # The light for plain parameters, of points that may be rotated.
    base: LensLight
    changes: list[Shown]

    def path(self, pupil: Pair, point: Any, wavelength: Any) -> Any:
        """Return the path in waves, as `Light.path` does; the point must be the one to which the light is bound."""
        length, held = self.base.length(pupil), dr.detach(pupil)
        for change in self.changes:
            length += change.amount * change.aberration.value(held)
        return length * (1 / in_millimetres(wavelength))

    def amplitude(self, pupil: Pair, point: Any) -> Any:
        """Return the amplitude, as `Light.amplitude` does; the point must be the one to which the light is bound."""
        result, held = self.base.amplitude(pupil, point), dr.detach(pupil)
        for change in self.changes:
            result += change.amount * change.brightness.value(held)
        return result

    def inside(self, pupil: Pair) -> Any:
        """Return the distance from the edges, as `Light.inside` does, with gradients accurate near the edges."""
        least, held = None, dr.detach(pupil)
        for index, stop in enumerate(self.base.stops):
            away = replace(self.base, stops=[stop]).inside(pupil)
            if self.changes:
                _, x, y = stop.gradient(held)
                slope = dr.detach(dr.rsqrt(dr.maximum(x * x + y * y, 1e-20)))
                for change in self.changes:
                    # An edge is where the squared height is 1; it moves by the change of that square over its slope.
                    away -= change.amount * change.stops[index].value(held) * slope
            least = away if least is None else dr.minimum(least, away)
        return least
