"""Rays from scene points through a real main lens to the plane of its exit pupil, of which polynomials are fitted.

A scene point is told by its field, X and Y over its distance from the entrance pupil, and by the reciprocal of that
distance, its nearness: both go on smoothly through infinity, to light that converges to a point behind the lens.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import sequential
from .lens_system import LensSystem

_BEYOND = 1.1
"""How far beyond the surfaces' edges rays are followed, over their semi-apertures."""

_STEP = 1e-4
"""Distance of neighbouring rays over the pupil's radius, from which the density of rays is found."""

_STEEPEST = 10.0
"""Slope of the reference behind the lens, beyond which nothing is followed."""


@dataclass(frozen=True)
class PupilRays:
    """Rays of points whose fields lie along y; all arrays have shape (n,) or (2, n).

    Attributes
    ----------
    field, nearness : float64 array (n,)
        Of the point that each ray comes from; the nearness in 1/mm.
    place, entrance : float64 array (2, n)
        Where they pass the planes of the exit and of the entrance pupil, in millimetres.
    path : float64 array (n,)
        Path to the exit pupil less that of the ray through the middle of the entrance pupil, in millimetres.
    amplitude : float64 array (n,)
        Modulus of the field there, but for a factor of each point.
    stops : float64 array (surfaces, n)
        For each surface the square of the distance from the axis over that of its edge.
    """

    field: NDArray[np.float64]
    nearness: NDArray[np.float64]
    place: NDArray[np.float64]
    entrance: NDArray[np.float64]
    path: NDArray[np.float64]
    amplitude: NDArray[np.float64]
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

    Parameters
    ----------
    lens : LensSystem
        The lens.
    field, nearness : float64 array (n,)
        Of each ray's point, which lies at that field along y.
    entrance : float64 array (2, n)
        Where each ray passes the plane of the entrance pupil, in millimetres.

    Returns
    -------
    PupilRays
        All of them; what misses a surface is NaN.
    kept : bool array (n,)
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
