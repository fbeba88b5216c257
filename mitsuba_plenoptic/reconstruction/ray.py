"""Refocusing by rays, after Ng, "Digital Light Field Photography" (2006), section 4."""

from __future__ import annotations

import math

import numpy as np

from ..camera import PlenopticCamera
from ..design import focus_type, lens_footprint, pixel_footprint
from ..optics import rays
from ._binning import AxisBins, axis_bins, bin_image
from ._splatting import splat

# Bins that get less than this share of the light that a bin gets of a white scene on average lie at the border of what
# was recorded; they are not brightened any further, since they would show little but noise.
_LEAST_WEIGHT = 0.25


def reconstruct_ray(
    image: np.ndarray, camera: PlenopticCamera, distance: float, *, footprint: str, oversample: int = 1
) -> np.ndarray:
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

    Parameters
    ----------
    image : (rows, columns, channels) float32 array
        The capture.
    camera : PlenopticCamera
        The camera; its recorded window is the image.
    distance : float
        Object distance.
    footprint : {"lens", "point"}
        The version.
    oversample : int
        Bins per lens along each axis.

    Returns
    -------
    (rows, columns, channels) float32 array
        Radiance: bins are divided by the number of pixels in a micro-image,
        :math:`(\pi/4) (D_1 z / b)^2` over the pixel's area.
    """
    if focus_type(camera) != "unfocused" or not lenses_fill_bins(camera):
        light, white = splat(image, camera, distance, _pupil_radius(camera), footprint=footprint, oversample=oversample)
        return (light / at_least(white, camera, oversample)[..., None]).astype(np.float32)
    x, y = (_axis(camera, distance, axis, footprint, oversample) for axis in (0, 1))
    return bin_image(image, x, y, _pupil_radius(camera)) / np.float32(pixels_per_bin(camera, oversample))


def pixels_per_bin(camera: PlenopticCamera, oversample: int) -> float:
    r"""Pixels of micro-images that go to one bin: :math:`(\pi/4) (D_1 z / b)^2` over the pixel's area for each lens."""
    lenses = camera.mla_pitch**2 / camera.lattice.cell_area
    return lenses * math.pi / 4 * (camera.micro_image_diameter / camera.pixel_size / oversample) ** 2


def lenses_fill_bins(camera: PlenopticCamera) -> bool:
    """Whether lenses and bins are arranged alike, on an upright square lattice without gaps."""
    return camera.lenses_like_bins


def white_bins(camera: PlenopticCamera, distance: float, oversample: int) -> np.ndarray:
    """Return what every bin gets of a white scene, in pixels, by one ray a pixel.

    The ray must pass the pupil, by half a pixel: a smooth wave goes back through the lens's centre alone.
    """
    nothing = np.zeros((*camera.shape, 1), np.float32)
    footprint = "point" if focus_type(camera) == "unfocused" else "lens"
    return splat(nothing, camera, distance, camera.lit_radius, footprint=footprint, oversample=oversample)[1]


def at_least(white: np.ndarray, camera: PlenopticCamera, oversample: int) -> np.ndarray:
    """Return what bins are divided by for a white scene to give 1, where they got this much of it."""
    return np.maximum(white, _LEAST_WEIGHT * pixels_per_bin(camera, oversample))


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
