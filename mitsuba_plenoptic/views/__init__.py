"""Four-dimensional light fields: decoding, views, refocusing and depth.

A light field is an `xarray.DataArray`; `coordinates` says what its axes mean.
"""

from .coordinates import camera_of, depth_range, disparity, distance_of, grid_of
from .decode import decode
from .depth import DepthError, depth_error, depth_map
from .grid_estimation import estimate_lens_grid
from .ground_truth import ground_truth
from .lens_grid import LensGrid, lens_grid
from .lens_images import MicroImages, micro_images
from .refocusing import FourierRefocuser, focal_stack, refocus, shift_and_add
from .viewpoints import epipolar_image, lens_mosaic, pick_views, view, view_mosaic
from .white_image import white_image

__all__ = [
    "DepthError",
    "FourierRefocuser",
    "LensGrid",
    "MicroImages",
    "camera_of",
    "decode",
    "depth_error",
    "depth_map",
    "depth_range",
    "disparity",
    "distance_of",
    "epipolar_image",
    "estimate_lens_grid",
    "focal_stack",
    "grid_of",
    "ground_truth",
    "lens_grid",
    "lens_mosaic",
    "micro_images",
    "pick_views",
    "refocus",
    "shift_and_add",
    "view",
    "view_mosaic",
    "white_image",
]
