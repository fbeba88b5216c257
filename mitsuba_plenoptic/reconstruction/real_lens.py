"""Rays from the detector back to object planes through a real main lens, and what it records of a white scene."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..design import crosstalk_neighbours
from ..errors import InputError
from ..lenses.base import MainLens
from ..lenses.factory import main_lens
from ..optics import rays
from ..runtime.backend import array_module
from ..runtime.fft import rows_and_columns

_LANES = 2**22
"""Rays that are followed at once."""

_WHITE_RAYS = 32
"""Rays of a pixel through each lens that can light it."""

_STEPS = (0.8566748838545029, 0.733891856627126, 0.6287067210378087, 0.5385972572236101)
"""Reciprocal powers of the root of x^5 = x + 1: an even sequence in four dimensions (Roberts, 2018)."""


def require_upright(camera: PlenopticCamera) -> None:
    """Refuse a tilted array behind a real main lens.

    Raises
    ------
    InputError
        If there is one.
    """
    if not camera.lens_data.is_thin and any(camera.mla_tilt):
        raise InputError(f"mla_tilt = {camera.mla_tilt}: captures through a main_lens are reconstructed with 0 only")


def traced_places(
    camera: PlenopticCamera, distance: float
) -> Iterator[tuple[slice, NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]]:
    r"""Follow one ray a pixel, through the centre of its lens, back to an object plane.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    distance : float
        Object distance; may be infinite.

    Yields
    ------
    rows : slice
        Of the recorded pixels.
    x, y : float64 array (pixels,)
        Place in the object plane as :math:`-X b / g`, in millimetres: the real lens's distortion is undone by it.
    lit : bool array (pixels,)
        Whether the lens lets the ray, or that from the middle of one of the pixel's edges, through.
    """
    types, lens = array_module(), main_lens(camera)
    half, b = camera.pixel_size / 2, camera.mla_distance
    for rows, px, py in _pixels(camera, types):
        cx, cy = camera.lattice.centre(*_cell(camera, px, py))
        lit = types.Bool(False)
        x, y = types.Float64(0), types.Float64(0)
        for across, down in ((-1, 0), (1, 0), (0, -1), (0, 1), (0, 0)):
            point, slope, is_open = _back(
                camera, lens, (px + across * half, py + down * half), (cx, cy), (cx, cy), None
            )
            lit |= is_open
            x, y = (-b * (p / distance + (1 - point[2] / distance) * t) for p, t in zip(point[:2], slope, strict=True))
        dr.eval(x, y, lit)
        yield rows, x.numpy(), y.numpy(), lit.numpy()


@functools.lru_cache(maxsize=1)
def traced_white(camera: PlenopticCamera) -> NDArray[np.float32]:
    """Return what a camera with a real main lens records of a scene of uniform radiance 1, by rays.

    Every pixel has its own shift of one even set of rays: what few of them miss at the rims of micro-images averages
    out over the pixels of a bin.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.

    Returns
    -------
    (rows, columns) float32 array
    """
    types, lens, lattice, p = array_module(), main_lens(camera), camera.lattice, camera.pixel_size
    image = np.empty(camera.shape, np.float32)
    around = crosstalk_neighbours(camera).tolist()
    several = len(camera.mla_focal_lengths) > 1
    for rows, px, py in _pixels(camera, types):
        i, j = _cell(camera, px, py)
        number = dr.arange(types.UInt32, dr.width(px)) + dr.opaque(types.UInt32, rows.start * camera.crop_size[0])
        shifts = [types.Float64(_scrambled(types, number, axis)) for axis in range(4)]
        total = types.Float64(0)
        for ray in range(_WHITE_RAYS):
            s, t, u, v = (
                shift + dr.opaque(types.Float64, ray * step) for shift, step in zip(shifts, _STEPS, strict=True)
            )
            s, t, u, v = (value - dr.floor(value) for value in (s, t, u, v))
            place = (px + (s - 0.5) * p, py + (t - 0.5) * p)
            dx, dy = lattice.aperture_point(u, v)
            for across, down in around:
                cx, cy = lattice.centre(i + across, j + down)
                f2: Any = camera.mla_focal_length
                if several:
                    kind = types.UInt32(lattice.lens_type(i + across, j + down))
                    f2 = dr.gather(types.Float64, types.Float64(camera.mla_focal_lengths), kind)
                _, _, is_open = _back(camera, lens, place, (cx + dx, cy + dy), (cx, cy), f2)
                total += dr.select(is_open, 1.0, 0.0)
            dr.eval(total)
        image[rows] = (total / _WHITE_RAYS).numpy().reshape(-1, camera.crop_size[0])
    return image


def _pixels(camera: PlenopticCamera, types: Any) -> Iterator[tuple[slice, Any, Any]]:
    """Yield some rows at a time, with x and y of their pixels' centres."""
    rows, columns = camera.shape
    x, y = (types.Float64(camera.pixel_coordinates(axis)) for axis in (0, 1))
    together = max(1, _LANES // columns)
    for first in range(0, rows, together):
        last = min(rows, first + together)
        row, column = rows_and_columns(types, last - first, columns)
        px = dr.gather(types.Float64, x, column)
        py = dr.gather(types.Float64, y, row + dr.opaque(types.UInt32, first))
        yield slice(first, last), px, py


def _cell(camera: PlenopticCamera, px: Any, py: Any) -> tuple[Any, Any]:
    """Return the indices of the lenses whose centres the light of the pupil's middle passes on its way to pixels."""
    b, z = camera.pupil_distance, camera.detector_distance
    i, j = camera.lattice.cell(rays.chief_point(px, b, z), rays.chief_point(py, b, z))
    return i, j


def _back(
    camera: PlenopticCamera, lens: MainLens, place: tuple[Any, Any], through: tuple[Any, Any], centre: Any, f2: Any
) -> Any:
    """Follow rays from the detector through points of lenses to the scene; through their centres if f2 is None."""
    z = camera.detector_distance
    slope = [
        (m - p) / z if f2 is None else rays.microlens_slope(p, m, c, z, f2)
        for p, m, c in zip(place, through, centre, strict=True)
    ]
    return lens.trace(through, (slope[0], slope[1]))


def _scrambled(types: Any, number: Any, axis: int) -> Any:
    """Return evenly scattered numbers from 0 to 1 for consecutive ones: a hash of their bits (Wellons, 2018)."""
    x = types.UInt32(number) * 4 + axis
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        x = (x ^ (x >> shift)) * types.UInt32(factor)
    return types.Float64(x ^ (x >> 16)) * (1 / 2**32)
