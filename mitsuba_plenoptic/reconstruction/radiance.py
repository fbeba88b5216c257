"""From sums over bins to radiance, by one rule for all methods and lattices.

A bin is divided by what it gets of white in the same way: of a white capture of the same camera where there is one,
else of the white that the camera would record. So a white scene reads 1 everywhere, at the borders too, where part of
the light misses the detector. A bin that gets less than a hundredth of the rays that the best one gets is not reached:
there is next to nothing to be divided, and it is NaN, for every method alike. Between the footprints of lenses, fine
bins may get little light of waves though many rays reach them: by the computed white, which is least sure of them, they
are not brightened without end. A white capture knows what they get, and where waves interfere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..errors import InputError
from .methods import Progress, Task

_LEAST_REACHED = 0.01

_LEAST_WHITE = 0.25
"""Fraction of the light that as many rays usually bring, as which no bin's computed white counts less."""

Sums = Callable[[np.ndarray, Progress], list[np.ndarray]]
"""From a capture (rows, columns, channels) to the sums (rows, columns, channels) over the bins of every distance."""


def to_radiance(
    task: Task, sums: Sums, *, model: Callable[[], Sequence[np.ndarray]], reach: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Divide the sums of a capture by those of white.

    Parameters
    ----------
    task : Task
        With the capture, and the white capture if there is one.
    sums : callable
        Sums of a capture over bins.
    model : callable
        Returns what the bins get of the white that the camera would record, for every distance; arrays (rows, columns)
        or (rows, columns, channels).
    reach : sequence of (rows, columns) arrays
        Pixels of white whose rays reach the bins, for every distance.

    Returns
    -------
    list of (rows, columns, channels) float32 arrays
        Radiance; NaN where no light can come from.

    Raises
    ------
    InputError
        If light comes from none of a plane's bins.
    """
    if task.white is None:
        light, whites = sums(task.image, task.progress), model()
    else:
        light = sums(task.image, lambda done: task.progress(done / 2))
        whites = sums(task.white, lambda done: task.progress((1 + done) / 2))
    images = []
    for distance, total, white, rays in zip(task.distances, light, whites, reach, strict=True):
        white, reached = divisors(white, rays, distance, computed=task.white is None)
        image = np.full(total.shape, np.nan, np.float32)
        np.divide(total, white, out=image, where=np.broadcast_to(reached, total.shape), casting="same_kind")
        images.append(image)
    return images


def divisors(white: np.ndarray, rays: np.ndarray, distance: float, *, computed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return by what the sums over bins of a plane are divided, and which bins are.

    Parameters
    ----------
    white : (rows, columns) or (rows, columns, channels) array
        What the bins get of white.
    rays : (rows, columns) array
        Pixels of white whose rays reach them.
    distance : float
        Of the plane.
    computed : bool
        Whether the white is computed, and not recorded.

    Returns
    -------
    divisors, reached : (rows, columns, channels) arrays

    Raises
    ------
    InputError
        If light comes from none of the bins.
    """
    white = np.atleast_3d(white)
    reached = is_reached(rays)[..., None] & (white > 0)
    if not reached.any():
        raise InputError(f"distance = {distance:g}: no light comes from any of the {rays.size} bins there")
    if computed:
        # Both sums are of all bins, since light that misses one of them is in another.
        usual = white.sum() / (float(rays.sum()) * white.shape[2])
        white = np.maximum(white, _LEAST_WHITE * usual * rays[..., None])
    return white, reached


def is_reached(rays: np.ndarray) -> np.ndarray:
    """Return which bins get enough of the rays of white, (rows, columns), to be divided by what they get."""
    return np.asarray((rays >= _LEAST_REACHED * rays.max()) & (rays > 0))
