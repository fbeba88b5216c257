"""How a real main lens stretches the image of an object plane: magnification out of focus, and distortion."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError
from .fitted_lens import FAR, WITHIN, FittedLens

_RADII = 257
"""Distances from the axis at which it is found."""


@dataclass(frozen=True)
class ImageStretch:
    """Where on the array chief rays of object points come, over where bins of reconstructions have them.

    Attributes
    ----------
    places : float64 array (n,)
        Distances of object points from the axis as bins count them, :math:`X b / g`, as far as light comes from there.
    ratio : float64 array (n,)
        Distance of the chief rays from the axis over these.
    area : float64 array (n,)
        By how much areas grow.
    """

    places: NDArray[np.float64]
    ratio: NDArray[np.float64]
    area: NDArray[np.float64]


def image_stretch(camera: PlenopticCamera, lens: FittedLens, distance: float) -> ImageStretch:
    """Return how the image of an object plane is stretched, up to the corners of the bins.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    lens : FittedLens
        Its main lens.
    distance : float
        Object distance; may be infinite.

    Raises
    ------
    InputError
        If the image folds.
    """
    g = min(distance, FAR)
    near = float(lens.nearness(np.array([[0.0, 0.0, g]]))[0])
    corner = math.hypot(*camera.bin_count) / 2 * camera.mla_pitch
    corner = min(corner, WITHIN * lens.fitted.aberration.scales.field / near * camera.mla_distance / g)
    places = np.linspace(0, corner, _RADII)[1:]
    points = np.column_stack([0 * places, -places * g / camera.mla_distance, np.full(len(places), g)])
    images = lens.images(points)[:, 1]
    growth = np.gradient(np.append(0, images), np.append(0, places))[1:]
    if images.min() <= 0 or growth.min() <= 0:
        raise InputError(f"distance = {distance:g}: the main_lens distorts so that the image of this plane folds")
    ratio = images / places
    return ImageStretch(places, ratio, ratio * growth)
