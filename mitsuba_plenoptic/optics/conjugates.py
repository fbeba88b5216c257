"""Which places of an object plane and of the microlens array belong together, for whole sets of points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from .rays import conjugate_coordinate

_FARTHEST = 1e12
"""Distance, in millimetres, from which on light counts as collimated."""


def images(camera: PlenopticCamera, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the places on the array, (n, 2), of the chief rays of scene points (n, 3).

    Parameters
    ----------
    camera : PlenopticCamera
        The camera, with a thin main lens or an objective.
    positions : float64 array (n, 3)
        Scene points.
    """
    if camera.objective is not None:
        return -camera.objective.magnification * positions[:, :2]
    return np.asarray(conjugate_coordinate(positions[:, :2], positions[:, 2:], camera.mla_distance))


def objects(
    camera: PlenopticCamera, places: NDArray[np.float64], distances: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the scene points, (n, 3), at some distances whose images are at places (n, 2) on the array.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera, with a thin main lens or an objective.
    places : float64 array (n, 2)
        Places on the array.
    distances : float64 array (n,)
        Distances of the points, finite.
    """
    scale = -distances / camera.mla_distance
    if camera.objective is not None:
        scale = np.full_like(distances, -1 / camera.objective.magnification)
    return np.column_stack([places * scale[:, None], distances])


def mean_distances(
    camera: PlenopticCamera, distances: NDArray[np.float64], group: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return for each group of distances that in the middle of their wavefronts.

    Wavefronts follow the reciprocal of the distance before a lens, and the distance itself before an objective.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera, with a thin main lens or an objective.
    distances : float64 array (n,)
        Distances of scene points.
    group : int64 array (n,)
        The group that each belongs to, counted from 0.
    """
    count = np.bincount(group)
    if camera.objective is not None:
        return np.asarray(np.bincount(group, distances) / count)
    mean = np.bincount(group, 1 / distances) / count
    # Light that diverges and light that converges may share a group, and their mean be collimated.
    return np.asarray(1 / np.where(np.abs(mean) > 1 / _FARTHEST, mean, 1 / _FARTHEST))
