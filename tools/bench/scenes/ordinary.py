"""Ordinary cameras, what they see, and what diffraction makes of it: sums over the pupil, written without the package.

Columns of a capture count along +x of the camera frame on the detector, and rows along +y.
"""

from __future__ import annotations

import math
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.signal import fftconvolve

from mitsuba_plenoptic import PlenopticCamera

from .apertures import Mask
from .light_paths import facing, scene_of

WAVELENGTH = 550.0
AIRY_RADIUS = 0.60983
"""Radius of the Airy disc in lambda b / R."""

_REACH, WIDE = 24.0, 40.0
"""Distances in lambda b / R beyond the detector to which walls extend, and to which points spread."""

_PUPIL = 693
"""Samples across the pupil, which cells of apertures divide."""


def camera_of(airy: float, size: int = 48, **parameters: Any) -> PlenopticCamera:
    """Return an f/20 camera of square films whose pixels are some radii of the Airy disc wide."""
    camera = PlenopticCamera(
        mla_lattice="none", focal_length=80, aperture_radius=2, mla_distance=120, resolution=(size, size)
    )
    return camera.replace(detector_width=size * airy * AIRY_RADIUS * unit_of(camera), **parameters)


def unit_of(camera: PlenopticCamera) -> float:
    """Return lambda b / R in millimetres."""
    return WAVELENGTH * 1e-6 * camera.mla_distance / camera.aperture_radius


def blurred(camera: PlenopticCamera, blur: float) -> tuple[float, float]:
    """Return the distance of an object whose geometric blur has a radius in lambda b / R, and of its image."""
    image = camera.mla_distance / (1 + blur * unit_of(camera) / camera.aperture_radius)
    return 1 / (1 / camera.focal_length - 1 / image), image


def seen(camera: PlenopticCamera, picture: np.ndarray, side: float, blur: float, **others: Any) -> mi.Scene:
    """Return a scene with a radiating square, whose image is centred and `side` mm wide on the detector."""
    distance, _ = blurred(camera, blur)
    data = mi.Bitmap(np.ascontiguousarray(picture[::-1, :, None], np.float32))
    radiance = {"type": "bitmap", "bitmap": data, "filter_type": "nearest", "raw": True}
    half = side / 2 * distance / camera.mla_distance
    square = facing(distance, half, emitter={"type": "area", "radiance": radiance})
    return scene_of(camera.to_sensor(), "direct", square=square, **others)


def opening(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the power that passes a round pupil at coordinates over its radius."""
    return (np.hypot(x, y) <= 1) * 1.0


def point_spread(
    camera: PlenopticCamera, along: np.ndarray, blur: float, path: Any = None, mask: Mask = opening
) -> np.ndarray:
    """Return the light of a point at detector positions in mm, as |sum over the pupil|^2, in parts of a round pupil's.

    `path` is a function of the pupil's coordinates over its radius: the aberrations in waves. Light beyond the places
    is added in proportion, as walls end there, and evenly behind other masks, whose walls go on.
    """
    _, image = blurred(camera, blur)
    pupil = (np.arange(_PUPIL) + 0.5) / _PUPIL * 2 - 1
    x, y = np.meshgrid(pupil, pupil)
    square = (x * x + y * y) * camera.aperture_radius**2
    waves = square / (2 * WAVELENGTH * 1e-6) * (1 / camera.mla_distance - 1 / image)
    if path is not None:
        waves = waves + path(x, y)
    power, place = mask(x, y), along / unit_of(camera)
    phases = np.exp(-2j * np.pi * np.outer(place, pupil))
    spread = np.abs(phases @ (np.sqrt(power) * np.exp(2j * np.pi * waves)) @ phases.T) ** 2
    spread *= (2 / _PUPIL) ** 2 * (place[1] - place[0]) ** 2 / np.count_nonzero(opening(x, y))
    if mask is opening:
        return np.asarray(spread / spread.sum())
    return np.asarray(spread + (power.sum() / opening(x, y).sum() - spread.sum()) / spread.size)


def diffracted(
    camera: PlenopticCamera, picture: np.ndarray, texel: int, blur: float, path: Any = None, mask: Mask = opening
) -> np.ndarray:
    """Return the capture of a picture whose texels are whole pixels wide, by a convolution on a finer grid.

    `picture` is seen as a capture shows it, and is centred on the detector. See `point_spread`.
    """
    fine = max(4, math.ceil(8 * camera.pixel_size / unit_of(camera)))
    step = camera.pixel_size / fine
    reach = int((WIDE + abs(blur)) * unit_of(camera) / step)
    spread = point_spread(camera, np.arange(-reach, reach + 1) * step, blur, path, mask)
    image = np.kron(picture, np.ones((texel * fine,) * 2))
    whole = fftconvolve(image, spread, mode="same")
    size, first = camera.resolution[0], (len(image) - camera.resolution[0] * fine) // 2
    part = whole[first : first + size * fine, first : first + size * fine]
    return part.reshape(size, fine, size, fine).mean((1, 3))


def texture_of(camera: PlenopticCamera, texel: int, blur: float, reach: float = _REACH) -> np.ndarray:
    """Return a random picture whose texels are some pixels wide, and that reaches beyond the detector."""
    side = camera.detector_width + 2 * (reach + abs(blur)) * unit_of(camera)
    count = 2 * math.ceil(side / (2 * texel * camera.pixel_size))
    return np.random.default_rng(3).random((count, count))


def wall(camera: PlenopticCamera, texel: int, blur: float, reach: float = _REACH) -> tuple[mi.Scene, np.ndarray]:
    """Return a scene with a textured wall, and its picture for `diffracted`."""
    picture = texture_of(camera, texel, blur, reach)
    return seen(camera, picture, len(picture) * texel * camera.pixel_size, blur), picture
