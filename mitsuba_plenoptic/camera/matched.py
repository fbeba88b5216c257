"""The parameters of a camera from the numbers of data sheets: f-number, detector, pixels below each lens, pixel size.

With n pixels of width p below each lens and a pupil of the diameter D at the distance b before the array, micro-images
are n p wide and as far apart if :math:`D z / b = n p` and :math:`D_2 (b + z) / b = n p`, hence
:math:`n p = D_2 / (1 - D_2 / D)`.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from ..array import LATTICES
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
from ..runtime import Named, Pair
from .geometry import CameraGeometry

MATCHED = ("f_number", "lenses", "pixels_per_lens", "pixel_size", "sensor_size")
"""Arguments that a camera has not, and that state it together with the main lens's focal length and its focus."""

FOLLOWING = {
    "aperture_radius": "f_number and focal_length",
    "mla_focal_length": "f_number, pixels_per_lens and pixel_size",
    "detector_distance": "f_number, pixels_per_lens and pixel_size",
    "detector_width": "lenses, pixels_per_lens and pixel_size, or resolution and pixel_size",
}
"""Parameters that follow from a data sheet, and from which of its numbers."""


def micrometres(camera: CameraGeometry) -> list[str]:
    """Return a warning about lengths so large that they look like micrometres; of microscopes and telescopes none."""
    if not camera.lens_data.converges:
        return []
    diagonal = math.hypot(camera.detector_width, camera.detector_height)
    field = 2 * math.degrees(math.atan(diagonal / 2 / camera.mla_distance))
    pitch = max(camera.mla_pitches) if camera.has_array else 0.0
    # In millimetres: larger than in any camera; ordinary ones are rendered with coarse pixels, too.
    signs = {
        f"a pixel is {camera.pixel_size:.4g} mm wide": camera.has_array and camera.pixel_size > 0.1,
        f"the pitch of the lenses is {pitch:g} mm": pitch > 10,
        f"the detector's diagonal of {diagonal:.4g} mm exceeds ten focal lengths": diagonal > 10 * camera.focal_length,
        f"the field of view spans {field:.4g} degrees": field > 120,
    }
    advice = "lengths are taken as millimetres; if they are micrometres, divide them by 1000"
    return [f"{words}: {advice}" for words, is_large in signs.items() if is_large][:1]


def missing_from(sheet: Named) -> list[str]:
    """Return what an incomplete data sheet lacks."""
    has = {name for name, value in sheet.items() if value is not None}
    missing = [] if "f_number" in has else ["f_number"]
    missing += [] if has & {"lenses", "resolution", "sensor_size"} else ["lenses, resolution or sensor_size"]
    missing += [] if has & {"pixels_per_lens", "mla_pitch"} else ["pixels_per_lens or mla_pitch"]
    missing += [] if "pixel_size" in has or {"resolution", "sensor_size"} <= has else ["pixel_size"]
    missing += [] if has & {"main_lens", "focal_length"} else ["focal_length"]
    return missing + ([] if has & {"focus_distance", "mla_distance"} else ["focus_distance or mla_distance"])


def require_enough(sheet: Named) -> None:
    """Refuse missing arguments of a matched camera, and an argument that follows from the others."""
    has = {name for name, value in sheet.items() if value is not None}
    missing = missing_from(sheet)
    refuse_if(missing, f"{', '.join(missing)}: missing; a camera of {', '.join(MATCHED)} needs it")
    for names in (
        ("pixels_per_lens", "mla_pitch"),
        ("lenses", "resolution"),
        ("lenses", "sensor_size"),
        ("resolution", "sensor_size", "pixel_size"),
    ):
        refuse_if(has.issuperset(names), f"{', '.join(names)}: one of them follows from the others; leave it out")
    for name, others in FOLLOWING.items():
        if name in has:
            raise InputError(f"{name} = {short_repr(sheet[name])}: it follows from {others}; leave it out")


def behind_pupil(
    distance: float,
    radius: float,
    *,
    lattice: str,
    medium: float,
    lenses: int | Sequence[int] | None = None,
    resolution: int | Sequence[int] | None = None,
    sensor_size: float | Sequence[float] | None = None,
    pixels_per_lens: float | None = None,
    mla_pitch: float | None = None,
    pixel_size: float | None = None,
) -> Named:
    """Return the microlens and detector parameters behind a pupil of given radius and distance from the array."""
    sides = None
    if sensor_size is not None:
        sides = _pair("sensor_size", sensor_size, "(width, height)", require_length)
    pixels = None
    if resolution is not None:
        pixels = _counts("resolution", resolution)
    if pixel_size is not None:
        size = require_length("pixel_size", pixel_size)
    else:
        assert sides is not None and pixels is not None
        size, height = (side / count for side, count in zip(sides, pixels, strict=True))
        refuse_if(
            # Relative difference of a pixel's sides up to which rounded figures of a data sheet state square pixels.
            abs(height / size - 1) > 0.01,
            f"sensor_size = {short_repr(sensor_size)}: with resolution = {pixels} pixels are {size:.4g} by "
            f"{height:.4g} mm: they must be square",
        )
    if mla_pitch is None:
        micro_image = size * require_number("pixels_per_lens", pixels_per_lens, minimum=1, maximum=MOST_PIXELS)
    else:
        pitch = require_length("mla_pitch", mla_pitch)
        refuse_if(pitch >= 2 * radius, f"mla_pitch = {pitch:g}: it must be less than the pupil's {2 * radius:.4g} mm")
        micro_image = pitch / (1 - pitch / (2 * radius))
    if lenses is not None:
        across = micro_image / size
        columns, rows = _counts("lenses", lenses)
        pixels = max(1, round(columns * across)), max(1, round(rows * across * LATTICES[lattice].row_ratio))
    elif pixels is None:
        assert sides is not None
        pixels = round(sides[0] / size), round(sides[1] / size)
        refuse_if(
            min(pixels) < 1,
            f"sensor_size = {short_repr(sensor_size)} with pixel_size = {size:g}: a side rounds to no pixel",
        )
    stated = f"sensor_size = {short_repr(sensor_size)}" if lenses is None else f"lenses = {short_repr(lenses)}"
    refuse_if(
        max(pixels) > MOST_PIXELS,
        f"{stated}: with pixels of {size:g} mm the detector has {max(pixels)} along a side; at most {MOST_PIXELS}",
    )
    reduced = micro_image * distance / (2 * radius)
    return {
        "mla_pitch": micro_image * distance / (distance + reduced) if mla_pitch is None else pitch,
        "mla_focal_length": medium * reduced,
        "detector_distance": medium * reduced,
        "detector_width": size * pixels[0],
        "resolution": pixels,
    }


def _pair(name: str, value: object, form: str, rule: Callable[[str, Any], Any]) -> Pair:
    """Return two checked values, of which one number stands for both."""
    return require_pair(name, value if hasattr(value, "__len__") else (value, value), form, rule)


_counts = partial(_pair, form="(columns, rows)", rule=partial(require_count, maximum=MOST_PIXELS))
