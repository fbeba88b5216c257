"""Sources at infinity as points with weights for `CaptureOperator`: stars, binaries, and discs from pictures.

Directions are angles in arcseconds in the camera frame: +x is to the left in the camera's picture, +y up.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from ...array import read_samples
from ...errors import refuse_if, require_number, require_pair, suggest_keywords
from ...runtime import Doubles

INFINITY = 1e12
"""Distance of these points in millimetres, at which the curvature of a wavefront is of no effect."""

_WIDEST = 3600.0 * 10
"""Largest angle from the axis in arcseconds."""

_direction = functools.partial(
    require_pair,
    "direction",
    meaning="of angles (x, y)",
    rule=functools.partial(require_number, minimum=-_WIDEST, maximum=_WIDEST),
)


@suggest_keywords
def star(direction: tuple[float, float] = (0.0, 0.0), *, weight: float = 1.0) -> tuple[Doubles, Doubles]:
    """Return the point and the weight of a star.

    Parameters
    ----------
    direction : (float, float)
        Angles from the axis along x and y in arcseconds.
    weight : float
        Power through the pupil.

    Returns
    -------
    points : float64 array (1, 3)
        The star as a point of `CaptureOperator`.
    weights : float64 array (1,)
        Weight of the star for `CaptureOperator.forward`.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> points, weights = mp.far_sources.star((3.0, 0.0))
    >>> camera = mp.PlenopticCamera.preset("telescope")
    >>> operator = mp.CaptureOperator(camera, points, wavelength=633, method="full_field")
    >>> operator.forward(weights).shape
    (256, 256)
    """
    return _towards(np.array([_direction(direction)])), np.array([require_number("weight", weight, minimum=0)])


@suggest_keywords
def binary(
    separation: float, *, angle: float = 0.0, ratio: float = 1.0, direction: tuple[float, float] = (0.0, 0.0)
) -> tuple[Doubles, Doubles]:
    """Return the points and weights of two stars, the brighter one first, with a total power of 1.

    Parameters
    ----------
    separation : float
        Angle between the stars in arcseconds.
    angle : float
        Direction of the second star from the first, in degrees from +x towards +y.
    ratio : float
        Power of the second star over that of the first, at most 1.
    direction : (float, float)
        Angles from the axis to their middle along x and y in arcseconds.

    Returns
    -------
    points : float64 array (2, 3)
        The stars as points of `CaptureOperator`.
    weights : float64 array (2,)
        Weights of the two stars.
    """
    separation = require_number("separation", separation, minimum=0, maximum=_WIDEST)
    turned = np.deg2rad(require_number("angle", angle))
    ratio = require_number("ratio", ratio, minimum=0, maximum=1)
    half = separation / 2 * np.array([np.cos(turned), np.sin(turned)])
    return _towards(np.array(_direction(direction)) + np.array([-half, half])), np.array([1, ratio]) / (1 + ratio)


@suggest_keywords
def extended(picture: Any, *, width: float, direction: tuple[float, float] = (0.0, 0.0)) -> tuple[Doubles, Doubles]:
    """Return points and weights of an extended source, one point for each bright pixel of a picture.

    Pixels should be narrower than the telescope resolves, wavelength / 2 diameter. The total power is 1.

    Parameters
    ----------
    picture : array (rows, columns), or path
        Brightness, upright, the first row at the top; or an NPY, EXR or FITS file of it.
    width : float
        Angle across the columns in arcseconds; pixels are square.
    direction : (float, float)
        Angles from the axis to the source's middle along x and y in arcseconds.

    Returns
    -------
    points : float64 array (n, 3)
        The points of `CaptureOperator`.
    weights : float64 array (n,)
        Weights of the points.
    """
    values = read_samples("picture", picture, None)
    refuse_if(not values.any() or bool((values < 0).any()), "picture: it must be bright somewhere and nowhere negative")
    rows, columns = values.shape
    pixel = require_number("width", width, positive=True, maximum=_WIDEST) / columns
    row, column = np.nonzero(values)
    aside = np.stack([(columns - 1) / 2 - column, (rows - 1) / 2 - row], 1) * pixel
    lit = values[row, column]
    return _towards(np.array(_direction(direction)) + aside), lit / lit.sum()


def _towards(angles: Doubles) -> Doubles:
    """Return points (n, 3) in directions (n, 2)."""
    return np.column_stack([np.tan(np.deg2rad(angles / 3600)), np.ones(len(angles))]) * INFINITY
