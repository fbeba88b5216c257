"""Spots, vignetting and distortion of a real main lens over its field, by traced rays."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..camera import PlenopticCamera
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
    lens, b = LensSystem.of(camera), camera.mla_distance
    g = camera.focus_distance if camera.focus_distance > 0 else math.inf
    axis = np.linspace(-_WIDER, _WIDER, _ACROSS) * camera.pupil_radius
    Px, Py = (values.ravel() for values in np.meshgrid(axis, axis))

    def directions(height: float, slopes: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return X/g and Y/g of the object points that rays meet, and which rays get through."""
        point, slope, is_open = lens.trace((np.zeros_like(slopes[0]), np.full_like(slopes[0], height)), slopes)
        X, Y = (p / g + (1 - point[2] / g) * t for p, t in zip(point[:2], slope, strict=True))
        return X, Y, is_open

    figures: list[FieldFigures] = []
    area = 1
    for height in (0.0, *heights):
        X, Y, is_open = directions(height, (Px / lens.pupil_distance, (Py - height) / lens.pupil_distance))
        count = int(np.count_nonzero(is_open))
        spot = b * math.sqrt(np.var(X[is_open]) + np.var(Y[is_open])) if count else math.nan
        chief = np.atleast_1d(lens.chief_slope(np.array([height])))
        middle = float(directions(height, (np.zeros(1), chief))[1][0])
        distortion = -height / (b * middle) - 1 if height else 0.0
        figures.append(FieldFigures(height, spot, count / max(1, area), distortion))
        area = count if len(figures) == 1 else area
    return figures[1:]
