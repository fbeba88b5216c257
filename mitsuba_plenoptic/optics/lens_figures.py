"""Spots, vignetting and distortion of a real main lens over its field, by traced rays."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..camera import PlenopticCamera
from . import sequential
from .lens_system import LensSystem

_ACROSS = 201
"""Rays across the pupil."""

_WIDER = 1.5
"""How far out rays are tried, in radii of the exit pupil."""


@dataclass(frozen=True)
class FieldFigures:
    """What a main lens does to the light at one distance from the axis of the microlens array (MLA).

    Parameters
    ----------
    height : float
        That distance in millimetres.
    spot : float
        Root mean square radius of a point's image, projected onto the MLA, in millimetres; NaN where all is dark.
    light : float
        Area of the exit pupil that is open, over that on the axis.
    distortion : float
        How much farther from the axis the chief ray puts a point's image than paraxial optics, over its distance.
    """

    height: float
    spot: float
    light: float
    distortion: float


class _Bundles:
    """Bundles of rays from places on the MLA to the object plane in focus, at one wavelength."""

    def __init__(self, camera: PlenopticCamera, wavelength: float | None) -> None:
        self.lens = LensSystem.of(camera, wavelength)
        self._g = camera.focus_distance if camera.focus_distance > 0 else math.inf
        axis = np.linspace(-_WIDER, _WIDER, _ACROSS) * camera.pupil_radius
        self._pupil = tuple(values.ravel() for values in np.meshgrid(axis, axis))

    def directions(
        self, height: float, slopes: tuple[np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return X/g and Y/g of the object points that rays meet, and which rays get through."""
        start = np.zeros_like(slopes[0]), np.full_like(slopes[0], height)
        point, slope, is_open = self.lens.trace(start, slopes)
        X, Y = (p / self._g + (1 - point[2] / self._g) * t for p, t in zip(point[:2], slope, strict=True))
        return X, Y, is_open

    def all_of(self, height: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the directions of rays all over the exit pupil, and which get through."""
        Px, Py = self._pupil
        distance = self.lens.pupil_distance
        return self.directions(height, (Px / distance, (Py - height) / distance))

    def chief(self, height: float) -> float:
        """Return Y/g of the chief ray."""
        slope = np.atleast_1d(self.lens.chief_slope(np.array([height])))
        return float(self.directions(height, (np.zeros(1), slope))[1][0])


def spot(camera: PlenopticCamera, height: float, wavelength: float) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays from the object point of a place's chief ray meet the MLA, as far as they get through.

    By the way back: how far from that point the rays from the place meet the object plane, in its image's size.

    Parameters
    ----------
    camera : PlenopticCamera
        A camera with a real main lens.
    height : float
        Distance of the place from the axis in millimetres.
    wavelength : float
        Wavelength in nanometres; the object point is that of the chief ray at the prescription's own.

    Returns
    -------
    x, y : float64 arrays (n,)
        In millimetres; y is across to the axis.
    """
    middle = _Bundles(camera, None).chief(height)
    X, Y, is_open = _Bundles(camera, wavelength).all_of(height)
    return camera.mla_distance * X[is_open], camera.mla_distance * (Y[is_open] - middle)


def lateral_colour(camera: PlenopticCamera, height: float, wavelengths: tuple[float, float]) -> float:
    """Return how much farther from the axis the second wavelength's chief ray puts an image than the first's.

    Parameters
    ----------
    camera : PlenopticCamera
        A camera with a real main lens.
    height : float
        Distance from the axis on the MLA in millimetres.
    wavelengths : (float, float)
        Wavelengths in nanometres.
    """
    first, second = (_Bundles(camera, wavelength).chief(height) for wavelength in wavelengths)
    # What is seen farther out from the same place is imaged nearer to the axis.
    return camera.mla_distance * (second - first)


def ray_paths(camera: PlenopticCamera, height: float, count: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """Follow rays in the plane of the axis from a place on the MLA, surface by surface, to before the lens.

    Parameters
    ----------
    camera : PlenopticCamera
        A camera with a real main lens.
    height : float
        Distance of the place from the axis in millimetres.
    count : int
        Rays, evenly over what the lens lets through.

    Returns
    -------
    z, y : float64 arrays (surfaces + 1, count)
        Their places in the camera frame, on the MLA and on each surface.
    """
    lens = LensSystem.of(camera)
    tried = np.linspace(-_WIDER, _WIDER, _ACROSS) * camera.pupil_radius
    slopes = (tried - height) / lens.pupil_distance
    _, _, is_open = lens.trace((0.0 * slopes, np.full_like(slopes, height)), (0.0 * slopes, slopes))
    slopes = np.linspace(slopes[is_open][0], slopes[is_open][-1], count)
    N = 1 / np.sqrt(1 + slopes**2)
    point = (0.0 * slopes, np.full(count, height / lens.scale), np.full(count, -lens.back_distance / lens.scale))
    direction = (0.0 * slopes, slopes * N, N)
    vertex = lens.front / lens.scale - lens.numbers.length
    z, y = [vertex + point[2]], [point[1]]
    surfaces = sequential.elements(
        lens.prescription, lens.prescription.wavelength, stop_radius=lens.stop_radius, backwards=True
    )
    for surface in surfaces:
        vertex += surface.gap
        point, direction, _, _ = sequential.follow([surface], point, direction)
        # A plane tells a single height.
        z.append(vertex + point[2] + 0.0 * slopes)
        y.append(point[1])
    return lens.scale * np.array(z), lens.scale * np.array(y)


def field_figures(camera: PlenopticCamera, heights: tuple[float, ...]) -> list[FieldFigures]:
    """Trace bundles from the MLA to the object plane in focus; figures of a camera with a real main lens.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera; where no real plane is in focus, infinitely far points are taken.
    heights : tuple of float
        Distances from the axis on the MLA in millimetres.

    Returns
    -------
    list of FieldFigures
        One for each.
    """
    bundles, b = _Bundles(camera, None), camera.mla_distance
    figures: list[FieldFigures] = []
    area = 1
    for height in (0.0, *heights):
        X, Y, is_open = bundles.all_of(height)
        count = int(np.count_nonzero(is_open))
        spot = b * math.sqrt(np.var(X[is_open]) + np.var(Y[is_open])) if count else math.nan
        distortion = -height / (b * bundles.chief(height)) - 1 if height else 0.0
        figures.append(FieldFigures(height, spot, count / max(1, area), distortion))
        area = count if len(figures) == 1 else area
    return figures[1:]
