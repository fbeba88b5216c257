"""Volumes of emitters as points, for a `CaptureOperator`."""

from __future__ import annotations

from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np

from ...errors import refuse_if, require_numbers, short_repr, suggest_keywords
from ...runtime import Doubles, as_array


@suggest_keywords
def volume_points(values: Any, lower: Any, upper: Any) -> tuple[Doubles, Doubles]:
    """Return the voxels of a volume of emitters as points with weights.

    Parameters
    ----------
    values : array (planes, rows, columns) or mitsuba.VolumeGrid
        Emission in each voxel, along z, y and x of the camera frame. Of a grid, as Mitsuba's ``gridvolume`` reads it
        from a file, the one channel.
    lower, upper : (float, float, float)
        Opposite corners of the volume in the camera frame: x, y and z (for a microscope the depth).

    Returns
    -------
    points : float64 array (n, 3)
        Centres of the voxels that are not 0.
    weights : float64 array (n,)
        Emission times the volume of a voxel.
    """
    rule = "they must be numbers, (planes, rows, columns)"
    grid = as_array("values", values, ("z", "y", "x"), rule=rule)
    # Mitsuba has its types once a variant is set.
    if mi.variant() and isinstance(values, mi.VolumeGrid) and grid.ndim == 4 and grid.shape[3] == 1:
        grid = grid[..., 0]
    refuse_if(
        grid.ndim != 3 or grid.size == 0 or not np.isfinite(grid).all(),
        f"values of shape {grid.shape}: it must be finite and (planes, rows, columns), of one channel",
    )
    corners = {"lower": lower, "upper": upper}
    three = partial(require_numbers, count=3, form="three numbers (x, y, z)")
    low, high = (np.array(three(name, value)) for name, value in corners.items())
    refuse_if(
        not (low < high).all(),
        f"upper = {short_repr(upper)}: it must be greater than lower = {short_repr(lower)} along each axis",
    )
    size = (high - low) / np.array(grid.shape[::-1])
    lit = np.argwhere(grid != 0)
    return low + (lit[:, ::-1] + 0.5) * size, grid[tuple(lit.T)] * size.prod()
