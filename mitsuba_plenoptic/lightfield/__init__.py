"""Four-dimensional light fields: decoding, views, refocusing and depth.

A light field is an `xarray.DataArray`; `geometry` says what its axes mean.
"""

from .decode import decode
from .demosaic import demosaic
from .depth import DepthError, depth_error, depth_map
from .geometry import camera_of, depth_range, disparity, distance_of, grid_of
from .grid import LensGrid, lens_grid
from .grid_estimation import estimate_lens_grid
from .ground_truth import ground_truth
from .micro_images import MicroImages, micro_images
from .refocus import FourierRefocuser, focal_stack, refocus, shift_and_add
from .views import epipolar_image, lens_mosaic, pick_views, view, view_mosaic
from .white import white_image

__all__ = [
    "DepthError",
    "FourierRefocuser",
    "LensGrid",
    "MicroImages",
    "camera_of",
    "decode",
    "demosaic",
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
