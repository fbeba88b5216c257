"""White walls and ramps that fill a camera's view, at a distance or as the sky, and their captures."""

from __future__ import annotations

import math
from typing import Any

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import Capture, PlenopticCamera, render_capture

WALLS = ("white", "ramp")
WAVELENGTH = 633.0
SLOPE = 0.5
"""Radiance by which a ramp rises over half the field."""

_RAMP_END = 1.9
"""Half width of a ramp over that of the field: beyond, its radiance stays what it is there, above zero."""

_MARGIN = 2.0
"""By how many half fields a wall extends beyond what rays see: diffraction brings light from there."""

_SKY_TEXELS = 8192


def radiance(slope: np.ndarray, wall: str) -> np.ndarray:
    """Radiance at places in units of half the field, to the left of its middle."""
    return 1 + SLOPE * np.clip(slope, -_RAMP_END, _RAMP_END) if wall == "ramp" else np.ones_like(slope)


def known_radiance(camera: PlenopticCamera, wall: str) -> np.ndarray:
    """Radiance of a wall in each column of bins."""
    columns = camera.bin_count[0]
    # +x, to which the radiance rises, is left.
    return radiance(1 - 2 * (np.arange(columns) + 0.5) / columns, wall)


def capture(camera: PlenopticCamera, distance: float, wall: str, model: str, spp: int) -> Capture:
    """Capture a wall, or for an infinite distance a sky."""
    half = camera.bin_count[0] / 2 * camera.mla_pitch / camera.mla_distance
    blur = camera.blur_diameter(distance) / 2 / camera.mla_distance
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 1},
        "sensor": camera.to_sensor(),
        "wall": _sky(half, wall) if math.isinf(distance) else _wall(half, distance, 1 + blur / half + _MARGIN, wall),
    }
    options = {"wavelength": WAVELENGTH} if model == "wave" else {}
    return render_capture(mi.load_dict(scene), model=model, spp=spp, **options)


def _wall(half: float, distance: float, halves: float, wall: str) -> dict[str, Any]:
    size = halves * half * distance
    texels = 2 * math.ceil(128 * halves)
    slope = halves * (2 * (np.arange(texels) + 0.5) / texels - 1)
    turned = mi.ScalarTransform4f().translate([0, 0, distance]).rotate([0, 1, 0], 180).scale([size, size, 1])
    # A rectangle that is turned to the camera has its u along -x.
    texture = {"type": "bitmap", "bitmap": _bitmap(radiance(-slope, wall), 4), "raw": True}
    return {
        "type": "rectangle",
        "to_world": turned,
        "bsdf": {"type": "diffuse", "reflectance": 0.0},
        "emitter": {"type": "area", "radiance": texture},
    }


def _sky(half: float, wall: str) -> dict[str, Any]:
    angle = 2 * math.pi * (np.arange(_SKY_TEXELS) + 0.5) / _SKY_TEXELS
    # Mitsuba's longitude runs from -z by +x; ahead is +z.
    slope = np.where(np.cos(angle) < 0, -np.tan(angle) / half, 0)
    return {"type": "envmap", "bitmap": _bitmap(radiance(slope, wall), 64)}


def _bitmap(line: np.ndarray, rows: int) -> Any:
    return mi.Bitmap(np.repeat(np.tile(line, (rows, 1))[..., None], 3, axis=2).astype(np.float32))
