"""Refocusing of light fields by shifting and adding their views."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import xarray as xr

from ..errors import refuse_if, require_choice, require_number, suggest_keywords
from ..runtime import Array, Progress, counted, require_memory
from .coordinates import channel_planes, require_light_field, view_places
from .coordinates import disparity as disparity_at
from .viewpoints import as_view


def shift_and_add(lf: xr.DataArray, disparity: float) -> xr.DataArray:
    """Return the average of the views, shifted against their parallax.

    After R. Ng et al., "Light Field Photography with a Hand-held Plenoptic Camera" (2005), section 4. Views are shifted
    by linear interpolation and weighted by the fraction of the pupil that they see, so that borders do not darken.

    Parameters
    ----------
    lf : xarray.DataArray
        A light field, (v, u, t, s[, c]).
    disparity : float
        Lenses that a point in focus moves from view to view.

    Returns
    -------
    xarray.DataArray
        Dimensions t, s[, c]; 0 where no view sees the position.
    """
    lf = require_light_field(lf)
    disparity = require_number("disparity", disparity, minimum=-1e6, maximum=1e6)
    weight = lf["weight"].values
    planes = [weight] + [plane * weight for plane in channel_planes(lf)]
    shifts = view_places(lf) * disparity
    total, *light = (_gather(plane, *shifts) for plane in planes)
    visible = total > 1e-6
    image = np.stack([np.where(visible, plane / np.where(visible, total, 1), 0) for plane in light], axis=-1)
    return as_view(lf, image if "c" in lf.dims else image[..., 0])


@suggest_keywords
def refocus(lf: xr.DataArray, distance: float) -> xr.DataArray:
    """Return a light field refocused to a distance by `shift_and_add`.

    Parameters
    ----------
    lf : xarray.DataArray
        A light field of a camera.
    distance : float
        Object distance in millimetres, beyond the focal length; of a Fourier microscope the depth beyond its native
        object plane.

    Returns
    -------
    xarray.DataArray
        Dimensions t, s[, c], with the scalar coordinate `distance`. It lines up bin for bin with the
        reconstruction of the same capture.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> lf = mp.decode(mp.example("letters-ray"))
    >>> image = mp.views.refocus(lf, 280)
    >>> image.dims
    ('t', 's')
    """
    return focal_stack(lf, [distance])[0]


@suggest_keywords
def focal_stack(
    lf: xr.DataArray, distances: Sequence[float], *, by: str = "distance", progress: Progress | None = None
) -> xr.DataArray:
    """Return a light field refocused to several distances by `shift_and_add`.

    Parameters
    ----------
    lf : xarray.DataArray
        A light field, (v, u, t, s[, c]).
    distances : sequence of floats
        Object distances in millimetres, or disparities.
    by : {"distance", "disparity"}
        What the values are; disparities are those of `shift_and_add`, for which no camera is needed.
    progress : callable, optional
        Called with the distances done and how many there are.

    Returns
    -------
    xarray.DataArray
        Dimensions distance or disparity, t, s[, c].

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> lf = mp.decode(mp.example("letters-ray"))
    >>> mp.views.focal_stack(lf, [210, 240, 280]).sel(distance=240).dims
    ('t', 's')
    """
    lf = require_light_field(lf)
    require_choice("by", by, ("distance", "disparity"))
    distances = [require_number(by, value, finite=by == "disparity") for value in distances]
    refuse_if(not distances, "distances = []: give at least one")
    disparities = distances if by == "disparity" else [disparity_at(lf, value) for value in distances]
    images = 8.0 * lf.sizes["t"] * lf.sizes["s"] * lf.sizes.get("c", 1)
    # Views are moved in copies.
    require_memory(6.0 * lf.size + 2 * images * len(disparities), f"focal stack of {len(disparities)} distances")
    stack = xr.concat([shift_and_add(lf, value) for value in counted(disparities, progress)], dim=by)
    return stack.assign_coords({by: (by, distances, {"units": "mm" if by == "distance" else "pixels per view"})})


# Variance of the places, in squared bins, from which `moved` takes a sample: that for which all of its rules hold.
_SPREAD = 0.55 - math.sqrt(0.015)


def moved(values: Array, shift: float, axis: int) -> Array:
    """Return an array read `shift` samples further along an axis, as blurred and as noisy for any shift.

    Linear interpolation averages noise between samples only, so that moved views seem to agree where shifts are not
    whole. Four weights, with the sum 1, the mean `shift`, one variance and one sum of squares, do not. Outside the
    array is 0.
    """
    fraction = shift - math.floor(shift)
    before = (_SPREAD + fraction**2 - fraction) / 2
    at = 1 - _SPREAD - fraction**2
    after = (_SPREAD + fraction**2 + fraction) / 2
    # What is left free is a third difference; it sets the sum of squares to that of three weights of a whole shift.
    half = 3 * (at - after) - before
    excess = before**2 + at**2 + after**2 - (1 - 2 * _SPREAD + 1.5 * _SPREAD**2)
    last = (math.copysign(math.sqrt(max(half**2 - 20 * excess, 0)), 0.5 - fraction) - half) / 20
    result = np.zeros_like(values)
    _add_shifted(result, values, shift, axis, {-1: before - last, 0: at + 3 * last, 1: after - 3 * last, 2: last})
    return result


def _add_shifted(total: Array, values: Array, shift: float, axis: int, weights: dict[int, float] | None = None) -> None:
    """Add an array read `shift` samples further along an axis to a total; outside it is 0.

    The weights are those of the samples about the last one before the place; without them, of linear interpolation.
    """
    steps = int(np.floor(shift))
    size = values.shape[axis]
    before = (slice(None),) * axis
    fraction = shift - steps
    for step, factor in (weights or {0: 1 - fraction, 1: fraction}).items():
        count = steps + step
        overlap = size - abs(count)
        if overlap > 0 and factor != 0:
            source = values[(*before, slice(max(count, 0), max(count, 0) + overlap))]
            total[(*before, slice(max(-count, 0), max(-count, 0) + overlap))] += (
                source if factor == 1 else source * np.float32(factor)
            )


def _gather(values: Array, across: Array, down: Array) -> Array:
    """Return the sum of views (v, u, t, s), each read at its own shift, (v, u)."""
    total = np.zeros(values.shape[2:], dtype=np.float64)
    if np.ptp(across, axis=0).any() or np.ptp(down, axis=1).any():
        for index in np.argwhere(values.any(axis=(2, 3))):
            moved_down = np.zeros(values.shape[2:], dtype=np.float64)
            _add_shifted(moved_down, values[tuple(index)], down[tuple(index)], axis=0)
            _add_shifted(total, moved_down, across[tuple(index)], axis=1)
        return total
    # Views in a column are added before they are moved across.
    by_column = np.zeros(values.shape[1:], dtype=np.float64)
    for row, shift in zip(values, down[:, 0], strict=True):
        _add_shifted(by_column, row, shift, axis=1)
    for column, shift in zip(by_column, across[0], strict=True):
        _add_shifted(total, column, shift, axis=1)
    return total
