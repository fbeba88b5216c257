"""Checks of a camera's parameters in combination, and whether captures of a kind support the camera.

The table of parameters has the check of each one by itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..bounds import MOST_JITTER
from ..errors import InputError, refuse_if, require_number, short_repr
from ..lattice import LATTICES
from ..lens_data import THIN
from ..thin_lens import image_distance
from .entry import Captures
from .geometry import CameraGeometry
from .parameters import PARAMETERS


def checked_values(given: dict[str, Any]) -> dict[str, Any]:
    """Check a camera's arguments, given by name, and fill in defaults; return all values by attribute."""
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
    """Fill in the main lens's parameters and the array's distance from it; refuse values that contradict the lens."""
    data, focus = values["main_lens"] or THIN, values["focus_distance"]
    for name, number in zip(("focal_length", "aperture_radius"), data.own_numbers(values["focal_length"]), strict=True):
        if values[name] is None:
            values[name] = PARAMETERS[name].check(name, number)
    if focus is not None:
        if values["mla_distance"] is not None:
            raise InputError(
                f"mla_distance = {values['mla_distance']:g} and focus_distance = {focus:g}: give one of the two"
            )
        data.require_focusable(focus)
        found = image_distance(values["focal_length"], focus, name="focus_distance")
        values["mla_distance"] = PARAMETERS["mla_distance"].check("mla_distance", found)
    elif values["mla_distance"] is None:
        values["mla_distance"] = data.array_distance()
    values |= data.settled({name: values[name] for name in ("focal_length", "aperture_radius", "mla_distance")})
    # It is what follows from the others, whatever digits it was given with.
    values["focus_distance"] = data.focus_distance(values["focal_length"], values["mla_distance"])


def _check_array(values: dict[str, Any]) -> None:
    """Refuse focal lengths for which the lattice has no lens types, and arrays too irregular for their pitches."""
    types, focal_lengths = LATTICES[values["mla_lattice"]].lens_types, values["mla_focal_lengths"]
    if len(focal_lengths) not in (1, types):
        several = ", ".join(name for name, each in LATTICES.items() if each.lens_types > 1)
        rule = f"one number or {types}" if types > 1 else f"one number; several need mla_lattice = {several}"
        raise InputError(f"mla_focal_length = {short_repr(focal_lengths)}: it must be {rule}")
    bounds = MOST_JITTER * min(values["mla_pitches"]), MOST_JITTER
    for value, most in zip(values["mla_jitter"], bounds, strict=True):
        require_number("mla_jitter", value, maximum=most)


def _complete_window(values: dict[str, Any]) -> None:
    """Fill in the size of the crop window, by default the rest of the detector; refuse a window outside of it."""
    resolution, offset, size = values["resolution"], values["crop_offset"], values["crop_size"]
    if size is None:
        rest = tuple(count - first for count, first in zip(resolution, offset, strict=True))
        size = values["crop_size"] = PARAMETERS["crop_size"].check("crop_size", rest)
    refuse_if(
        any(first + recorded > count for count, first, recorded in zip(resolution, offset, size, strict=True)),
        f"crop_offset = {offset} with crop_size = {size}: the window must lie within the resolution {resolution}",
    )


def require_whole(camera: CameraGeometry) -> None:
    """Refuse parameters that are valid one by one but not in combination."""
    camera.lens_data.require_fit(camera)
    reach = np.hypot(*(np.abs(camera.pixel_coordinates(axis)[[0, -1]]).max() for axis in (0, 1)))
    rise = reach * np.hypot(*np.tan(np.deg2rad(camera.mla_tilt)))
    refuse_if(
        rise >= min(camera.detector_distance, camera.mla_distance),
        f"mla_tilt = {camera.mla_tilt}: the array rises by {rise:.3g}: it touches detector or lens",
    )
    radius, (k1, k2, k3) = np.linspace(0, reach, 64) ** 2, camera.distortion[:3]
    refuse_if(
        np.min(1 + radius * (3 * k1 + radius * (5 * k2 + radius * 7 * k3))) <= 0,
        f"distortion = {camera.distortion}: it folds the image within {reach:.3g} mm of the axis",
    )


def require_known_to(camera: CameraGeometry, captures: Captures, what: str, instead: str = "") -> None:
    """Refuse a camera with a parameter that captures of a kind would ignore; `what` begins the rule."""
    for name, entry in PARAMETERS.items():
        value = getattr(camera, entry.attribute)
        if captures not in entry.known_to and value != entry.default:
            raise InputError(f"{name} = {value}: {what} through cameras without it only; {instead}leave it out")


def require_ideal(camera: CameraGeometry) -> None:
    """Refuse a camera with features that the wave model of points does not support, such as an irregular array."""
    require_known_to(camera, Captures.POINTS, "waves of points are followed", "use ray captures, or ")


def require_no_glass(camera: CameraGeometry, what: str) -> None:
    """Refuse a camera whose thin lenses are of dispersive glass, for computations without dispersion."""
    for name in ("glass", "mla_glass"):
        glass = getattr(camera, name)
        if glass is not None:
            raise InputError(f"{name} = {glass.name or glass.form}: {what} leave it out")
