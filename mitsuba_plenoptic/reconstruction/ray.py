"""Refocusing by rays, after Ng, "Digital Light Field Photography" (2006), section 4."""

from __future__ import annotations

import numpy as np

from ..camera import PlenopticCamera
from ..design import focus_type, lens_footprint, pixel_footprint
from ..errors import InputError
from ..optics import rays
from .binning import AxisBins, axis_bins, bin_image
from .methods import Task, method
from .radiance import at_least, pixels_per_bin
from .splatting import splat

# Dr.Jit counts in 32 bits.
_MOST_VALUES = 2**32 - 1


@method("ray", options=("footprint",), waves=False)
def refocus(task: Task, *, footprint: str) -> list[np.ndarray]:
    r"""Follow one ray a pixel back to the object plane and add the pixel's value to the bin it meets.

    The ray goes from the pixel's centre through the centre of its lens. With ``footprint="point"`` the whole value
    goes to one bin; with ``"lens"`` it is spread over the places that the rays through the whole lens meet, because the
    pixel has integrated over the lens: this leaves no grid pattern out of focus. For an unfocused camera that is about
    one bin. Where a focused one is sharp, those places are one point, and what the pixel itself covers is wider: the
    pixel is spread over the wider of the two (see `mitsuba_plenoptic.design`; their convolution is what it has
    integrated over, but once more on the way back that would only blur).

    For an unfocused camera with pixels and bins arranged alike, on an upright square lattice without gaps, this is done
    one axis at a time. Elsewhere bins get more light here and less there even of a white scene, and are divided by what
    they get of it, so that a white scene gives 1. (In the plane in focus a point version leaves those bins empty that
    hold no lens's centre.)

    Returns
    -------
    list of (rows, columns, channels) float32 arrays
        Radiance: bins are divided by the number of pixels in a micro-image,
        :math:`(\pi/4) (D_1 z / b)^2` over the pixel's area.
    """
    images = []
    for done, distance in enumerate(task.distances):
        images.append(_refocus(task.image, task.camera, distance, footprint, task.oversample))
        task.progress((done + 1) / len(task.distances))
    return images


def _refocus(
    image: np.ndarray, camera: PlenopticCamera, distance: float, footprint: str, oversample: int
) -> np.ndarray:
    if focus_type(camera) != "unfocused" or not camera.lenses_like_bins:
        light, white = splat(image, camera, distance, _pupil_radius(camera), footprint=footprint, oversample=oversample)
        return (light / at_least(white, camera, oversample)[..., None]).astype(np.float32)
    x, y = (_axis(camera, distance, axis, footprint, oversample) for axis in (0, 1))
    values = image.shape[2] * x.count * max(y.count, image.shape[0])
    if values > _MOST_VALUES:
        raise InputError(
            f"images of {x.count} x {y.count} bins: {values} values are summed at once, at most {_MOST_VALUES} can be"
        )
    return bin_image(image, x, y, _pupil_radius(camera)) / np.float32(pixels_per_bin(camera, oversample))


def _pupil_radius(camera: PlenopticCamera) -> float:
    """Radius within which a pixel's central ray must pass: half a pixel more than the pupil's, and half a lens's view.

    A pixel at a micro-image's rim is lit in part though its centre may look past the pupil; leaving such pixels out
    would lose 3 % of the paper's light. Through the edge of a lens that is not in focus on the pupil it looks elsewhere
    than through the centre, for a focused camera by a good part of the pupil.
    """
    view = max(abs(camera.pupil_shift(f2) - 1) for f2 in camera.mla_focal_lengths) * camera.lattice.aperture_reach
    return camera.lit_radius + view


def _axis(camera: PlenopticCamera, distance: float, axis: int, footprint: str, oversample: int) -> AxisBins:
    """Where the pixels of one axis go, in bins, and where they meet the pupil."""
    count = camera.bin_count[axis] * oversample
    p = camera.pixel_coordinates(axis)
    chief = rays.chief_point(p, camera.mla_distance, camera.detector_distance)
    c = camera.lattice.axis_centre(camera.lattice.axis_cell(chief, axis), axis)

    pupil, place = rays.follow_back(p, c, c, distance, camera)
    centre = place * (oversample / camera.mla_pitch) + count / 2
    if footprint == "point":
        return axis_bins(centre, centre, pupil, count, _pupil_radius(camera))
    width = max(
        camera.mla_pitch * lens_footprint(camera, distance, camera.mla_focal_length), pixel_footprint(camera, distance)
    )
    half = width / 2 * oversample / camera.mla_pitch
    return axis_bins(centre - half, centre + half, pupil, count, _pupil_radius(camera))
