"""Cubic B-splines, by which values at regular places are spread and joined (Unser 1999, "Splines")."""

from __future__ import annotations

from typing import Any


def spline_parts(place: Any) -> tuple[Any, Any, Any, Any]:
    """Return the cubic B-splines of the four nearest knots, one apart, at places between the middle two.

    Parameters
    ----------
    place : float, NumPy or Dr.Jit array
        Distance from the second knot, 0 to 1.
    """
    left = 1 - place
    return left**3 / 6, 2 / 3 - place**2 + place**3 / 2, 2 / 3 - left**2 + left**3 / 2, place**3 / 6
