r"""The rays from points through a real main lens and the centres of the lenses that they light; see `rays`.

Path, amplitude and edges are those that are fitted to the lens (`FittedLens`), and what each ray brings is told by
`local_lens`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
import scipy
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...optics.fitted_lens import FAR, FittedLens
from ...optics.lens_light import LensLight
from ...optics.pupil_polynomials import PupilPolynomial
from ...runtime.backend import array_module
from ...runtime.indexing import quotient
from .lens_bank import LensBank
from .local_lens import derivatives, local_point
from .rays import Traced, collect

_NEWTON = 5
"""Steps of Newton's method to the pupil point, which starts from rays near the axis."""

_STEP = 1e-3
"""Step on the pupil, over its radius, by which derivatives are found."""

_WITHIN = 3
"""Times that a place is moved within all edges, one after the other."""

_FIELDS, _DEPTHS, _ACROSS = 13, 5, 96
"""Fields and nearnesses for which the power through the pupil is found, and places across the pupil."""


@dataclass(frozen=True)
class RealRays:
    """Rays from some points through the centres of the lenses around their images."""

    camera: PlenopticCamera
    power: PassedPower
    banks: list[LensBank]
    pitch: float
    points: NDArray[np.float64]
    around: NDArray[np.int64]

    @property
    def samples(self) -> int:
        """Coefficients of all rays."""
        return len(self.points) * len(self.around) * sum(bank.rank for bank in self.banks)

    def trace(self) -> Traced:
        """Find where the rays arrive, and what they bring of each kernel."""
        types, camera, lens = array_module(), self.camera, self.power.lens
        lattice, b = camera.lattice, lens.pupil_distance
        index = dr.arange(types.UInt32, len(self.points) * len(self.around))
        number = quotient(types, index, len(self.around))
        step = index - number * dr.opaque(types.UInt32, len(self.around))

        def value(array: NDArray[Any], which: Any) -> Any:
            return dr.gather(types.Float64, types.Float64(np.ascontiguousarray(array, np.float64)), which)

        light, images = lens.bind(self.points, number), lens.images(self.points)
        image = [value(images[:, axis], number) for axis in (0, 1)]
        defocus = value(1 - b * lens.convergence(self.points[:, 2]), number)
        own = lattice.cell(*image)
        i, j = (cell + value(self.around[:, axis], step) for axis, cell in enumerate(own))
        centre = lattice.centre(i, j)
        P = [(c - m) / defocus for c, m in zip(centre, image, strict=True)]
        for _ in range(_NEWTON):
            at = _Landing.of(light, P, float(lens.pupil_radius))
            missed = [m - c for m, c in zip(at.place, centre, strict=True)]
            P = [p - (x * missed[0] + y * missed[1]) for p, (x, y) in zip(P, at.inverse, strict=True)]
        at = _Landing.of(light, P, float(lens.pupil_radius))
        (xx, xy), (yx, yy) = at.inverse
        power = dr.square(light.amplitude(at.within, None)) * abs(xx * yy - xy * yx)
        power *= value(float(lattice.lens_area) / self.power.at(self.points), number)
        pupil = local_point(camera, at.inverse, at.edges(light))
        place = [c + (c - p) * (self.banks[0].arrival / b) for c, p in zip(centre, P, strict=True)]
        return collect(camera, self.banks, self.pitch, (i, j), number, place, power, pupil)


@dataclass(frozen=True)
class _Landing:
    """Where rays through pupil points arrive on the array; beyond the edges they go on as they are there.

    Attributes
    ----------
    within, beyond : (array, array)
        The nearest places within all edges, and how far from there the points are.
    place : (array, array)
        Where the rays arrive.
    inverse : ((array, array), (array, array))
        Derivatives of the pupil points' x and y by that.
    """

    within: tuple[Any, Any]
    beyond: tuple[Any, Any]
    place: tuple[Any, Any]
    inverse: tuple[tuple[Any, Any], tuple[Any, Any]]

    @classmethod
    def of(cls, light: LensLight, P: Any, radius: float) -> _Landing:
        within = _inside(light, P, radius)
        beyond = P[0] - within[0], P[1] - within[1]
        (xx, xy), (yx, yy) = derivatives(light, within, _STEP * radius)
        x, y = light.land(within, None)
        scale = 1 / (xx * yy - xy * yx)
        place = x + xx * beyond[0] + xy * beyond[1], y + yx * beyond[0] + yy * beyond[1]
        return cls(within, beyond, place, ((yy * scale, -xy * scale), (-yx * scale, xx * scale)))

    def edges(self, light: LensLight) -> Iterator[tuple[Any, tuple[Any, Any]]]:
        """Yield the edges as `local_point` takes them."""
        (xx, xy), (yx, yy) = self.inverse
        for value, gx, gy in _edges(light, self.within):
            value = value + gx * self.beyond[0] + gy * self.beyond[1]
            yield value, (gx * xx + gy * yx, gx * xy + gy * yy)


def _inside(light: LensLight, P: Any, radius: float) -> tuple[Any, Any]:
    """Move places of the pupil within all edges."""
    inward = dr.minimum(1, radius * dr.rsqrt(dr.square(P[0]) + dr.square(P[1])))
    x, y = P[0] * inward, P[1] * inward
    for _ in range(_WITHIN):
        for stop in light.stops:
            value, gx, gy = _edge(stop, (x, y))
            step = dr.maximum(value - 1, 0) / dr.maximum(gx * gx + gy * gy, 1e-12)
            x, y = x - step * gx, y - step * gy
    return x, y


def _edges(light: LensLight, P: Any) -> Iterator[tuple[Any, Any, Any]]:
    return (_edge(stop, P) for stop in light.stops)


def _edge(stop: PupilPolynomial, P: Any) -> tuple[Any, Any, Any]:
    """Return the distance from the axis over that of an edge, and its derivatives by x and y."""
    square, gx, gy = stop.gradient(P)
    value = dr.sqrt(dr.maximum(square, 1e-12))
    return value, gx / (2 * value), gy / (2 * value)


@dataclass(frozen=True)
class PassedPower:
    """The integral of the squared amplitude over the open pupil.

    Attributes
    ----------
    lens : FittedLens
        The lens.
    spline : scipy.interpolate.RectBivariateSpline
        The integral over the field and the nearness of points.
    """

    lens: FittedLens
    spline: Any

    @classmethod
    def of(cls, lens: FittedLens) -> PassedPower:
        """Compute it all over the field and the distances that the lens is fitted for."""
        scales, entrance = lens.fitted.aberration.scales, lens.fitted.pupils.entrance
        fields = np.linspace(0, scales.field, _FIELDS)
        nearness = scales.middle + scales.half * np.linspace(-1, 1, _DEPTHS)
        axis, step = np.linspace(-lens.pupil_radius, lens.pupil_radius, _ACROSS, retstep=True)
        x, y = (values.reshape(1, -1) for values in np.meshgrid(axis, axis))
        powers = np.empty((_FIELDS, _DEPTHS))
        for depth, near in enumerate(nearness):
            distance = 1 / (near or 1 / FAR)
            points = np.column_stack([0 * fields, fields * distance, np.full(_FIELDS, distance + entrance)])
            light = lens.bind(points)
            cover = np.clip(light.inside((x, y)) / step + 0.5, 0, 1)
            powers[:, depth] = (cover * light.amplitude((x, y), None) ** 2).sum(1) * step**2
        return cls(lens, scipy.interpolate.RectBivariateSpline(fields, nearness, powers))

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return it for scene points (n, 3); (n,)."""
        field, nearness = self.lens.fitted.pupils.field(points)
        return np.asarray(self.spline(np.hypot(*field.T), nearness, grid=False))
