"""How much of the exit pupil of a real main lens is open, seen from the places of the microlens array (MLA)."""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from .lens_system import LensSystem

_HEIGHTS, _ACROSS = 17, 151
"""Distances from the axis at which it is found, and rays across the pupil."""

_WIDER = 1.05
"""Up to where, over the corner of the detector: light of lenses beside it reaches it, too."""


@functools.lru_cache(maxsize=16)
def pupil_bound(camera: PlenopticCamera) -> float:
    """Return the radius of a circle about the axis that holds the exit pupil's light wherever a detector looks.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.

    Raises
    ------
    InputError
        If no ray gets through the main lens, even to the axis.
    """
    if camera.prescription is None:
        return camera.aperture_radius
    return LensSystem.of(camera).pupil_reach(_corner(camera))


def open_fraction(camera: PlenopticCamera, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the fraction of that circle that is open, seen from places on the MLA.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera, with a real main lens.
    x, y : float64 array
        Places in millimetres.
    """
    heights, fractions = _fractions(camera)
    return np.interp(np.hypot(x, y), heights, fractions)


def _corner(camera: PlenopticCamera) -> float:
    return math.hypot(camera.detector_width, camera.detector_height) / 2


@functools.lru_cache(maxsize=16)
def _fractions(camera: PlenopticCamera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    lens, radius = LensSystem.of(camera), pupil_bound(camera)
    heights = np.linspace(0, _WIDER * _corner(camera), _HEIGHTS)
    axis = ((np.arange(_ACROSS) + 0.5) * 2 / _ACROSS - 1) * radius
    Px, Py = (values[np.hypot(*grid) <= radius] for grid in [np.meshgrid(axis, axis)] for values in grid)
    return heights, np.array(
        [np.mean(lens.ray((Px, Py), (np.zeros_like(Px), np.full_like(Py, height)))[2]) for height in heights]
    )
