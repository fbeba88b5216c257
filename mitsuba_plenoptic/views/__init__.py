"""Four-dimensional light fields: decoding, views, refocusing and depth.

A light field is an `xarray.DataArray`; `coordinates` says what its axes mean.
"""

import lazy_loader

# `__init__.pyi` names, besides what is public, what other folders and extensions may use.
__getattr__, __dir__, _ = lazy_loader.attach_stub(__name__, __file__)

__all__ = [
    "DepthError",
    "LensGrid",
    "MicroImages",
    "camera_of",
    "decode",
    "depth_error",
    "depth_map",
    "disparity",
    "distance_of",
    "epipolar_image",
    "estimate_lens_grid",
    "focal_stack",
    "grid_of",
    "ground_truth",
    "lens_grid",
    "micro_images",
    "pick_views",
    "refocus",
    "shift_and_add",
    "view",
    "view_mosaic",
    "white_image",
]
