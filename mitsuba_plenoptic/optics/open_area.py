"""How much of the exit pupil of a real main lens is open to single scene points, and how that changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .fitted_lens import FittedLens
from .lens_changes import LENS_NUMBERS, lens_change
from .lens_light import LensLight
from .pupil_polynomials import Place

_ACROSS, _EDGE = 192, 4.0
"""Places across the pupil's bounding circle by which its open part is measured, and steps over which edges count."""

_FIELDS, _DEPTHS = 17, 3
"""Fields and distances at which it is measured for many points."""

_TOGETHER = 16
"""Points for which it is measured at once."""


def open_area(lens: FittedLens, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the area of the exit pupil that is open to each point, in square millimetres; (n,).

    Parameters
    ----------
    lens : FittedLens
        The lens, fitted to the field and the distances of the points.
    points : float64 array (n, 3)
        Scene points in the camera frame.
    """

    def measured(some: NDArray[np.float64]) -> NDArray[np.float64]:
        step, edge, pupil = _places(lens)
        _, least = _edges(lens.bind(some), pupil)
        return np.asarray(np.clip(least / edge + 0.5, 0, 1).sum(1) * step**2)

    return _at_all(lens, points, measured)


def open_area_slopes(lens: FittedLens, name: str, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the derivatives of the logarithms of these areas by a number of the camera; (n,).

    The points and the lens stand still; by other numbers than `lens_changes.LENS_NUMBERS` the derivative is 0.

    Parameters
    ----------
    lens, points
        As for `open_area`.
    name : str
        The number.
    """
    if name not in LENS_NUMBERS:
        return np.zeros(len(points))
    changes = lens_change(lens, name).stops

    def measured(some: NDArray[np.float64]) -> NDArray[np.float64]:
        _, edge, pupil = _places(lens)
        light = lens.bind(some)
        stop, least = _edges(light, pupil)
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

    return _at_all(lens, points, measured)


def _places(lens: FittedLens) -> tuple[float, float, Place]:
    """Return the step of the places, the width of edges, and the places on the exit pupil."""
    step, beyond = 2 * lens.pupil_radius / _ACROSS, round(_EDGE)
    axis = (np.arange(-beyond, _ACROSS + beyond) + 0.5) * step - lens.pupil_radius
    x, y = (part.reshape(1, -1) for part in np.meshgrid(axis, axis))
    return step, _EDGE * step, (x, y)


def _edges(light: LensLight, pupil: Place) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the number of the edge that is nearest to each place, and how far within it the place lies."""
    away = np.stack([replace(light, stops=[stop]).inside(pupil) for stop in light.stops])
    return away.argmin(0), away.min(0)


def _at_all(
    lens: FittedLens, points: NDArray[np.float64], measured: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Return a measure of points: of many from that at some fields and distances, as lenses are round."""
    from scipy.interpolate import RegularGridInterpolator

    if len(points) <= _FIELDS * _DEPTHS:
        parts = [measured(points[first : first + _TOGETHER]) for first in range(0, len(points), _TOGETHER)]
        return np.concatenate([np.empty(0), *parts])
    field, nearness = lens.fitted.pupils.field(points)
    heights, scales = np.hypot(*field.T), lens.fitted.aberration.scales
    # Ranges that are no points.
    axes = (
        np.linspace(0, heights.max() + 1e-9 * scales.field, _FIELDS),
        np.linspace(nearness.min(), nearness.max() + 1e-9 * scales.half, _DEPTHS),
    )
    u, near = (part.ravel() for part in np.meshgrid(*axes, indexing="ij"))
    nodes = np.column_stack([0 * u, u / near, 1 / near + lens.fitted.pupils.entrance])
    table = _at_all(lens, nodes, measured).reshape(_FIELDS, _DEPTHS)
    return np.asarray(RegularGridInterpolator(axes, table, bounds_error=False)((heights, nearness)))
