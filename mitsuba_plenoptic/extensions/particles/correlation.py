r"""Displacements between two volumes by cross-correlation of windows (Elsinga et al. 2006; Scarano 2013).

Each window of the first volume is correlated with the second one, its displacement is the peak, refined by the normal
curve through three values along each axis (Willert and Gharib 1991, Experiments in Fluids 10, 181). Vectors unlike
their neighbours are found by the normalised median test (Westerweel and Scarano 2005, Experiments in Fluids 39, 1096)
and replaced by the neighbours' median. The test is also made after the neighbours' gradient is taken off: at a border,
where they lie on one side, it would count as a difference. Later passes displace the second volume's window by the
result before.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import scipy.signal
import xarray as xr
from numpy.lib.stride_tricks import sliding_window_view

from ...errors import refuse_if, require_count, require_number, require_numbers, suggest_keywords, warn
from ...runtime import Doubles, Integers, Progress, counted
from .voxels import values_of


@suggest_keywords
def correlate_volumes(
    first: xr.DataArray,
    second: xr.DataArray,
    *,
    window: Sequence[int],
    overlap: float = 0.5,
    passes: int = 2,
    progress: Progress | None = None,
) -> xr.Dataset:
    """Return the displacements of windows from one volume to the next.

    Parameters
    ----------
    first, second : xarray.DataArray (z, y, x)
        The volumes, on the same grid.
    window : (int, int, int)
        Voxels of a window along z, y and x; a warning tells where displacements are beyond three quarters of it.
    overlap : float
        Part of a window that it shares with the next one, from 0 to 0.9.
    passes : int
        Number of passes, each from the displacements of the one before.
    progress : callable, optional
        Called with the numbers of windows done and of all.

    Returns
    -------
    xarray.Dataset
        ``displacement`` (z, y, x, axis) in mm, at the centres of windows; ``outlier``, 1 where it was replaced by
        what its neighbours expect, as those of empty windows are, and NaN if these are empty, too; ``correlation``, the
        correlation coefficient of the windows then.
    """
    before, after = values_of(first, second)
    size = np.array([require_count("window", n, minimum=4) for n in require_numbers("window", window, count=3)])
    overlap = require_number("overlap", overlap, minimum=0, maximum=0.9)
    passes = require_count("passes", passes, maximum=10)
    refuse_if((size > before.shape).any(), f"window = {tuple(size.tolist())}: the volumes have {before.shape} voxels")
    for name, values in (("first", before), ("second", after)):
        refuse_if(not values.any(), f"{name}: the volume is empty")
    step = tuple(np.maximum(1, np.rint(size * (1 - overlap))).astype(int).tolist())
    every = tuple(slice(None, None, by) for by in step)
    windows = sliding_window_view(before, size)[every]
    counts = windows.shape[:3]
    others = sliding_window_view(after, size)
    starts = np.moveaxis(np.indices(counts), 0, -1) * step
    displacement = np.zeros((*counts, 3))
    best = np.zeros(counts)
    outlier = np.zeros(counts, bool)
    indices = iter(counted([*np.ndindex(counts)] * passes, progress))
    for _ in range(passes):
        guess = np.rint(np.nan_to_num(displacement)).astype(int)
        moved = np.clip(starts + guess, 0, np.array(others.shape[:3]) - 1)
        for index in itertools.islice(indices, best.size):
            shift, best[index] = _displacement(windows[index], others[tuple(moved[index])])
            displacement[index] = moved[index] - starts[index] + shift
        # Which vectors (z, y, x, axis), in voxels, differ from what their neighbours expect. By Westerweel and Scarano
        # (2005), both as the neighbours are and less their gradient, which few neighbours at a corner tell less well.
        # Vectors that are NaN do, too; what has no neighbours differs from none.
        expected = [_expected(displacement, linear) for linear in (False, True)]
        apart = [np.linalg.norm((displacement - middle) / typical, axis=-1) for middle, typical in expected]
        # An outlier has more than twice the residual of its neighbours.
        outlier = ~(np.minimum(*apart) <= 2.0)
        displacement = np.where(outlier[..., None], expected[1][0], displacement)
    # Empty windows apart, of random vectors two thirds are outliers, of right ones a sixth at most.
    unlike = outlier[best != 0].mean() if best.any() else 0.0
    if unlike > 0.3:
        warn(
            f"window = {tuple(size.tolist())}: {unlike:.0%} of the vectors are outliers, and others are likely wrong: "
            "particles move by more than three quarters of a window, or both volumes have few of the same"
        )
    axes = [first[axis].values for axis in "zyx"]
    voxel = np.array([axis[1] - axis[0] for axis in axes])
    centres = [sliding_window_view(axis, n)[some].mean(1) for axis, n, some in zip(axes, size, every, strict=True)]
    return xr.Dataset(
        {
            "displacement": (("z", "y", "x", "axis"), (displacement * voxel)[..., ::-1], {"units": "mm"}),
            "outlier": (("z", "y", "x"), outlier.astype(np.int8)),
            "correlation": (("z", "y", "x"), best),
        },
        coords={**dict(zip("zyx", centres, strict=True)), "axis": list("xyz")},
    )


def _displacement(before: Doubles, after: Doubles) -> tuple[Doubles, float]:
    """Return the displacement in voxels of one window's content in the other, and their correlation coefficient.

    If a window is empty, they are NaN and 0.
    """
    size = np.array(before.shape)
    a = before - before.mean()
    b = after - after.mean()
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    if not norm:
        return np.full(3, np.nan), 0.0
    # 0.25: Overlap of the windows, over their size, below which a displacement is not looked for.
    reach = ((1 - 0.25) * size).astype(int)
    searched = tuple(slice(n - 1 - most, n + most) for n, most in zip(size, reach, strict=True))
    products = scipy.signal.correlate(b, a, method="fft")[searched]
    peak = np.array(np.unravel_index(int(products.argmax()), products.shape))
    coefficient = float(products[tuple(peak)]) / norm
    # Fewer voxels meet at a displacement, which draws the peak towards 0.
    meeting = np.ix_(*(1 - np.abs(np.arange(-most, most + 1)) / n for n, most in zip(size, reach, strict=True)))
    products = products / math.prod(meeting)
    return peak - reach + [_beside(products, peak, axis) for axis in range(3)], coefficient


def _beside(products: Doubles, peak: Integers, axis: int) -> float:
    """Return the distance of a peak from its voxel along an axis, of the normal curve through three values."""
    at = peak[axis]
    line = np.moveaxis(products, axis, -1)[tuple(np.delete(peak, axis))][max(at - 1, 0) : at + 2]
    if len(line) < 3:
        return 0.0
    low, middle, high = np.log(line) if (line > 0).all() else line
    bent = low - 2 * middle + high
    # The peak is that before the correction for how many voxels meet, and can move to the next voxel by it.
    return float(np.clip(0.5 * (low - high) / bent, -1, 1)) if bent < 0 else 0.0


def _expected(vectors: Doubles, linear: bool) -> tuple[Doubles, Doubles]:
    """Return the median of the up to 26 neighbours of vectors (z, y, x, axis), in voxels, and by how much they differ.

    The neighbours are less their gradient if `linear`. A vector without neighbours is as expected.
    """
    padded = np.pad(vectors, [(1, 1)] * 3 + [(0, 0)], constant_values=np.nan)
    around = sliding_window_view(padded, (3, 3, 3), (0, 1, 2)).copy()
    around[..., 1, 1, 1] = np.nan
    for axis in (-3, -2, -1) if linear else ():
        steps = np.expand_dims(np.arange(-1, 2), [i for i in (-3, -2, -1) if i != axis])
        around -= _median(np.diff(around, axis=axis)) * steps
    middle = _median(around)
    # A tenth of a voxel is noise.
    typical = _median(np.abs(around - middle))[..., 0, 0, 0] + 0.1
    alone = np.isnan(around).all((-3, -2, -1))
    return np.where(alone, vectors, middle[..., 0, 0, 0]), typical


def _median(values: Doubles) -> Doubles:
    """Return the median over the last three axes, which stay; 0 where all values are NaN."""
    last = (-3, -2, -1)
    return np.nanmedian(np.where(np.isnan(values).all(last, keepdims=True), 0, values), axis=last, keepdims=True)
