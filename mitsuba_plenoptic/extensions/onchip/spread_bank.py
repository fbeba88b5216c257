"""Banks of point spreads in the picture of each photodiode, for points at given depths and field positions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from ... import choices
from ...camera import PlenopticCamera, Use, require_support
from ...detector import SHARP, DetectorOperator
from ...errors import refuse_if, require_choice, require_count, require_number, require_wavelength, suggest_keywords
from ...fields import OpticalSystem
from ...lenses import main_lens
from ...points import footprint, point_spread_function
from ...runtime import POINTS, Doubles, Pair, as_array
from ..inverse.point_rays import PointRays
from .halves import photodiodes, require_layout
from .photodiode_response import ACROSS, require_pixel_pairs


@suggest_keywords
def psf_bank(
    camera: PlenopticCamera,
    depths: Sequence[float],
    fields: Any = ((0.0, 0.0),),
    *,
    layout: tuple[int, int] = (2, 1),
    model: str = "ray",
    wavelength: float = 550.0,
    method: str = "patch",
    size: int | None = None,
) -> xr.DataArray:
    """Return the point spreads of each photodiode over depth and field.

    Lenses around a position count as aligned to its chief ray: spreads are off (L2) by half of the part of a pixel by
    which their shifts differ, 0.1 to 0.4 % where `mla_cra` follows the chief rays.

    Parameters
    ----------
    camera : PlenopticCamera
        A camera of 2 x 2 pixels a lens.
    depths : sequence of float
        Object distances from the main lens in millimetres; may be infinite.
    fields : array (n, 2)
        Positions x and y on the detector in millimetres. Each is moved to the middle of the nearest lens's pixels, and
        points are where the chief ray through this lens comes from. Default: the lens next to the axis.
    layout : {(2, 1), (1, 2), (2, 2)}
        Photodiodes of a lens along x and along y.
    model : {"ray", "wave"}
        Model of the light in the camera.
    wavelength : float
        Wavelength in nanometres.
    method : {"patch", "full_field"}
        For waves: as for `point_spread_function`.
    size : int, optional
        Lenses across a spread, an odd number, of which the middle one receives the chief ray. Default: the largest
        blur with the aberrations of `lens_model`, for waves three dark rings of diffraction, and some lenses around.

    Returns
    -------
    xarray.DataArray
        Dimensions depth, field, v, u, t, s; float32. A spread sums over v, u, t and s to the fraction of the light
        through the pupil that falls within its lenses. `bank_disparity` returns the distances of halves, and
        ``torch.from_numpy(bank.values)`` makes the bank a tensor.
    """
    along, across = require_layout(layout)
    require_pixel_pairs(camera)
    require_support(camera, Use.SPREAD_BANKS)
    require_choice("model", model, choices.MODELS)
    wavelength = require_wavelength(wavelength)
    distances = [require_number("depths", depth, positive=True, finite=False) for depth in depths]
    refuse_if(not distances, "depths: there is none")
    positions = as_array("fields", fields, POINTS, shape=(None, 2))
    if size is None:
        reach = _reach(camera, distances, positions, wavelength)
        if model == "wave":
            # 1.619: Radius of the third dark ring of an Airy pattern, in wavelengths times distance over the pupil's
            # radius. Within are 94 % of the light.
            reach += 1.619 * wavelength * 1e-6 * camera.mla_distance / camera.aperture_radius
        # 4: Lenses around the largest blur.
        count = 2 * math.ceil(reach / camera.row_pitch - 1e-9) + 4 + 1
    else:
        count = require_count("size", size)
    refuse_if(count % 2 == 0, f"size = {count}: it must be odd")
    bank = np.empty((len(distances), len(positions), across, along, count, count), np.float32)
    computed = np.empty_like(positions)
    whole = camera.replace(crop_offset=(0, 0), crop_size=camera.resolution)
    detector = DetectorOperator.of(whole)
    for point_index, position in enumerate(positions):
        local, computed[point_index], chief = _around(camera, position, count)
        window = np.ix_(*(np.arange(ACROSS * count) + start for start in reversed(local.crop_offset)))
        system = OpticalSystem(local, wavelength)
        for index, point in enumerate(_points(local, chief, distances)):
            # Light strays over the whole detector, also from these lenses to others.
            light = np.zeros(whole.shape, np.float32)
            if model == "wave":
                light[window] = point_spread_function(local, point, wavelength=wavelength, method=method)
            else:
                light[window] = PointRays(local, point[None], wavelength).image(system, np.ones(1))
            bank[index, point_index] = photodiodes(detector.forward(light)[window], along, across)
    steps = np.arange(count) - count // 2
    coordinates = {
        "depth": ("depth", distances, {"units": "mm"}),
        "x": ("field", computed[:, 0], {"units": "mm", "long_name": "x on the detector"}),
        "y": ("field", computed[:, 1], {"units": "mm", "long_name": "y on the detector"}),
        "t": ("t", steps, {"units": "lenses"}),
        "s": ("s", steps, {"units": "lenses"}),
    }
    return xr.DataArray(bank, dims=("depth", "field", "v", "u", "t", "s"), coords=coordinates, name="point spread")


def _points(camera: PlenopticCamera, chief: Pair, distances: Sequence[float]) -> Doubles:
    """Return the points (n, 3) at given distances whose chief rays meet the array at one position."""
    start, slope, _ = main_lens(camera).ray((0.0, 0.0), chief)
    # 1e12: Millimetres, as good as infinity.
    z = np.minimum(distances, 1e12)
    return np.stack([*(float(start[i]) + (z - float(start[2])) * float(slope[i]) for i in (0, 1)), z], -1)


def _reach(camera: PlenopticCamera, distances: Sequence[float], positions: Doubles, wavelength: float) -> float:
    """Return the largest distance in mm, on the array, between a point's rays and its chief ray at some positions."""
    camera = camera.replace(mla_cra=())
    lens = OpticalSystem(camera, wavelength).lens
    farthest = 0.0
    for x, y in positions * camera.mla_distance / (camera.mla_distance + camera.reduced_distance):
        points = _points(camera, (x, y), distances)
        landing = footprint(lens.waves_of(points), points)
        farthest = max(farthest, float((abs(landing.centre - (x, y)) + landing.half_width).max()))
    return farthest


def _around(camera: PlenopticCamera, position: Doubles, count: int) -> tuple[PlenopticCamera, Doubles, Pair]:
    """Return a crop of the camera around the lens at a position, the middle of its pixels, and the lens's centre.

    All lenses of the crop that are aligned to chief rays are shifted alike.
    """
    width = ACROSS * camera.pixel_size
    offset = np.array(camera.mla_offset)
    index = np.floor((position - offset) / width)
    middle = (index + 0.5) * width + offset
    moved = camera.lattice.displacement
    shift = np.zeros(2) if moved is None else np.array(moved.smooth(*middle))
    corner = np.array(camera.resolution) / 2 + (index - count // 2) * ACROSS + np.rint(offset / camera.pixel_size)
    refuse_if(
        (corner < 0).any() or (corner + ACROSS * count > camera.resolution).any(),
        f"fields = ({position[0]:g}, {position[1]:g}): {count} x {count} lenses around it leave the detector",
    )
    local = camera.replace(
        mla_cra=(),
        mla_offset=tuple((offset + shift).tolist()),
        **SHARP,
        crop_offset=tuple(corner.astype(int).tolist()),
        crop_size=(ACROSS * count, ACROSS * count),
    )
    x, y = local.lattice.centre(*index.tolist())
    return local, middle, (float(x), float(y))
