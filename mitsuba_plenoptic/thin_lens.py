"""The thin-lens formula, for the main lens and for microlenses."""

from __future__ import annotations

import math
from typing import Any

from .bounds import LONGEST
from .errors import InputError


def vergence(focal_length: Any, distance: Any) -> Any:
    """Return the reciprocal of the image distance of a plane, :math:`1/g' = 1/f - 1/g`; zero for the focal plane."""
    return 1 / focal_length - 1 / distance


def defocus_factor(distance: Any, mla_distance: Any, focal_length: Any) -> Any:
    r"""Return the part of a pupil coordinate by which a ray misses the image of its object point on the MLA.

    :math:`1 + b/g - b/f_1`, so written that it is exactly zero in focus.
    """
    return 1 + mla_distance / distance - mla_distance / focal_length


def conjugate_distance(focal_length: float, distance: float) -> float:
    """Return the distance of the plane that a thin lens images to one at `distance`, :math:`1/x + 1/d = 1/f`.

    Infinite for the focal plane, negative for planes within it, zero for the lens's own plane.
    """
    if distance == 0:
        return 0.0
    power = vergence(focal_length, distance)
    return math.inf if power == 0 else 1 / power


def image_distance(focal_length: float, distance: float, *, name: str = "distance") -> float:
    """Return the distance behind a thin lens at which an object at `distance` is in focus."""
    if not distance > focal_length:
        raise InputError(f"{name} = {distance:g}: it must be greater than the focal length {focal_length:g}")
    if LONGEST < distance < math.inf:
        raise InputError(f"{name} = {distance:g}: it must be at most {LONGEST:g}")
    power = vergence(focal_length, distance)
    if power * LONGEST < 1:
        raise InputError(
            f"{name} = {distance!r}: its image lies too far behind a lens of focal length {focal_length:g}, at more "
            f"than {LONGEST:g}"
        )
    return 1 / power
