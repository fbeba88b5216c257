"""What the parameters of a camera may be all together: the table has what each of them may be by itself."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..bounds import MOST_JITTER
from ..errors import InputError, require_number, shown
from ..lattice import LATTICES
from ..objective import Objective
from ..prescription import Prescription
from ..thin_lens import conjugate_distance, image_distance
from .entry import Captures
from .geometry import CameraGeometry
from .given_lens import nearest_array, own_numbers
from .parameters import PARAMETERS

_THIN_LENS = (80.0, 5.0)
"""Focal length and radius of a thin lens, in millimetres, where they are not given."""

_MLA_DISTANCE = 120.0
"""Distance from the main lens to the array, in millimetres, where neither that nor a plane in focus is given."""

_SINGLE = 1e-6
"""Largest relative change by rounding to single precision: files and scenes may hold numbers like that."""


def checked_values(given: dict[str, Any]) -> dict[str, Any]:
    """Return all values of a camera, by attribute, from arguments by name: each is checked, and defaults filled in."""
    values: dict[str, Any] = {}
    for name, entry in PARAMETERS.items():
        value = given.get(name, entry.default)
        missing = value is None and entry.default is None
        values[entry.attribute] = None if missing else entry.check(name, value)
    _complete_lens(values)
    _check_array(values)
    if values["detector_distance"] is None:
        values["detector_distance"] = values["mla_focal_lengths"][0]
    _complete_window(values)
    return values


def _complete_lens(values: dict[str, Any]) -> None:
    """Fill in the numbers of the main lens and of the array's distance from it; refuse what contradicts the lens."""
    lens, focus = values["main_lens"], values["focus_distance"]
    own = _THIN_LENS if lens is None else own_numbers(lens, values["focal_length"])
    for name, number in zip(("focal_length", "aperture_radius"), own, strict=True):
        if values[name] is None:
            values[name] = PARAMETERS[name].check(name, number)
    if focus is not None:
        if values["mla_distance"] is not None:
            raise InputError(
                f"mla_distance = {values['mla_distance']:g} and focus_distance = {focus:g}: give one of the two"
            )
        if isinstance(lens, Objective):
            raise InputError(
                f"focus_distance = {focus:g}: an objective is focused on its native object plane; leave it out"
            )
        found = image_distance(values["focal_length"], focus, name="focus_distance")
        values["mla_distance"] = PARAMETERS["mla_distance"].check("mla_distance", found)
    if isinstance(lens, Objective):
        _take_from(lens, values)
    elif values["mla_distance"] is None:
        values["mla_distance"] = _MLA_DISTANCE
    # It is what follows from the others, whatever digits it was given with.
    values["focus_distance"] = (
        0.0 if isinstance(lens, Objective) else conjugate_distance(values["focal_length"], values["mla_distance"])
    )


def _take_from(objective: Objective, values: dict[str, Any]) -> None:
    """Take an objective's own numbers; refuse others."""
    own = {
        "focal_length": objective.focal_length,
        "aperture_radius": objective.stop_radius,
        "mla_distance": objective.last_focal_length,
    }
    for name, number in own.items():
        if values[name] is not None and not math.isclose(values[name], number, rel_tol=_SINGLE):
            raise InputError(f"{name} = {values[name]:g}: with this main_lens it is {number:.6g}; leave it out")
    values |= own


def _check_array(values: dict[str, Any]) -> None:
    """Refuse focal lengths that the lattice has no types for, and an array that is too irregular for its pitches."""
    types, focal_lengths = LATTICES[values["mla_lattice"]].lens_types, values["mla_focal_lengths"]
    if len(focal_lengths) not in (1, types):
        several = ", ".join(name for name, each in LATTICES.items() if each.lens_types > 1)
        rule = f"one number or {types}" if types > 1 else f"one number; several need mla_lattice = {several}"
        raise InputError(f"mla_focal_length = {shown(focal_lengths)}: it must be {rule}")
    bounds = MOST_JITTER * min(values["mla_pitches"]), MOST_JITTER
    for value, most in zip(values["mla_jitter"], bounds, strict=True):
        require_number("mla_jitter", value, maximum=most)


def _complete_window(values: dict[str, Any]) -> None:
    """Fill in the size of the crop window, which is all that there is, and refuse one that leaves the detector."""
    resolution, offset, size = values["resolution"], values["crop_offset"], values["crop_size"]
    if size is None:
        rest = tuple(count - first for count, first in zip(resolution, offset, strict=True))
        size = values["crop_size"] = PARAMETERS["crop_size"].check("crop_size", rest)
    if any(first + recorded > count for count, first, recorded in zip(resolution, offset, size, strict=True)):
        raise InputError(
            f"crop_offset = {offset} with crop_size = {size}: the window must lie within the resolution {resolution}"
        )


def require_whole(camera: CameraGeometry) -> None:
    """Refuse numbers each of which may be, but not all of them together."""
    if camera.main_lens is not None:
        _require_alone(camera)
    if camera.prescription is not None:
        _require_room(camera, camera.prescription)
    if camera.objective is not None and any(camera.mla_tilt):
        raise InputError(f"mla_tilt = {camera.mla_tilt}: behind an objective it must be 0")
    reach = np.hypot(*(np.abs(camera.pixel_coordinates(axis)[[0, -1]]).max() for axis in (0, 1)))
    rise = reach * np.hypot(*np.tan(np.deg2rad(camera.mla_tilt)))
    if rise >= min(camera.detector_distance, camera.mla_distance):
        raise InputError(f"mla_tilt = {camera.mla_tilt}: the array rises by {rise:.3g}: it touches detector or lens")
    radius, (k1, k2, k3) = np.linspace(0, reach, 64) ** 2, camera.distortion[:3]
    if np.min(1 + radius * (3 * k1 + radius * (5 * k2 + radius * 7 * k3))) <= 0:
        raise InputError(f"distortion = {camera.distortion}: it folds the image within {reach:.3g} mm of the axis")


def _require_alone(camera: CameraGeometry) -> None:
    """Refuse what a real main lens brings itself."""
    for name, values in (("distortion", camera.distortion), ("wavefront", camera.wavefront)):
        if any(values):
            raise InputError(f"{name} = {values}: a main_lens brings its own; leave it out")
    if camera.glass is not None:
        raise InputError(f"glass = {shown(camera.glass.to_plain())}: a main_lens brings its own; leave it out")


def _require_room(camera: CameraGeometry, lens: Prescription) -> None:
    """Refuse a stop wider than a lens of surfaces, and an array within it."""
    widest = own_numbers(lens, camera.focal_length)[1]
    if camera.aperture_radius > widest * (1 + _SINGLE):
        raise InputError(f"aperture_radius = {camera.aperture_radius:g}: the main_lens opens to {widest:.6g} at most")
    nearest = nearest_array(lens, camera.focal_length)
    if camera.mla_distance <= nearest:
        raise InputError(
            f"mla_distance = {camera.mla_distance:g}: the array would stand within the main_lens or its exit pupil; "
            f"it must be more than {nearest:.4g}"
        )


def require_known_to(camera: CameraGeometry, captures: Captures, what: str, instead: str = "") -> None:
    """Refuse a camera with a parameter that captures of a kind would ignore; `what` begins the rule."""
    for name, entry in PARAMETERS.items():
        value = getattr(camera, entry.attribute)
        if captures not in entry.known_to and value != entry.default:
            raise InputError(f"{name} = {value}: {what} through cameras without it only; {instead}leave it out")
