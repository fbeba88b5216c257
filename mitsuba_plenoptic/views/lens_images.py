"""Micro-images as recorded, lens by lens: the basis of depth from focused cameras.

A light field has square upright bins, which on other lattices are interpolated between lenses. For a focused camera
this destroys detail finer than the pitch of the lenses, which its micro-images hold.
"""

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr

from ..camera import PlenopticCamera
from ..errors import InputError, advice, refuse_if
from ..io import CaptureLike
from ..runtime import Array, require_memory
from .coordinates import camera_of, grid_of, view_steps
from .decoding import checked_images, lens_samples, view_window
from .grid import LensGrid, bin_grid, lens_grid, lens_types


@dataclass(frozen=True, eq=False)
class MicroImages:
    """Micro-images, sampled in steps of a pixel about each centre.

    Attributes
    ----------
    values : (rows, columns, v, u, channels) float32 array
        Radiance that each lens of the grid shows, 0 where the weight is 0.
    weight : (rows, columns, v, u) float32 array
        Fraction of the sample that sees through the pupil, however bright its lens is.
    grid : LensGrid
        Positions of the micro-images on the recorded image.
    bins : LensGrid
        Positions of the bins of the light field of the same capture.
    camera : PlenopticCamera
        The camera.
    """

    values: Array
    weight: Array
    grid: LensGrid
    bins: LensGrid
    camera: PlenopticCamera

    @property
    def types(self) -> Array:
        """Index of the focal length of each lens, (rows, columns)."""
        return lens_types(self.camera, self.grid.centres())

    @property
    def places(self) -> Array:
        """Column and row of the middle of each lens among the bins, with fractions, (rows, columns, 2)."""
        return (self.grid.centres() - self.bins.offset) / self.bins.spacing


def micro_images(
    capture: CaptureLike,
    *,
    camera: PlenopticCamera | None = None,
    white: CaptureLike | None = None,
    grid: LensGrid | None = None,
) -> MicroImages:
    """Return the micro-images of a capture, sampled for `depth_map`.

    Parameters
    ----------
    capture, camera, white, grid
        As for `decode`; the camera must be known.

    Returns
    -------
    MicroImages
    """
    image, reference, fractions, upright = checked_images(capture, camera, white, grid)
    if upright is None:
        raise InputError("camera = None: of micro-images the camera must be known")
    refuse_if(
        upright.lens_data.images_stop,
        "camera: each lens of a Fourier microscope makes a view, not a micro-image; use decode",
    )
    lenses = grid or lens_grid(upright)
    half, _ = view_window(upright, lenses)
    size = math.prod(lenses.shape) * (2 * half + 1) ** 2
    require_memory(
        4.0 * size * (image.shape[2] + 2) + 12.0 * image.shape[0] * image.shape[1],
        f"micro-images of {lenses.shape[1]} x {lenses.shape[0]} lenses",
    )
    values, _, weight = lens_samples(image, reference, fractions, lenses, upright)
    return MicroImages(values, weight, lenses, bin_grid(upright), upright)


def micro_images_of(lf: xr.DataArray) -> MicroImages:
    """Return the micro-images of a light field decoded without interpolation between lenses."""
    camera = camera_of(lf)
    bins = bin_grid(camera)
    refuse_if(
        not (grid_of(lf) or lens_grid(camera)).are_like(bins),
        "micro_images = None: the bins of this light field are interpolated between lenses, which a focused "
        f"camera's depth cannot be found from; give {advice(python='micro_images(capture)', shell='the capture')}",
    )
    for axis in ("v", "u"):
        steps = view_steps(lf, axis)
        refuse_if(
            not np.allclose(steps, np.arange(len(steps)) - (len(steps) - 1) / 2, atol=1e-6),
            f"light field: depth of a focused camera takes all of its views, along {axis} some lack",
        )
    values = np.asarray(lf.values, dtype=np.float32).reshape(*lf.shape[:4], -1).transpose(2, 3, 0, 1, 4)
    weight = np.asarray(lf["weight"].values, dtype=np.float32).transpose(2, 3, 0, 1)
    # A part of the field counts from its own first bin.
    lenses = LensGrid(bins.spacing, bins.offset, (lf.shape[2], lf.shape[3]))
    return MicroImages(np.ascontiguousarray(values), np.ascontiguousarray(weight), lenses, lenses, camera)
