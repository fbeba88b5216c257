r"""Disparity between the pictures of two halves of the pupil: a closed form for half discs, and a block matcher.

A point out of focus lights a disc of radius R on the array; each half of the pupil lights one half of the disc. The
centroid of a half disc lies :math:`4 R / (3 \pi)` from the straight side, so that the two centroids are :math:`8 R / (3
\pi)` apart.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter, uniform_filter

from ... import choices
from ...camera import PlenopticCamera, Use, require_support
from ...errors import InputError, refuse_if, require_choice, require_count, require_number, suggest_keywords
from ...prescription import lens_data
from ...runtime import Array
from ...views import require_light_field

_FLAT = 1e-6
"""Least variance in a window, over its mean square, for which there is something to match."""


@suggest_keywords
def half_disparity(camera: PlenopticCamera, distance: float) -> float:
    r"""Disparity in lenses between a point's pictures through two half pupils, by rays and in closed form.

    The disparity of a point with the blur radius R is :math:`-8 R / (3 \pi)`, from the left picture to the right one:
    negative for points nearer than the plane in focus, as `mitsuba_plenoptic.views.disparity` is. It holds on the axis,
    where the pupil is round, if each photodiode sees one half of it.

    Parameters
    ----------
    distance : float
        Object distance from the main lens in millimetres; may be infinite.
    """
    camera.require_lens("the disparity of half pupils")
    require_support(camera, Use.ROUND_PUPILS)
    distance = require_number("distance", distance, finite=False)
    lens_data.image_distance(camera.focal_length, distance)
    return -8 / (3 * math.pi) * float(blur_radius(camera, distance))


@suggest_keywords
def bank_disparity(bank: xr.DataArray, axis: str = "horizontal") -> xr.DataArray:
    """Return the disparities in a bank of point spreads: the distances of the centroids of the two halves.

    Parameters
    ----------
    bank : xarray.DataArray
        The bank, from `psf_bank`.
    axis : {"horizontal", "vertical"}
        Whether the halves are left and right, or top and bottom.

    Returns
    -------
    xarray.DataArray
        Dimensions depth and field, in lenses, with the sign of `half_disparity`.
    """
    require_choice("axis", axis, choices.Axis)
    pupil, along = ("u", "s") if axis == "horizontal" else ("v", "t")
    if bank.sizes[pupil] != 2:
        raise InputError(f"bank: {bank.sizes[pupil]} pictures along {pupil}: a pair has two")
    others = [dim for dim in ("v", "u", "t", "s") if dim != pupil]
    centroids = (bank * bank[along]).sum(others) / bank.sum(others)
    return (centroids.isel({pupil: 1}) - centroids.isel({pupil: 0})).rename("disparity").assign_attrs(units="lenses")


def blur_radius(camera: PlenopticCamera, distance: Any) -> Any:
    """Return blur radii in lenses of points at given distances: positive before the plane in focus, otherwise negative.

    The radius is that of the cone from the exit pupil to the image.
    """
    with np.errstate(divide="ignore"):
        image = 1 / (1 / camera.focal_length - 1 / np.asarray(distance, np.float64))
    behind = image - camera.mla_distance
    return camera.pupil_radius / camera.row_pitch * behind / (camera.pupil_distance + behind)


@suggest_keywords
def match_halves(halves: xr.DataArray, axis: str = "horizontal", *, window: int = 15, search: int = 16) -> xr.DataArray:
    """Return the disparity from the first to the second picture of a pair for each lens, found by block matching.

    The normalised correlation of a window with windows displaced by whole lenses is highest at the disparity; a
    parabola through the highest value and its neighbours gives fractions of a lens. Medians of textured planes are
    within 0.1 lenses of `half_disparity`, from 0.5 to 3.5, where pupils are round; otherwise calibrate it with captures
    at known distances. Mosaics are refused, as the colours that they alias do not move with the scene.

    Parameters
    ----------
    halves : xarray.DataArray
        Pictures of `dual_pixel`. Of four photodiodes, those along the other axis are added, and of three colours all.
    axis : {"horizontal", "vertical"}
        Whether the pair is left and right, or top and bottom.
    window : int
        Width of the window in lenses, an odd number.
    search : int
        Largest disparity that is tried, in lenses.

    Returns
    -------
    xarray.DataArray
        Dimensions t, s; NaN where the window has no texture, or the correlation is highest at the end of the search.
    """
    require_light_field(halves)
    require_choice("axis", axis, choices.Axis)
    pupil, second_pupil, along = ("u", "v", 1) if axis == "horizontal" else ("v", "u", 0)
    if halves.sizes[pupil] != 2:
        raise InputError(f"halves: {halves.sizes[pupil]} pictures along {pupil}: a pair has two")
    refuse_if(require_count("window", window, minimum=3) % 2 == 0, f"window = {window}: it must be odd")
    search = require_count("search", search, maximum=max(1, halves.sizes["st"[1 - along]] - 2))
    refuse_if(
        halves.attrs.get("mosaic") and "c" not in halves.dims,
        f"halves: they are {halves.attrs.get('mosaic')} mosaics, whose colours alias: demosaic first",
    )
    pair = halves.sum([dim for dim in (second_pupil, "c") if dim in halves.dims]).transpose(pupil, "t", "s")
    # Smoothed with a standard deviation of 1 lens, so that a parabola finds peaks between lenses.
    first, second = gaussian_filter(np.asarray(pair.values, np.float64), (0, 1.0, 1.0), mode="nearest")
    scores = np.stack([_correlation(first, second, step, along, window) for step in range(-search, search + 1)])
    best = scores.argmax(axis=0)
    inner = np.clip(best, 1, 2 * search - 1)
    below, middle, above = (np.take_along_axis(scores, (inner + step)[None], 0)[0] for step in (-1, 0, 1))
    with np.errstate(all="ignore"):
        bend = below + above - 2 * middle
        offset = (below - above) / (2 * bend)
    # Within the search the highest value is above its neighbours, or equal to one of them.
    reliable = (best == inner) & np.isfinite(offset) & (bend < 0)
    # 1.02: Disparity of peaks over that of centroids: 1.01 to 1.03 for half discs 0.5 to 3.5 lenses apart.
    return xr.DataArray(
        np.where(reliable, (inner + offset - search) / 1.02, np.nan),
        dims=("t", "s"),
        coords={dim: halves[dim] for dim in ("t", "s")},
        name="disparity",
        attrs={"units": "lenses"},
    )


def _correlation(first: Array, second: Array, step: int, axis: int, window: int) -> Array:
    """Return the correlation of windows of one picture with windows of another, `step` lenses along an axis."""
    moved = np.roll(second, -step, axis)

    def mean(values: Array) -> Array:
        return uniform_filter(values, window, mode="nearest")

    a = mean(first)
    b = mean(moved)
    squares = mean(first**2), mean(moved**2)
    spread = squares[0] - a * a, squares[1] - b * b
    textured = (spread[0] > _FLAT * squares[0]) & (spread[1] > _FLAT * squares[1])
    product = np.where(textured, spread[0] * spread[1], 1)
    score = np.where(textured, (mean(first * moved) - a * b) / np.sqrt(product), -np.inf)
    # Windows around lenses that were moved in from the other side compare what does not belong together.
    size = score.shape[axis]
    index = np.arange(size) + step
    outside = (index < 0) | (index >= size)
    score[(slice(None), outside) if axis == 1 else (outside, slice(None))] = -np.inf
    return score
