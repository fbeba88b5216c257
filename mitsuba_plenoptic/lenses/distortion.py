"""Radial and tangential distortion of the main lens as a map of rays.

A ray that crosses the plane of the microlens array at m continues behind the main lens as if it came from U(m) through
the same point of the pupil. U is Brown's polynomial (D. C. Brown, "Decentering distortion of lenses", 1966). Points in
focus on the array are imaged sharply, at the position that the inverse of U gives. Points out of focus are distorted
in the same manner, by the positions at which their rays cross the array; the pupil itself is not distorted.
"""

from typing import Any

from ..runtime import Pair


def undistort(x: Any, y: Any, distortion: Any) -> Pair:
    r"""Return the undistorted position U(m), as floats, NumPy arrays or Dr.Jit arrays.

    :math:`U = m (1 + k_1 r^2 + k_2 r^4 + k_3 r^6) + (p_1 (r^2 + 2 x^2) + 2 p_2 x y,\ p_2 (r^2 + 2 y^2) + 2 p_1 x y)`.

    Parameters
    ----------
    x, y : float or array
        Position in the plane of the microlens array, in mm from the axis.
    distortion : five floats
        k1, k2, k3 in mm^-2, mm^-4, mm^-6, p1 and p2 in mm^-1.
    """
    k1, k2, k3, p1, p2 = distortion
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    cross = 2 * x * y
    return (x * radial + p1 * (square + 2 * x * x) + p2 * cross, y * radial + p2 * (square + 2 * y * y) + p1 * cross)
