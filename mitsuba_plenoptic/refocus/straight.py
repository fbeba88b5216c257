r"""Captures of tilted arrays as upright arrays would have recorded them.

A tilted array has each lens at its own height h, towards the main lens. A ray through the pupil point P and the lens's
centre c meets the detector at :math:`p = c - (z + h)(P - c) / (b - h)`. In a camera whose array stands upright, the
lens on the same chief ray is at :math:`c b / (b - h)`, and the ray through its centre and P meets the detector around
the same point, at distances smaller by the factor :math:`(z + h) b / (b - h) z`. So every micro-image of the tilted
array is one of the upright array, enlarged about its chief ray, and the lenses are displaced by :math:`c h / b`, a
warp.

Both rays come from the same point of the object for P on the axis. For others they are :math:`h P / b` apart on the
array: the tilt displaces lenses along the light, out of focus by their heights.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from ..camera import PlenopticCamera
from ..errors import naming
from ..lattice.displacement import WARP_POWERS

_BLOCK = 2**20
"""Pixels that are looked up together."""

_ORDER = 3
"""Order of the splines between pixels."""


def straightened(camera: PlenopticCamera) -> PlenopticCamera:
    """Return a camera with an upright array whose lenses are on the chief rays of the lenses of a tilted array."""
    if not camera.has_array or not any(camera.mla_tilt):
        return camera
    warp = np.array(camera.mla_warp or np.zeros(2 * len(WARP_POWERS))).reshape(2, -1)
    if camera.lens_data.converges:
        # c h / b, where h is linear in c.
        across, up = np.tan(np.deg2rad(camera.mla_tilt)) / camera.pupil_distance
        warp[0, :2] += across, up
        warp[1, 1:3] += across, up
    with naming(f"mla_tilt = {camera.mla_tilt}"):
        return camera.replace(mla_tilt=(0.0, 0.0), mla_warp=tuple(warp.ravel().tolist()))


def straightened_image(image: NDArray[np.float32], camera: PlenopticCamera) -> NDArray[np.float32]:
    """Return a capture (rows, columns, channels) by a camera as its `straightened` camera records it."""
    upright = straightened(camera)
    if upright is camera:
        return image
    found = np.empty_like(image)
    splines = [spline_filter(channel, _ORDER) for channel in np.moveaxis(image.astype(np.float64), -1, 0)]
    for rows, x, y in _enlarged(camera, upright):
        at = [
            place / camera.pixel_size + camera.resolution[axis] / 2 - 0.5 - camera.crop_offset[axis]
            for axis, place in ((1, y), (0, x))
        ]
        for channel, spline in enumerate(splines):
            found[rows, :, channel] = map_coordinates(spline, at, order=_ORDER, mode="nearest", prefilter=False)
    # Splines overshoot at the edges of micro-images.
    return found.clip(image.min(), None)


def _enlarged(camera: PlenopticCamera, upright: PlenopticCamera) -> Iterator[tuple[slice, Any, Any]]:
    """Yield rows of pixels of the upright camera with the positions on the tilted camera's detector, along x and y."""
    b, z, n = camera.pupil_distance, camera.reduced_distance, camera.mla_medium
    slopes, finite = np.tan(np.deg2rad(camera.mla_tilt)), camera.lens_data.converges
    px, down = camera.pixel_coordinates(0), camera.pixel_coordinates(1)
    height = max(1, _BLOCK // px.size)
    for first in range(0, down.size, height):
        p = np.meshgrid(px, down[first : first + height])
        cells = upright.lattice.cell(*(q / upright.image_growth for q in p))
        rise = sum(slope * c for slope, c in zip(slopes, camera.lattice.centre(*cells), strict=True))
        larger = (z + rise / n) / z * (b / (b - rise) if finite else 1.0)
        chief = [c * upright.image_growth for c in upright.lattice.centre(*cells)]
        x, y = (middle + larger * (q - middle) for q, middle in zip(p, chief, strict=True))
        yield slice(first, first + len(x)), x, y
