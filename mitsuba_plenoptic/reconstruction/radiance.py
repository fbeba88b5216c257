"""From sums over bins to radiance: how many pixels of a white scene go to each bin."""

from __future__ import annotations

import math

import numpy as np

from ..camera import PlenopticCamera
from ..design import focus_type
from .splatting import splat

# Bins that get less than this fraction of the light that a bin gets of a white scene on average lie at the border of
# what was recorded; they are not brightened any further, since they would show little but noise.
_LEAST_WHITE = 0.25


def pixels_per_bin(camera: PlenopticCamera, oversample: int) -> float:
    r"""Pixels of micro-images that go to one bin: :math:`(\pi/4) (D_1 z / b)^2` over the pixel's area for each lens."""
    lenses = camera.mla_pitch**2 / camera.lattice.cell_area
    return lenses * math.pi / 4 * (camera.micro_image_diameter / camera.pixel_size / oversample) ** 2


def at_least(white: np.ndarray, camera: PlenopticCamera, oversample: int) -> np.ndarray:
    """Return what bins are divided by for a white scene to give 1, where they got this much of it."""
    return np.maximum(white, _LEAST_WHITE * pixels_per_bin(camera, oversample))


def white_bins(camera: PlenopticCamera, distance: float, oversample: int) -> np.ndarray:
    """Return what every bin gets of a white scene, in pixels, by one ray a pixel.

    The ray must pass the pupil, by half a pixel: a smooth wave goes back through the lens's centre alone.
    """
    nothing = np.zeros((*camera.shape, 1), np.float32)
    footprint = "point" if focus_type(camera) == "unfocused" else "lens"
    return splat(nothing, camera, distance, camera.lit_radius, footprint=footprint, oversample=oversample)[1]
