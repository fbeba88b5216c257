"""The area of a fitted lens's exit pupil that is unvignetted for scene points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .pupil_polynomials import LensLight, Place

if TYPE_CHECKING:
    from .fitted_lens import FittedLens

_ACROSS, _EDGE = 192, 4.0
"""Samples across the pupil's bounding circle for its open area, and the width of softened edges in samples."""

_FIELDS, _DEPTHS = 17, 3
"""Fields and nearnesses of the table from which the open areas of many points are interpolated."""

_TOGETHER = 16
"""Points that are computed together."""


def open_area(lens: FittedLens, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unvignetted area of the exit pupil for points (n, 3), in square millimetres, (n,)."""

    def measured(some: NDArray[np.float64]) -> NDArray[np.float64]:
        step, edge, pupil = places(lens)
        _, least = edges(lens.bind(some), pupil)
        return np.asarray(np.clip(least / edge + 0.5, 0, 1).sum(1) * step**2)

    return at_all(lens, points, measured)


def places(lens: FittedLens) -> tuple[float, float, Place]:
    """Return the sampling step on the exit pupil, the width of softened edges, and the sample positions."""
    step, beyond = 2 * lens.pupil_radius / _ACROSS, round(_EDGE)
    axis = (np.arange(-beyond, _ACROSS + beyond) + 0.5) * step - lens.pupil_radius
    x, y = (part.reshape(1, -1) for part in np.meshgrid(axis, axis))
    return step, _EDGE * step, (x, y)


def edges(light: LensLight, pupil: Place) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the index of the edge nearest to each position, and the position's distance from it, positive inside."""
    away = np.stack([replace(light, stops=[stop]).inside(pupil) for stop in light.stops])
    return away.argmin(0), away.min(0)


def at_all(
    lens: FittedLens, points: NDArray[np.float64], measured: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Return a measure of points; for many points it is interpolated over field and nearness, as lenses are round."""
    from scipy.interpolate import RegularGridInterpolator

    if len(points) <= _FIELDS * _DEPTHS:
        parts = [measured(points[first : first + _TOGETHER]) for first in range(0, len(points), _TOGETHER)]
        return np.concatenate([np.empty(0), *parts])
    field, nearness = lens.fitted.pupils.field(points)
    heights, scales = np.hypot(*field.T), lens.fitted.aberration.scales
    # The ranges are widened so that they are never empty.
    axes = (
        np.linspace(0, heights.max() + 1e-9 * scales.field, _FIELDS),
        np.linspace(nearness.min(), nearness.max() + 1e-9 * scales.half, _DEPTHS),
    )
    u, near = (part.ravel() for part in np.meshgrid(*axes, indexing="ij"))
    nodes = np.column_stack([0 * u, u / near, 1 / near + lens.fitted.pupils.entrance])
    table = at_all(lens, nodes, measured).reshape(_FIELDS, _DEPTHS)
    return np.asarray(RegularGridInterpolator(axes, table, bounds_error=False)((heights, nearness)))
