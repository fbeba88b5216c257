"""Focusing a real main lens by moving a group of its elements, while the array stays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy

from ...camera import PlenopticCamera
from ...errors import InputError, refuse_if, require_count, require_number, short_repr, suggest_keywords
from ...prescription import Prescription, lens_data, paraxial

_CLOSEST = 1e-3
"""Distance between vertices, over the gaps before and behind the group, that is left at least."""


@suggest_keywords
def focus_by_group(camera: PlenopticCamera, group: Sequence[int], distance: float) -> PlenopticCamera:
    """Return the camera with a group of lens elements moved so that an object distance is in focus.

    The aperture stop keeps its opening, so that focal length, pupils and f-number become those of the lens with the
    moved group. Its figures are paraxial, at the prescription's own wavelength.

    Parameters
    ----------
    camera : PlenopticCamera
        A camera with a real main lens.
    group : (int, int)
        Numbers of the group's first and last surface, from 1 at the scene's side. There must be air around it, and at
        least one other surface, which stays where it is before the array.
    distance : float
        Object distance that shall be in focus, from the front principal plane, in millimetres; may be infinite.

    Returns
    -------
    PlenopticCamera
        The camera with the changed lens; its origin is the front principal plane of the changed lens.

    Raises
    ------
    InputError
        If the camera has no such lens, the group does not exist, its surfaces would cross others, or no position of the
        group focuses the distance. Of several positions, the nearest to the present one is taken.
    """
    lens = camera.prescription
    if lens is None:
        raise InputError("main_lens: a group of it is moved to focus; the camera has none with surfaces")
    first, last = _require_group(lens, group)
    distance = require_number("distance", distance, positive=True, finite=False)
    before = paraxial(lens)
    scale = camera.focal_length / before.focal_length
    # From the first vertex as it stands to the array, in the lens's own millimetres.
    array = camera.mla_distance / scale + before.rear_principal + before.length
    opening = camera.aperture_radius / (scale * before.entrance_radius)

    def moved(shift: float) -> Prescription:
        changed = lens
        for index, change in ((first - 1, shift), (last, -shift)):
            if 0 <= index < len(lens.surfaces) - 1:
                changed = changed.with_surface(index, thickness=lens.surfaces[index].thickness + change)
        return changed

    def behind(shift: float) -> tuple[float, float]:
        """Return focal length and distance from rear principal plane to array, both in mm, for a shift of the group."""
        figures = paraxial(moved(shift))
        end = before.length + (shift if last == len(lens.surfaces) - 1 else 0.0)
        return figures.focal_length, array - end - figures.rear_principal

    def missed(shift: float) -> float:
        focal_length, b = behind(shift)
        return b * lens_data.vergence(focal_length, distance / scale) - 1

    # The group can move towards the array and towards the scene, up to the next surfaces.
    room = lens.surfaces[last].thickness if last < len(lens.surfaces) - 1 else array - before.length
    ahead = lens.surfaces[first - 1].thickness if first > 0 else room
    shifts = np.linspace(-(1 - _CLOSEST) * ahead, (1 - _CLOSEST) * room, 256)
    values = np.array([missed(shift) for shift in shifts])
    crossings = np.flatnonzero(values[:-1] * values[1:] <= 0)
    refuse_if(
        not len(crossings),
        f"distance = {distance:g}: no position of the group of surfaces {first + 1} to {last + 1} brings it into focus",
    )
    nearest = crossings[np.argmin(np.abs(shifts[crossings]))]
    shift = float(scipy.optimize.brentq(missed, shifts[nearest], shifts[nearest + 1], xtol=1e-12))
    focal_length, b = behind(shift)
    new = moved(shift)
    new.require_apart()
    return camera.replace(
        main_lens=new,
        focal_length=scale * focal_length,
        aperture_radius=scale * opening * paraxial(new).entrance_radius,
        mla_distance=scale * b,
    )


def _require_group(lens: Prescription, group: Any) -> tuple[int, int]:
    """Return the indices of a group's first and last surface."""
    count = len(lens.surfaces)
    refuse_if(
        not isinstance(group, (tuple, list, np.ndarray)) or len(group) != 2,
        f"group = {short_repr(group)}: it must be the numbers of its first and its last surface",
    )
    first, last = (require_count("group", surface_number, maximum=count) - 1 for surface_number in group)
    refuse_if(first > last, f"group = {short_repr(group)}: the first surface must not follow the last")
    refuse_if(
        first == 0 and last == count - 1,
        f"group = {short_repr(group)}: it is the whole lens; focus_distance moves the array instead",
    )
    for surface_number in (first - 1, last):
        refuse_if(
            0 <= surface_number < count and lens.surfaces[surface_number].glass is not None,
            f"group = {short_repr(group)}: glass follows surface {surface_number + 1}: a group moves in air",
        )
    return first, last
