"""How well the views of a light field agree that a bin is at some distance."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import scipy
import xarray as xr

from .geometry import channel_planes, view_steps
from .refocus import shifted

# Neighbouring bins that share their evidence: standard deviation of the Gaussian window.
_WINDOW = 1.0

# The variance over half of the pupil counts so many times: with half a baseline wrong depths stand out less.
_HALF = 2.0

# Fraction of the views that must see a bin: few agree by chance.
_SEEN = 0.25

# Samples that see at least this much of the pupil take part. The others see it nearer to its middle than their
# coordinate says, which would pull depths towards the plane in focus.
_OPEN = 0.9

# Within micro-images, those that see at least half: where a lens images the scene, the rim of the pupil takes light
# from a sample but does not move what it sees.
_HALF_OPEN = 0.5

# Lenses to each side that a lens is compared with, and samples, weighted as the window weighs them, that must be seen
# by both.
_NEIGHBOURS = 2
_FEWEST = 10.0


def view_disagreement(lf: xr.DataArray, slope: float) -> np.ndarray:
    """Return the variance, in each bin, of the views moved so that points of one disparity coincide.

    It is averaged over neighbouring bins. Where it is less than half of that, twice the variance over the upper, lower,
    left or right half of the pupil counts instead: next to an occluder's edge, one half of the pupil sees past it.

    Parameters
    ----------
    lf : xarray.DataArray
        A light field.
    slope : float
        Disparity in lenses per view.

    Returns
    -------
    (t, s) float32 array
        NaN where too few views see a bin, near the border.
    """
    variance, seen = _view_variance(lf, slope)
    parts = scipy.ndimage.gaussian_filter(variance, (0, _WINDOW, _WINDOW), mode="nearest")
    parts[seen < _SEEN] = np.nan
    return np.fmin(parts[0], _HALF * np.fmin.reduce(parts[1:]))


def _view_variance(lf: xr.DataArray, slope: float) -> tuple[np.ndarray, np.ndarray]:
    """Variance over the views, moved so that points of one disparity, in lenses per view, coincide.

    Returns
    -------
    variance : (5, t, s) float32 array
        Of the whole pupil and of its upper, lower, left and right half; samples at the pupil's edge left out, mean
        over the channels.
    seen : array like it
        Samples of it over those of the bin that has most.
    """
    weight = np.asarray(lf["weight"].values)
    weight = np.where(weight >= _OPEN, weight, 0)
    v, u = view_steps(lf, "v"), view_steps(lf, "u")
    variance, fraction = np.zeros((2, 5, *lf.shape[2:4]), dtype=np.float32)
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
            fraction[index] = count / max(float(count.max()), 1e-6)
    return variance / (lf.sizes["c"] if "c" in lf.dims else 1), fraction


def _sides(step: float) -> tuple[float, float]:
    """Return the fraction of a view that lies on the low and on the high side of the pupil's middle."""
    high = float(np.clip(step + 0.5, 0, 1))
    return 1 - high, high


def lens_disagreement(lf: xr.DataArray, slope: float) -> np.ndarray:
    r"""Return the variance between the micro-images of neighbouring lenses, moved so that one disparity coincides.

    For focused cameras. Their micro-images hold detail that is finer than the pitch of the lenses, so that views, of
    one sample a lens, are aliased. What a lens shows at the view u, its k-th neighbour shows at :math:`u + k / \delta`,
    for the disparity :math:`\delta` in lenses per view: samples are interpolated within micro-images, never between
    lenses (Perwass and Wietzke 2012).

    Arguments and result are those of `view_disagreement`; NaN where neighbours see nothing in common.
    """
    opened = (lf["weight"].values >= _HALF_OPEN).astype(np.float32)
    sums = np.zeros((2, *lf.shape[2:4]), dtype=np.float32)
    planes = channel_planes(lf)
    for axis, steps in product((0, 1), range(-_NEIGHBOURS, _NEIGHBOURS + 1)):
        move = steps / slope if steps and slope else math.inf
        if abs(move) > lf.shape[axis] - 2:
            continue
        both, own = _pair(opened, axis, steps, move)
        both = (both > 1 - 1e-3) * own
        target = sums[(slice(None), *_reached(lf.shape[2:4], axis, steps))]
        target[1] += both.sum((0, 1))
        for plane in planes:
            other, own = _pair(plane, axis, steps, move)
            # The difference of two has twice the variance of each.
            target[0] += (np.square(other - own) * both).sum((0, 1)) / (2 * len(planes))
    sums = scipy.ndimage.gaussian_filter(sums, (0, _WINDOW, _WINDOW), mode="nearest")
    return np.where(sums[1] >= _FEWEST, sums[0] / np.maximum(sums[1], 1), np.nan)


def _reached(shape: tuple[int, ...], axis: int, steps: int) -> tuple[slice, slice]:
    """Return the bins whose neighbour so many steps on along an axis is there."""
    across = slice(max(0, -steps), min(shape[axis], shape[axis] - steps))
    return (across, slice(None)) if axis == 0 else (slice(None), across)


def _pair(values: np.ndarray, axis: int, steps: int, move: float) -> tuple[np.ndarray, np.ndarray]:
    """Return samples of the lenses some steps on, `move` views on, interpolated, and those of the lenses themselves.

    Only of the views and lenses that have such a one.
    """
    whole = math.floor(move)
    views = values.shape[axis]
    first, last = max(0, -whole), min(views, views - 1 - whole)
    lenses = _reached(values.shape[2:4], axis, steps)
    down, across = lenses
    if axis == 0:
        on = slice(down.start + steps, down.stop + steps), across
    else:
        on = down, slice(across.start + steps, across.stop + steps)

    def part(start: int, stop: int, of: tuple[slice, slice]) -> np.ndarray:
        along = (slice(start, stop), slice(None)) if axis == 0 else (slice(None), slice(start, stop))
        return values[(*along, *of)]

    fraction = np.float32(move - whole)
    low, high = part(first + whole, last + whole, on), part(first + whole + 1, last + whole + 1, on)
    return low + fraction * (high - low), part(first, last, lenses)
