"""Depth from a light field, by how well the views agree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
import xarray as xr

from ..errors import InputError, require_count, require_number
from ..runtime.jobs import Progress, counted
from ..runtime.limits import require_memory
from .geometry import channel_planes, depth_range, disparity, distance_of, require_light_field, view_steps
from .refocus import shift_and_add, shifted

# Neighbouring bins that share their evidence: standard deviation of the Gaussian window.
_WINDOW = 1.0

# The variance over half of the pupil counts so many times: with half a baseline wrong depths stand out less.
_HALF = 2.0

# Samples that see at least this much of the pupil take part. The others see it nearer to its middle than their
# coordinate says, which would pull depths towards the plane in focus.
_OPEN = 0.9


def depth_map(
    lf: xr.DataArray,
    near: float | None = None,
    far: float | None = None,
    *,
    planes: int = 64,
    progress: Progress | None = None,
) -> xr.Dataset:
    r"""Estimate the depth that every bin of the central view sees.

    For planes evenly spaced in disparity the views are moved so that points of the plane coincide, and the variance
    over the views is taken, averaged over neighbouring bins. Where it is less than half of that, twice the variance
    over the upper, lower, left or right half of the pupil counts instead: next to an occluder's edge, one half of the
    pupil sees past it. The depth is that of the least variance, refined by a parabola through its neighbours.

    The confidence is :math:`1 - V_{min} / V_2`, with V_2 the least variance among planes where the outermost views
    move by a lens or more against the best plane: near 1 where one depth alone makes the views agree, near 0 where
    another does as well (no texture) or none does (gloss).

    Parameters
    ----------
    lf : xarray.DataArray
        A light field of a camera.
    near, far : float
        Range of distances in millimetres to search. Default: `depth_range`, where views differ by at most a lens.
    planes : int
        How many planes, at least 3.
    progress : callable, optional
        Called with the planes done and their number.

    Returns
    -------
    xarray.Dataset
        Over t, s: ``depth`` (distance from the main lens along the axis, mm), ``disparity`` (lenses per view),
        ``confidence`` (0 to 1), and ``image``, the image in focus everywhere; and, where the light field has ground
        truth, ``truth``, the depth that the central view sees (mm), which `depth_error` compares with.

    Raises
    ------
    InputError
        If the light field has no camera, near is not before far, or an argument is out of range.
    """
    lf = require_light_field(lf)
    nearest, farthest = depth_range(lf)
    near = require_number("near", nearest if near is None else near)
    far = require_number("far", farthest if far is None else far, finite=False)
    planes = require_count("planes", planes, minimum=3, maximum=1024)
    if not near < far:
        raise InputError(f"near = {near:g}, far = {far:g}: near must be less than far")
    bins, channels = lf.sizes["t"] * lf.sizes["s"], lf.sizes.get("c", 1)
    # Views are moved in copies; each plane leaves a cost and an image.
    copies, plane = 6.0 * lf.size, 4.0 * bins * (channels + 1)
    require_memory(
        copies + plane * planes,
        f"depth map of {planes} planes",
        lambda limit: f"planes = {int((limit - copies) // plane)}" if limit > copies + 3 * plane else None,
    )
    slopes = np.linspace(disparity(lf, near), disparity(lf, far), planes)
    cost = np.empty((planes, *lf.shape[2:4]), dtype=np.float32)
    image = np.empty((planes, *lf.shape[2:]), dtype=np.float32)
    for index, slope in enumerate(counted(slopes, progress)):
        parts = scipy.ndimage.gaussian_filter(view_variance(lf, slope), (0, _WINDOW, _WINDOW), mode="nearest")
        cost[index] = np.minimum(parts[0], _HALF * parts[1:].min(axis=0))
        image[index] = shift_and_add(lf, slope).values

    best = cost.argmin(axis=0)
    place = best + _vertex(cost, best)
    found = np.interp(place, np.arange(planes), slopes)
    reach = max(np.abs(view_steps(lf, axis)).max() for axis in "vu")
    apart = np.abs(slopes[:, None, None] - found) * reach >= 1
    least, second = cost.min(axis=0), np.where(apart, cost, np.inf).min(axis=0)
    confidence = 1 - np.divide(least, second, out=np.ones_like(least), where=(second > 0) & np.isfinite(second))
    row, column = np.indices(best.shape)
    sharp = image[best, row, column]
    dims = ("t", "s")
    maps: dict[str, Any] = {
        "depth": (dims, distance_of(lf, found), {"units": "mm"}),
        "disparity": (dims, found, {"units": "lenses per view"}),
        "confidence": (dims, confidence),
        "image": (("t", "s", "c")[: sharp.ndim], sharp),
    }
    if "depth" in lf.coords:
        maps["truth"] = (dims, lf.depth.sel(u=0.0, v=0.0, method="nearest").values, {"units": "mm"})
    return xr.Dataset(
        maps,
        coords={dim: lf[dim] for dim in ("t", "s", "c") if dim in lf.coords},
        attrs={**lf.attrs, "near": near, "far": far, "planes": planes},
    )


@dataclass(frozen=True)
class DepthError:
    """How far estimated depths are off, as fractions of the true distance.

    Attributes
    ----------
    median, percentile_90 : float
        Of the bins that are sure; NaN if there is none.
    share : float
        Fraction of the bins with a finite true depth that are sure.
    """

    median: float
    percentile_90: float
    share: float


def depth_error(found: xr.Dataset, confidence: float = 0.5) -> DepthError:
    """Compare the depths of `depth_map` with the truth, where the confidence is above a bound.

    Raises
    ------
    InputError
        If the truth is not known.
    """
    if "truth" not in found:
        raise InputError("depth map: its light field had no ground truth: give it to decode()")
    truth = found.truth.values
    known = np.isfinite(truth)
    sure = known & (found.confidence.values > confidence) & np.isfinite(found.depth.values)
    error = np.abs(found.depth.values[sure] / truth[sure] - 1)
    median, high = np.percentile(error, (50, 90)) if error.size else (np.nan, np.nan)
    return DepthError(float(median), float(high), float(sure.sum() / max(1, known.sum())))


def view_variance(lf: xr.DataArray, slope: float) -> np.ndarray:
    """Variance over the views, moved so that points of one disparity, in lenses per view, coincide.

    Returns
    -------
    (5, t, s) float32 array
        Of the whole pupil and of its upper, lower, left and right half; samples at the pupil's edge left out, mean
        over the channels.
    """
    weight = np.asarray(lf["weight"].values)
    weight = np.where(weight >= _OPEN, weight, 0)
    v, u = view_steps(lf, "v"), view_steps(lf, "u")
    variance = np.zeros((5, *lf.shape[2:4]), dtype=np.float32)
    for plane in channel_planes(lf):
        # Sums of weight, weight x value and weight x value^2 over each quadrant of the pupil.
        sums = np.zeros((2, 2, 3, *lf.shape[2:4]), dtype=np.float64)
        for row, row_weight, down in zip(plane, weight, v, strict=True):
            moved, moved_weight = shifted(row, down * slope, axis=1), shifted(row_weight, down * slope, axis=1)
            for view, view_weight, across in zip(moved, moved_weight, u, strict=True):
                if not view_weight.any():
                    continue
                value, part = shifted(view, across * slope, axis=1), shifted(view_weight, across * slope, axis=1)
                moments = np.stack([part, part * value, part * value * value])
                # A view on a dividing line belongs to both of its sides by half.
                for j, vertical in enumerate(_sides(down)):
                    for i, horizontal in enumerate(_sides(across)):
                        if vertical * horizontal:
                            sums[j, i] += np.float32(vertical * horizontal) * moments
        halves = (sums.sum((0, 1)), *sums.sum(1), *sums.sum(0))
        for index, (count, total, square) in enumerate(halves):
            seen = np.maximum(count, 1e-6)
            variance[index] += np.maximum(square / seen - (total / seen) ** 2, 0)
    return variance / (lf.sizes["c"] if "c" in lf.dims else 1)


def _sides(step: float) -> tuple[float, float]:
    """Return the fraction of a view that lies on the low and on the high side of the pupil's middle."""
    high = float(np.clip(step + 0.5, 0, 1))
    return 1 - high, high


def _vertex(cost: np.ndarray, best: np.ndarray) -> np.ndarray:
    """Place of the least value between samples, by a parabola through the best and its neighbours, -1/2 to 1/2."""
    inner = best.clip(1, len(cost) - 2)
    row, column = np.indices(best.shape)
    before, at, after = (cost[inner + step, row, column].astype(np.float64) for step in (-1, 0, 1))
    bend = before - 2 * at + after
    place = np.divide(before - after, 2 * bend, out=np.zeros_like(bend), where=bend > 0)
    return np.where(inner == best, place.clip(-0.5, 0.5), 0)
