"""What the numbers of a camera may be: part by part, with what is taken where nothing is given, and all together."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..bounds import (
    FULL_TURN,
    LEAST_FILL,
    MOST_JITTER,
    MOST_SEED,
    MOST_STRETCH,
    STEEPEST_TILT,
    require_length,
    require_lengths,
    require_numbers,
    require_pixels,
    require_place,
)
from ..errors import InputError, require_choice, require_count, require_number, shown
from ..lattice import APERTURES, LATTICES
from ..lens_data import THIN, LensData
from ..thin_lens import image_distance
from .geometry import CameraGeometry


def lens_numbers(
    lens: LensData | None,
    focal_length: float | None,
    aperture_radius: float | None,
    mla_distance: float | None,
    focus_distance: float | None,
) -> dict[str, Any]:
    """Return the numbers of the main lens and of the array's distance from it; None stands for what is not given."""
    data = lens or THIN
    own = data.own_numbers(focal_length)
    focal_length = require_length("focal_length", own[0] if focal_length is None else focal_length)
    aperture_radius = require_length("aperture_radius", own[1] if aperture_radius is None else aperture_radius)
    if mla_distance is not None and focus_distance is not None:
        raise InputError(
            f"mla_distance = {shown(mla_distance)} and focus_distance = {shown(focus_distance)}: give one of the two"
        )
    if focus_distance is not None:
        data.require_focusable(focus_distance)
        focus_distance = require_length("focus_distance", focus_distance, finite=False)
        mla_distance = image_distance(focal_length, focus_distance, name="focus_distance")
    if mla_distance is None:
        mla_distance = data.array_distance()
    numbers = {
        "focal_length": focal_length,
        "aperture_radius": aperture_radius,
        "mla_distance": require_length("mla_distance", mla_distance),
    }
    return data.settled(numbers)


def array_numbers(
    lattice: Any,
    focal_lengths: Any,
    pitches: Any,
    *,
    rotation: Any,
    offset: Any,
    tilt: Any,
    aperture: Any,
    fill: Any,
    jitter: Any,
    seed: Any,
) -> dict[str, Any]:
    """Return the numbers of the microlens array."""
    lattice = require_choice("mla_lattice", lattice, LATTICES)
    types = LATTICES[lattice].lens_types
    several = ", ".join(name for name, each in LATTICES.items() if each.lens_types > 1)
    rule = f"one number or {types}" if types > 1 else f"one number; several need mla_lattice = {several}"
    focal_lengths = require_lengths("mla_focal_length", focal_lengths, {1, types}, rule)
    pitches = require_lengths("mla_pitch", pitches, {1, 2}, "one number, or two, along the rows and across them")
    if max(pitches) > MOST_STRETCH * min(pitches):
        raise InputError(f"mla_pitch = {pitches}: neither may be more than {MOST_STRETCH:g} times the other")
    numbers = {
        "mla_lattice": lattice,
        "mla_focal_lengths": focal_lengths,
        "mla_pitches": (pitches[0], pitches[-1]),
        "mla_rotation": require_number("mla_rotation", rotation, minimum=-FULL_TURN, maximum=FULL_TURN),
        "mla_offset": require_place("mla_offset", offset),
        "mla_tilt": require_numbers("mla_tilt", tilt, 2, STEEPEST_TILT),
        "mla_aperture": require_choice("mla_aperture", aperture, APERTURES),
    }
    fill = require_number("mla_fill", fill, positive=True)
    numbers["mla_fill"] = require_number("mla_fill", fill, minimum=LEAST_FILL, maximum=1)
    jitter = require_numbers("mla_jitter", jitter, 2, MOST_JITTER * max(1.0, *pitches))
    for value, most in zip(jitter, (MOST_JITTER * min(pitches), MOST_JITTER), strict=True):
        require_number("mla_jitter", value, minimum=0, maximum=most)
    seed = require_count("mla_seed", seed, minimum=0, maximum=MOST_SEED)
    return numbers | {"mla_jitter": jitter, "mla_seed": seed}


def detector_numbers(distance: Any, width: Any, resolution: Any, crop_offset: Any, crop_size: Any) -> dict[str, Any]:
    """Return the numbers of the detector; a `crop_size` of None stands for all that there is."""
    distance = require_length("detector_distance", distance)
    width = require_length("detector_width", width)
    resolution = require_pixels("resolution", resolution, minimum=1)
    crop_offset = require_pixels("crop_offset", crop_offset, minimum=0)
    if crop_size is None:
        crop_size = tuple(count - first for count, first in zip(resolution, crop_offset, strict=True))
    crop_size = require_pixels("crop_size", crop_size, minimum=1)
    for count, first, recorded in zip(resolution, crop_offset, crop_size, strict=True):
        if first + recorded > count:
            raise InputError(
                f"crop_offset = {crop_offset} with crop_size = {crop_size}: the window must lie "
                f"within the resolution {resolution}"
            )
    return {
        "detector_distance": distance,
        "detector_width": width,
        "resolution": resolution,
        "crop_offset": crop_offset,
        "crop_size": crop_size,
    }


def require_whole(camera: CameraGeometry) -> None:
    """Refuse numbers each of which may be, but not all of them together."""
    camera.lens_data.require_fit(camera)
    reach = np.hypot(*(np.abs(camera.pixel_coordinates(axis)[[0, -1]]).max() for axis in (0, 1)))
    rise = reach * np.hypot(*np.tan(np.deg2rad(camera.mla_tilt)))
    if rise >= min(camera.detector_distance, camera.mla_distance):
        raise InputError(f"mla_tilt = {camera.mla_tilt}: the array rises by {rise:.3g}: it touches detector or lens")
    radius, (k1, k2, k3) = np.linspace(0, reach, 64) ** 2, camera.distortion[:3]
    if np.min(1 + radius * (3 * k1 + radius * (5 * k2 + radius * 7 * k3))) <= 0:
        raise InputError(f"distortion = {camera.distortion}: it folds the image within {reach:.3g} mm of the axis")
