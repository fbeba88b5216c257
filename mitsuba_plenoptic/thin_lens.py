"""The thin-lens formula, for the main lens and for microlenses."""

from __future__ import annotations

import math
from typing import Any

from .bounds import LONGEST
from .errors import InputError


def defocus_factor(distance: Any, mla_distance: Any, focal_length: Any) -> Any:
    """Part of a pupil coordinate by which a ray from an object point misses its image on the MLA: 1 + b/g - b/f1."""
    return 1 + mla_distance / distance - mla_distance / focal_length


def conjugate_distance(focal_length: float, distance: float) -> float:
    """Distance of the plane that a thin lens images to one at `distance`, :math:`1/x + 1/d = 1/f`.

    Infinite for the focal plane, negative for planes within it.
    """
    power = 1 / focal_length - 1 / distance
    return math.inf if power == 0 else 1 / power


def image_distance(focal_length: float, distance: float, *, name: str = "distance") -> float:
    """Distance behind a thin lens at which an object at `distance` is in focus.

    Raises
    ------
    InputError
        If the object is at or inside the focal length, where a lens forms no real image.
    """
    if not distance > focal_length:
        raise InputError(f"{name} = {distance:g}: it must be greater than the focal length {focal_length:g}")
    if LONGEST < distance < math.inf:
        raise InputError(f"{name} = {distance:g}: it must be at most {LONGEST:g}")
    power = 1 / focal_length - 1 / distance
    if power * LONGEST < 1:
        raise InputError(
            f"{name} = {distance!r}: its image lies too far behind a lens of focal length {focal_length:g}, at more "
            f"than {LONGEST:g}"
        )
    return 1 / power
