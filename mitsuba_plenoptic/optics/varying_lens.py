"""A real main lens whose numbers carry gradients, for the derivatives of waves: with their first order only."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..lattice import turn
from .finite_pupil import FinitePupil
from .fitted_lens import FittedLens
from .lens_changes import LENS_NUMBERS, LensChange, lens_change
from .lens_light import LensLight
from .phase import in_millimetres
from .pupil_polynomials import Place, PupilPolynomial


@dataclass(frozen=True)
class VaryingLens(FinitePupil):
    """A fitted lens; what it offers is what `capture.patch_factors` asks of a `MainLens`.

    Parameters
    ----------
    base : FittedLens
        The lens by plain numbers.
    mla_distance : Dr.Jit number
        In millimetres.
    numbers : dict
        Dr.Jit numbers by name, of `lens_changes.LENS_NUMBERS`, that carry gradients; others are held.
    turned : float or Dr.Jit number
        Degrees by which the frame of the points turns, counter-clockwise, against the scene.
    """

    base: FittedLens
    mla_distance: Any
    numbers: dict[str, Any]
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
    """The light of one scene point a lane, as `LensLight`, and how it changes with some numbers.

    Attributes
    ----------
    base : LensLight
        The light by plain numbers, of points that may turn.
    changes : list of Shown
        Of each number.
    """

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
