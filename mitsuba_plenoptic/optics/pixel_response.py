"""What pixels record of light by its angle of incidence, as a table that Dr.Jit looks up."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

_ANGLES = 1025
"""Angles in the table."""


def angular_response(pairs: tuple[float, ...]) -> Callable[[Any], Any] | None:
    """Return the function from angles of incidence, in radians, to responses; None if all are 1.

    Parameters
    ----------
    pairs : tuple of float
        As `PlenopticCamera.pixel_response` has them.
    """
    if not pairs:
        return None
    angles, responses = (np.array(values) for values in (pairs[::2], pairs[1::2]))
    fine = np.linspace(0, angles[-1], _ANGLES)
    table = mi.Float(np.interp(fine, angles, responses))
    dr.make_opaque(table)
    step = math.radians(float(fine[1]))

    def response(angle: Any) -> Any:
        place = dr.clip(angle / step, 0, _ANGLES - 1)
        low = mi.UInt32(dr.minimum(dr.floor(place), _ANGLES - 2))
        first, second = dr.gather(mi.Float, table, low), dr.gather(mi.Float, table, low + 1)
        return first + (place - mi.Float(low)) * (second - first)

    return response
