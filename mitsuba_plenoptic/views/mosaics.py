"""Mosaics of light fields as pictures, with the samples of each lens, or of each view, together."""

import re
from pathlib import Path

import numpy as np
import xarray as xr

from ..errors import refuse_if, require_choice, require_count, warn
from ..io import StoredPicture, read_picture, write_picture
from ..runtime import Array
from .coordinates import light_field, require_light_field
from .viewpoints import lens_mosaic, view_mosaic

LAYOUTS = ("lenses", "views")


def write_mosaic(path: str | Path, lf: xr.DataArray, *, layout: str = "lenses") -> None:
    """Write a light field as a 16-bit PNG mosaic, with its largest value as white.

    Parameters
    ----------
    path : path
        File to write.
    lf : xarray.DataArray
        A light field. Its coordinates and weights are lost; samples without weight are black. The file states the
        number of views.
    layout : {"lenses", "views"}
        Whether the samples of a lens or of a view lie together.
    """
    require_choice("layout", layout, LAYOUTS)
    lf = require_light_field(lf)
    warn_of_dark(path, lf.values)
    peak = float(np.max(lf.values, initial=0)) or 1.0
    mosaic = lens_mosaic(lf) if layout == "lenses" else view_mosaic(lf)
    write_picture(path, mosaic / peak, f"{lf.sizes['u']} {layout}" if lf.sizes["u"] == lf.sizes["v"] else "")


def warn_of_dark(path: str | Path, values: Array) -> None:
    """Warn of samples below 0, as noise leaves them, which files of integers cannot hold."""
    if count := np.count_nonzero(values < 0):
        warn(f"{path}: {count} of {values.size} samples are below 0, which integers hold as 0; .nc keeps them")


def stated_mosaic(picture: StoredPicture) -> tuple[int, str] | None:
    """Return the views along each axis and the layout that a file of `write_mosaic` states, None if it states none."""
    match = re.fullmatch(rf'"([0-9]{{1,6}}) ({"|".join(LAYOUTS)})"', picture.text)
    return match and (int(match[1]), match[2])


def read_mosaic(path: str | Path, views: int, *, layout: str = "lenses", linear: bool = False) -> xr.DataArray:
    """Read a light field from a PNG mosaic.

    Parameters
    ----------
    path : path
        File to read.
    views : int
        Views along each axis; 14 in files of Lytro's programs.
    layout : {"lenses", "views"}
        Whether the samples of a lens or of a view lie together.
    linear : bool
        Whether the values are proportional to light, instead of encoded in sRGB.

    Returns
    -------
    xarray.DataArray
        A light field without a camera, values from 0 to 1.
    """
    require_choice("layout", layout, LAYOUTS)
    image = read_picture(path, linear=linear)
    views = require_count("views", views, maximum=min(image.shape[:2]))
    rows, columns = image.shape[:2]
    refuse_if(
        rows % views or columns % views,
        f"{path}: {columns} x {rows} pixels are not a whole number of {views} x {views} views",
    )
    channels = image.shape[2:]
    if layout == "lenses":
        values = image.reshape(rows // views, views, columns // views, views, *channels)
        values = values.transpose(1, 3, 0, 2, *range(4, values.ndim))
    else:
        values = image.reshape(views, rows // views, views, columns // views, *channels).swapaxes(1, 2)
    return light_field(np.ascontiguousarray(values))
