r"""How the light on the exit pupil of a real main lens changes with its focal length, its opening and the wavelength.

The rays to which a lens was fitted (see `fitted_lens`) are traced through two lenses that are a little different. Along
a ray a fitted function F changes by :math:`F' + \nabla F \cdot P'`, where the ray's place P on the exit pupil changes,
too; F', the change at the place, is what polynomials of the same degrees are fitted to. The scene point stands still in
the camera frame, whereas with the focal length the entrance pupil moves against it. All is told with the pupils of the
lens as it is.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..runtime.blas import single_threaded_blas
from .fitted_lens import FittedLens
from .lens_system import LensSystem
from .pupil_fit import nodes
from .pupil_polynomials import Polynomial, fit
from .pupil_rays import PupilRays, entrance_place, trace_all

LENS_NUMBERS = ("focal_length", "aperture_radius", "wavelength")
"""Numbers with which the light on the exit pupil changes."""

_STEP = 1e-4
"""Relative change of a number on either side."""


@dataclass(frozen=True, eq=False)
class LensChange:
    """What changes, for a change by 1, of a `FittedLens`.

    Attributes
    ----------
    pupil_distance : float
        Distance from the exit pupil to the MLA, in millimetres.
    aberration, brightness : Polynomial
        As of `PupilFit`.
    stops : tuple of Polynomial
        As of `PupilFit`.
    """

    pupil_distance: float
    aberration: Polynomial
    brightness: Polynomial
    stops: tuple[Polynomial, ...]


@functools.lru_cache(maxsize=64)
def lens_change(lens: FittedLens, name: str) -> LensChange:
    """Return how a fitted lens changes with one of `LENS_NUMBERS`.

    Parameters
    ----------
    lens : FittedLens
        The lens at its wavelength.
    name : str
        The number; focal length and opening in millimetres, the wavelength in nanometres.
    """
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
