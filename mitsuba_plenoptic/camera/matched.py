"""The parameters of a camera from the numbers of data sheets: f-number, count of lenses, pixels below each, pixel size.

With n pixels of width p below each lens and a pupil of the diameter D at the distance b before the array, micro-images
are n p wide and as far apart if :math:`D z / b = n p` and :math:`D_2 (b + z) / b = n p`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..errors import (
    MOST_PIXELS,
    InputError,
    refuse_if,
    require_count,
    require_length,
    require_number,
    require_pair,
    short_repr,
)
from ..lattice import LATTICES

MATCHED = ("f_number", "lenses", "pixels_per_lens", "pixel_size")
"""Arguments that a camera has not, and that state it together with the main lens's focal length and its focus."""

_FOLLOWING = {
    "aperture_radius": "f_number and focal_length",
    "mla_pitch": "pixels_per_lens and pixel_size",
    "mla_focal_length": "f_number, pixels_per_lens and pixel_size",
    "detector_distance": "f_number, pixels_per_lens and pixel_size",
    "detector_width": "lenses, pixels_per_lens and pixel_size",
    "resolution": "lenses and pixels_per_lens",
}


def require_enough(given: dict[str, Any]) -> None:
    """Refuse missing arguments of a matched camera, and an argument that follows from the others."""
    names = [*MATCHED, *(["focal_length"] if given.get("main_lens") is None else [])]
    missing = [name for name in names if given.get(name) is None]
    if given.get("focus_distance") is None and given.get("mla_distance") is None:
        missing.append("focus_distance or mla_distance")
    refuse_if(
        missing,
        f"{', '.join(missing)}: missing; a camera of {', '.join(MATCHED)} needs all of these, focal_length, and "
        "focus_distance or mla_distance",
    )
    for name, others in _FOLLOWING.items():
        if given.get(name) is not None:
            raise InputError(f"{name} = {short_repr(given[name])}: it follows from {others}; leave it out")


def behind_pupil(
    distance: float,
    radius: float,
    *,
    lenses: int | Sequence[int],
    pixels_per_lens: float,
    pixel_size: float,
    lattice: str,
    medium: float,
) -> dict[str, Any]:
    """Return the microlens and detector parameters behind a pupil of given radius and distance from the array."""
    pixels = require_number("pixels_per_lens", pixels_per_lens, minimum=1, maximum=MOST_PIXELS)
    size = require_length("pixel_size", pixel_size)
    pair = lenses if hasattr(lenses, "__len__") else (lenses, lenses)
    columns, rows = (
        require_count("lenses", count, maximum=MOST_PIXELS) for count in require_pair("lenses", pair, "(columns, rows)")
    )
    pitch = pixels * size
    reduced = pitch * distance / (2 * radius)
    resolution = max(1, round(columns * pixels)), max(1, round(rows * pixels * LATTICES[lattice].row_ratio))
    refuse_if(
        max(resolution) > MOST_PIXELS,
        f"lenses = {short_repr(lenses)}: with pixels_per_lens = {pixels:g} the detector has {max(resolution)} pixels "
        f"along a side; at most {MOST_PIXELS}",
    )
    return {
        "mla_pitch": pitch * distance / (distance + reduced),
        "mla_focal_length": medium * reduced,
        "detector_distance": medium * reduced,
        "detector_width": size * resolution[0],
        "resolution": resolution,
    }
