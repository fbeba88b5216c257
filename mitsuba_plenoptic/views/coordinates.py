"""The axes of a light field, and the displacement of a point from view to view by its distance.

A light field is an `xarray.DataArray` with the dimensions ``v, u, t, s`` (and ``c`` where it has colour):

- ``u, v``: where the ray crosses the main lens's pupil, in millimetres, ``u`` along x and ``v`` along y;
- ``s, t``: where it crosses the object plane that is in focus, in millimetres, ``s`` along x and ``t`` along y.

x and y are those of the camera frame, +x to the left and +y up. All four coordinates therefore *fall* with the
index: index 0 is the left or the top, so that every view, mosaic and epipolar image is upright when printed as it
is stored, and the first view is the one from the upper left of the pupil.

Of a Fourier microscope u and v are positions on the stop along the columns and rows of the array, s and t in the native
object plane, and ``slope_x`` and ``slope_y``, over v and u, say from where a view sees the object.

A light field without a camera (from a file of another program, say) has coordinates in samples instead, centred
on zero and rising with the index.
"""

import json
import math
from dataclasses import asdict
from typing import Any

import numpy as np
import xarray as xr

from ..camera import PlenopticCamera
from ..design import objective_of
from ..errors import InputError, advice, refuse_if, refusing, require_number, require_wavelength, short_repr
from ..optics import rays
from ..prescription import image_distance
from ..runtime import MILLIMETRES, Array, Named, Pair, require_pixels, require_units
from .grid import LensGrid

DIMS = ("v", "u", "t", "s")


def light_field(
    values: Array,
    weight: Array | None = None,
    camera: PlenopticCamera | None = None,
    bins: LensGrid | None = None,
    lenses: LensGrid | None = None,
    white: Array | None = None,
) -> xr.DataArray:
    """Return sampled values as a labelled light field.

    Parameters
    ----------
    values : (v, u, t, s[, 3]) float32 array
        Radiance; 0 where `weight` is 0.
    weight : (v, u, t, s) float32 array, optional
        Fraction of the sample that sees through the pupil, 0 to 1. Default: 0 in views that are black throughout, as
        those beyond the pupil are, and 1 in the others.
    camera : PlenopticCamera, optional
        The camera, for physical coordinates.
    bins : LensGrid, optional
        Upright grid of the bins on the detector; needed with a camera.
    lenses : LensGrid, optional
        Grid of the micro-images from which the light field was decoded.
    white : (v, u, t, s) float32 array, optional
        What the sample reads of an even radiance of 1, by which it was divided: how bright its lens is and how much of
        the pupil it sees. Above 1 where lenses are brighter than near the axis. Default: `weight`.

    Returns
    -------
    xarray.DataArray
        With the coordinates `weight` and `white`, and in `attrs` the camera under ``camera`` and the grid of the
        micro-images under ``grid``, as JSON texts that every file format keeps; without them where they are unknown.
        `camera_of` and `grid_of` read them.
    """
    require_pixels("light field", values)
    if weight is None:
        lit = values.any(axis=tuple(range(2, values.ndim)), keepdims=True)
        weight = np.broadcast_to(lit.reshape(*lit.shape[:4]), values.shape[:4]).astype(np.float32)
    # Written so that NaN is refused.
    refuse_if(weight.size and not (weight.min() >= 0 and weight.max() <= 1), "light field: a weight is not from 0 to 1")
    white = weight if white is None else white
    refuse_if(white.size and not 0 <= white.min() <= white.max() < math.inf, "light field: a white is not 0 or more")
    coordinates: Named = {"weight": (DIMS, weight), "white": (DIMS, white)}
    for axis, (angular, spatial) in enumerate((("u", "s"), ("v", "t"))):
        views = values.shape[DIMS.index(angular)]
        size = values.shape[DIMS.index(spatial)]
        steps = np.arange(views) - (views - 1) / 2
        if camera is None or bins is None:
            coordinates[angular] = (angular, steps, {"units": "views"})
            coordinates[spatial] = (spatial, np.arange(size) - (size - 1) / 2, {"units": "lenses"})
            continue
        coordinates[angular] = (
            angular,
            pupil_places(camera, views),
            {"units": "mm", "long_name": f"{'xy'[axis]} on the pupil"},
        )
        places = lens_places(camera, bins, axis) / array_scale(camera)
        distance = camera.focus_distance
        if 0 < distance < math.inf:
            units = "mm"
            name = f"{'xy'[axis]} in the object plane at {distance:.6g} mm"
        else:
            units = "1"
            name = f"slope in {'xy'[axis]}; no real plane is in focus"
        coordinates[spatial] = (spatial, places, {"units": units, "long_name": name})
    attributes = {}
    if camera is not None:
        attributes["camera"] = json.dumps(camera.to_dict())
    if lenses is not None:
        attributes["grid"] = json.dumps(asdict(lenses))
    return labelled(values, coordinates, attributes)


def labelled(values: Array, coordinates: Named, attributes: dict[str, str]) -> xr.DataArray:
    """Return radiance (v, u, t, s[, 3]) as an array with coordinates and attributes."""
    colours = {"c": ("c", ["R", "G", "B"])} if values.ndim == 5 else {}
    dims = (*DIMS, *colours)
    return xr.DataArray(values, dims=dims, coords=coordinates | colours, name="radiance", attrs=attributes)


def pupil_places(camera: PlenopticCamera, views: int) -> Array:
    """Return the coordinates in mm, on the pupil, of `count` views along x or y."""
    # A pixel one step to the right of its micro-image's centre looks one step to the left on the pupil axis.
    return -(np.arange(views) - (views - 1) / 2) * camera.pupil_step


def array_scale(camera: PlenopticCamera) -> float:
    """Return the factor from coordinates of a light field along ``s`` or ``t`` to places in mm on the array."""
    distance = camera.focus_distance
    return -camera.mla_distance / (distance if 0 < distance < math.inf else 1.0)


def lens_places(camera: PlenopticCamera, bins: LensGrid, axis: int) -> Array:
    """Return the coordinates in mm, on the array, of an upright grid's bins along x (axis 0) or y (axis 1)."""
    pixel = bins.offset[axis] + bins.spacing[axis] * np.arange(bins.shape[1 - axis]) + camera.crop_offset[axis]
    p = (pixel - camera.resolution[axis] / 2) * camera.pixel_size
    return rays.chief_point(camera, p)


def camera_of(lf: xr.DataArray | xr.Dataset) -> PlenopticCamera:
    """Return the camera of a light field.

    Parameters
    ----------
    lf : xarray.DataArray
        A light field, (v, u, t, s[, c]).
    """
    if not lf.attrs.get("camera"):
        instead = advice(
            python="disparities serve: shift_and_add, focal_stack(by='disparity') and depth_map take them",
            shell="'stack' takes --disparity, and 'depth' finds disparities; or use a capture",
        )
        raise InputError(f"light field: it has no camera, so distances in millimetres mean nothing; {instead}")
    return PlenopticCamera.from_dict(_record(lf, "camera"))


def grid_of(lf: xr.DataArray) -> LensGrid | None:
    """Return the grid of micro-images from which a light field was decoded, None if unknown."""
    return LensGrid(**_record(lf, "grid")) if lf.attrs.get("grid") else None


def wavelength_of(lf: xr.DataArray | xr.Dataset) -> float | None:
    """Return the wavelength in nanometres at which a light field's lenses diffract, None for one by rays."""
    return require_wavelength(json.loads(lf.attrs["wavelength"])) if lf.attrs.get("wavelength") else None


def stated_disparities(lf: xr.DataArray) -> Pair | None:
    """Return the least and the greatest disparity of the scene, where the file of a light field states them."""
    if not lf.attrs.get("disparities"):
        return None
    stated = _record(lf, "disparities")
    least, greatest = (require_number(f"disparities: {end}", stated.get(end)) for end in ("least", "greatest"))
    return least, greatest


def _record(lf: xr.DataArray | xr.Dataset, name: str) -> Named:
    """Return the content of a JSON attribute of a light field."""
    with refusing(
        f"light field: its attribute {name} = {short_repr(lf.attrs[name])} is no JSON:", TypeError, ValueError
    ):
        return dict(json.loads(lf.attrs[name]))


def require_light_field(lf: Any) -> xr.DataArray:
    """Return a light field after a check of its type and dimensions."""
    refuse_if(
        not isinstance(lf, xr.DataArray),
        f"light field of type {type(lf).__name__}: it must be an xarray.DataArray, as decode() gives",
    )
    refuse_if(
        lf.dims[:4] != DIMS or lf.dims[4:] not in ((), ("c",)) or "weight" not in lf.coords,
        f"light field with dimensions {lf.dims}: they must be v, u, t, s[, c], with a coordinate weight",
    )
    refuse_if(lf.dtype.kind not in "fiu", f"light field of type {lf.dtype}: it must hold real numbers")
    require_pixels("light field", lf.values)
    if lf.attrs.get("camera"):
        require_units("light field", lf, dict.fromkeys("uvst", (*MILLIMETRES, "1")))
    return lf


def view_steps(lf: xr.DataArray, axis: str) -> Array:
    """Return the position of each view along ``u`` or ``v`` in views from the pupil's centre, rising with the index."""
    coordinate = np.asarray(lf[axis].values, dtype=np.float64)
    return -coordinate / _camera_behind_a_lens(lf).pupil_step if lf.attrs.get("camera") else coordinate


def view_places(lf: xr.DataArray) -> Array:
    """Return the positions (2, v, u) of views, along u and along v, by which points move; as `view_steps`, of any grid.

    Points in the views of a Fourier microscope move by slopes in the object, over that of a lens one pitch aside.
    """
    if "slope_x" not in lf.coords:
        return np.stack(np.meshgrid(view_steps(lf, "u"), view_steps(lf, "v")))
    return np.stack([lf["slope_x"].values, lf["slope_y"].values]) / _first_slope(camera_of(lf))


def has_lens(lf: xr.DataArray | xr.Dataset) -> bool:
    """Return whether a light field's distances are known, and from a lens: errors are then relative to them."""
    return bool(lf.attrs.get("camera")) and camera_of(lf).lens_data.converges


def _first_slope(camera: PlenopticCamera) -> float:
    """Return the slope in the object of a small angle, M D2 / n f_F, by which a lens one pitch aside sees it."""
    lens = objective_of(camera)
    return float(lens.magnification * camera.row_pitch / (lens.last_focal_length * lens.immersion))


def _camera_behind_a_lens(lf: xr.DataArray | xr.Dataset) -> PlenopticCamera:
    """Return a light field's camera, at its wavelength; refuse one whose points move unevenly from view to view."""
    camera = camera_of(lf)
    camera.require_lens("an even parallax between views")
    wavelength = wavelength_of(lf)
    return camera if wavelength is None else camera.at_wavelength(wavelength)


def channel_planes(lf: xr.DataArray) -> list[Array]:
    """Return the values (v, u, t, s) of each channel."""
    values = lf.values
    return [values] if values.ndim == 4 else list(np.moveaxis(values, 4, 0))


def disparity(lf: xr.DataArray | xr.Dataset, distance: float) -> float:
    r"""Return the shift of a point from one view to the next, in pixels of views (lenses) along the index.

    A scene point at distance g appears in the view from pupil point P at the lens c = u + P s(g), with u its image
    through the pupil's centre and :math:`s = 1 + b/g - b/f_1`. Neighbouring views are
    :math:`\Delta P = -\Delta p\, b/z` apart, so the point moves by :math:`\delta = -s\, \Delta p\, b / (z D_2)`: zero
    in focus, negative (against the view) for nearer points.

    In the Fourier arrangement a point at the depth d is displaced by :math:`-d \tan\theta`: by as many pixels from
    the axis to a lens whose :math:`\tan\theta` is that of a small angle one pitch off the axis.

    Parameters
    ----------
    lf : xarray.DataArray or xarray.Dataset
        A light field with a camera, or the depth map of one.
    distance : float
        Object distance from the main lens, or depth beyond an objective's native object plane, in millimetres.
    """
    camera = camera_of(lf)
    distance = require_number("distance", distance, finite=False)
    if camera.lens_data.images_stop:
        camera.lens_data.require_distance(camera, distance)
        return distance * _first_slope(camera) / camera.bin_size(distance)
    camera = _camera_behind_a_lens(lf)
    image_distance(camera.focal_length, distance)
    return -camera.defocus(distance) * camera.pupil_step / camera.row_pitch


def distance_of(lf: xr.DataArray | xr.Dataset, disparity: Any) -> Any:
    """Return the distance in mm for a disparity, the inverse of `disparity`; infinity where there is none.

    Parameters
    ----------
    lf : xarray.DataArray or xarray.Dataset
        A light field with a camera, or the depth map of one.
    disparity : float or array
        Pixels per view.

    Returns
    -------
    float64 array of the same shape
    """
    camera = camera_of(lf)
    if camera.lens_data.images_stop:
        return np.asarray(disparity, dtype=np.float64) * camera.bin_size(0) / _first_slope(camera)
    camera = _camera_behind_a_lens(lf)
    s = -np.asarray(disparity, dtype=np.float64) * camera.row_pitch / camera.pupil_step
    power = s - 1 + camera.mla_distance / camera.focal_length
    with np.errstate(divide="ignore"):
        return np.where(power > 0, camera.mla_distance / power, np.inf)
