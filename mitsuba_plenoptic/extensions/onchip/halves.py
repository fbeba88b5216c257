"""Pictures that the photodiodes of an on-chip-lens camera record, one picture for each photodiode of a lens."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from ...detector import filters
from ...errors import InputError, refuse_if, require_pair, short_repr, suggest_keywords
from ...io import Capture, mosaic_of
from ...runtime import Array
from ...views import light_field
from .photodiode_response import ACROSS, require_pixel_pairs

LAYOUTS = ((2, 1), (1, 2), (2, 2))
"""Photodiodes of a lens along x and along y: left and right, top and bottom, or four."""


@suggest_keywords
def dual_pixel(capture: Capture, layout: tuple[int, int] = (2, 1)) -> xr.DataArray:
    """Sum the pixels of each photodiode of a capture with 2 x 2 pixels a lens.

    The left half of the pupil, as seen from behind the camera, lights the left photodiode and makes the left picture:
    as in a pair of stereo pictures, objects nearer than the plane in focus lie further to the right in the left
    picture. Pictures are in units of the capture times pixels, so that their sum over all photodiodes is the sum of the
    pixels of each lens, and no light is lost.

    A capture through a quad Bayer mosaic gives pictures that are Bayer mosaics, whose name is the attribute ``mosaic``.

    Parameters
    ----------
    capture : Capture
        A capture, rendered or exposed, whose microlenses are upright squares of 2 x 2 pixels. A photodiode of two
        pixels has the noise of both.
    layout : {(2, 1), (1, 2), (2, 2)}
        Photodiodes of a lens along x and along y.

    Returns
    -------
    xarray.DataArray
        A light field (v, u, t, s[, c]) with a view for each photodiode and a sample for each lens, upright, whose
        coordinates are in photodiodes and lenses: ``left, right = halves[0]`` for the first layout, ``top, bottom =
        halves[:, 0]`` for the second. ``halves.sum(("v", "u"))`` is the picture of the whole lenses.
    """
    if not isinstance(capture, Capture):
        raise InputError(f"dual_pixel({short_repr(capture)}): it takes a Capture")
    along, across = require_layout(layout)
    require_pixel_pairs(capture.camera)
    halves = light_field(photodiodes(np.asarray(capture.image), along, across))
    mosaic = mosaic_of(capture)
    if mosaic is None:
        return halves
    # The Bayer mosaic of lenses whose pixels have one colour each; others are refused.
    colours = filters(capture.camera, mosaic)
    lenses = colours[::ACROSS, ::ACROSS]
    refuse_if(
        (np.repeat(np.repeat(lenses, ACROSS, 0), ACROSS, 1) != colours).any(),
        f"mosaic = {mosaic}: the pixels of a lens have several colours; expose with a quad Bayer mosaic, on a detector "
        "whose resolution is a multiple of 4",
    )
    corner = ["RGB"[lenses[j % lenses.shape[0], i % lenses.shape[1]]] for j in (0, 1) for i in (0, 1)]
    return halves.assign_attrs(mosaic="".join(corner))


def photodiodes(image: Array, along: int, across: int) -> Array:
    """Return the sums over each photodiode, (across, along, lenses, lenses[, 3]), of pixels (rows, columns[, 3])."""
    rows, columns = (count // ACROSS for count in image.shape[:2])
    parts = image.reshape(rows, across, ACROSS // across, columns, along, ACROSS // along, *image.shape[2:])
    return np.ascontiguousarray(np.moveaxis(parts.sum(axis=(2, 5)), (1, 3), (0, 1)))


def photodiode_names(halves: xr.DataArray) -> Array:
    """Return the name of each picture, (v, u): left or right, top or bottom, or both words."""
    down = ("top", "bottom") if halves.sizes["v"] == ACROSS else ("",)
    across = ("left", "right") if halves.sizes["u"] == ACROSS else ("",)
    return np.array([["_".join(filter(None, (row, column))) for column in across] for row in down])


def require_layout(layout: Any) -> tuple[int, int]:
    """Return the count of photodiodes along x and along y."""
    pair = require_pair("layout", layout, "(photodiodes along x, along y)")
    refuse_if(pair not in LAYOUTS, f"layout = {short_repr(layout)}: it must be one of {', '.join(map(str, LAYOUTS))}")
    return pair
