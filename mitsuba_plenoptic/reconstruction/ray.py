"""Refocusing by rays, after Ng, "Digital Light Field Photography" (2006), section 4."""

from __future__ import annotations

import math

import numpy as np

from .. import lattice, rays
from ..camera import PlenopticCamera
from ._binning import AxisBins, axis_bins, bin_image


def reconstruct_ray(
    image: np.ndarray, camera: PlenopticCamera, distance: float, *, footprint: str, oversample: int = 1
) -> np.ndarray:
    r"""Follow one ray a pixel back to the object plane and add the pixel's value to the bin it meets.

    The ray goes from the pixel's centre through the centre of its lens. With ``footprint="point"`` the whole value
    goes to one bin; with ``"lens"`` it is spread over the places that the rays through the whole lens meet, about
    one bin, because the pixel has integrated over the lens: this leaves no grid pattern out of focus.

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
    x, y = (_axis(camera, distance, axis, footprint, oversample) for axis in (0, 1))
    return bin_image(image, x, y, _pupil_radius(camera)) / np.float32(pixels_per_bin(camera, oversample))


def pixels_per_bin(camera: PlenopticCamera, oversample: int) -> float:
    r"""Pixels of a micro-image, :math:`(\pi/4) (D_1 z / b)^2` over the pixel's area, that go to one bin."""
    return math.pi / 4 * (camera.micro_image_diameter / camera.pixel_size / oversample) ** 2


def _pupil_radius(camera: PlenopticCamera) -> float:
    """Radius within which a pixel's central ray must pass: half a pixel more than the pupil's.

    A pixel at a micro-image's rim is lit in part though its centre may look past the pupil; leaving such pixels out
    would lose 3 % of the paper's light.
    """
    half_pixel = camera.pixel_size / 2 * camera.mla_distance / camera.detector_distance
    return camera.aperture_radius + half_pixel


def _axis(camera: PlenopticCamera, distance: float, axis: int, footprint: str, oversample: int) -> AxisBins:
    """Where the pixels of one axis go, in bins, and where they meet the pupil."""
    count = camera.lens_count[axis] * oversample
    pixel = np.arange(camera.crop_size[axis]) + camera.crop_offset[axis] + 0.5
    p = (pixel - camera.resolution[axis] / 2) * camera.pixel_size
    chief = rays.chief_point(p, camera.mla_distance, camera.detector_distance)
    c = lattice.cell_centre(lattice.cell_index(chief, camera.mla_pitch), camera.mla_pitch)

    def pupil_and_bin(m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        t = rays.microlens_slope(p, m, c, camera.detector_distance, camera.mla_focal_length)
        P = rays.pupil_point(m, t, camera.mla_distance)
        X = rays.object_point(P, rays.main_lens_slope(t, P, camera.focal_length), distance)
        u = rays.conjugate_coordinate(X, distance, camera.mla_distance)
        return P, u * (oversample / camera.mla_pitch) + count / 2

    pupil, centre = pupil_and_bin(c)
    if footprint == "point":
        return axis_bins(centre, centre, pupil, count, _pupil_radius(camera))
    half = camera.mla_pitch / 2
    return axis_bins(pupil_and_bin(c - half)[1], pupil_and_bin(c + half)[1], pupil, count, _pupil_radius(camera))
