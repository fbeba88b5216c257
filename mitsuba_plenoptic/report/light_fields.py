"""Light fields and what comes from them as files: OpenEXR of many parts, and pictures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ..errors import InputError
from ..io.exr import write_exr_parts
from ..io.files import require_writable
from ..lightfield.views import view_mosaic
from .images import SUFFIXES, write_png

# Lines of an epipolar image and pixels of a small map are drawn so many times as large.
_ENLARGED = 4


def require_picture_path(path: str | Path) -> Path:
    """Check, before a long computation, that a file of a known kind can be written.

    Raises
    ------
    InputError
        If the suffix is neither .exr nor .png or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: give a name that ends in {' or '.join(SUFFIXES)}")
    return require_writable(path)


def write_views(path: str | Path, lf: xr.DataArray) -> None:
    """Write the views of a light field: a part each named by its place on the pupil, or a mosaic as PNG.

    Raises
    ------
    InputError
        If the suffix is unknown or the file cannot be written.
    """
    path = require_picture_path(path)
    if path.suffix.lower() == ".png":
        write_png(path, view_mosaic(lf), peak=_peak(lf.values))
        return
    parts = {
        f"v={float(lf.v[j]):.4g} u={float(lf.u[i]):.4g}": np.asarray(lf.values[j, i])
        for j in range(lf.sizes["v"])
        for i in range(lf.sizes["u"])
    }
    write_exr_parts(path, parts, {"kind": "views", **_coordinates(lf)})


def write_epipolar_image(path: str | Path, image: xr.DataArray) -> None:
    """Write an epipolar image, as PNG enlarged.

    Raises
    ------
    InputError
        If the suffix is unknown or the file cannot be written.
    """
    path = require_picture_path(path)
    values = np.asarray(image.values)
    if path.suffix.lower() == ".png":
        write_png(path, values.repeat(_ENLARGED, axis=0).repeat(_ENLARGED, axis=1), peak=_peak(values))
    else:
        write_exr_parts(path, {"epipolar": values}, {"kind": "epipolar image", **_coordinates(image)})


def write_stack(path: str | Path, stack: xr.DataArray) -> None:
    """Write a focal stack: a part each named by its distance, or the images side by side as PNG.

    Raises
    ------
    InputError
        If the suffix is unknown or the file cannot be written.
    """
    path = require_picture_path(path)
    images = {f"{float(image.distance):.6g} mm": np.asarray(image.values) for image in stack}
    if path.suffix.lower() == ".png":
        write_png(path, _tiled(list(images.values())), peak=_peak(stack.values))
    else:
        write_exr_parts(path, images, {"kind": "focal stack", **_coordinates(stack)})


def write_depth(path: str | Path, found: xr.Dataset) -> None:
    """Write a depth map: depth, disparity, confidence and the all-in-focus image as parts, or pictures as PNG.

    The PNG shows, from left to right, the all-in-focus image, the depth from near (white) to far (black), and the
    confidence.

    Raises
    ------
    InputError
        If the suffix is unknown or the file cannot be written.
    """
    path = require_picture_path(path)
    if path.suffix.lower() == ".exr":
        parts = {name: np.asarray(found[name].values) for name in ("depth", "disparity", "confidence", "image")}
        write_exr_parts(path, parts, {"kind": "depth", **_coordinates(found)})
        return
    image = np.asarray(found["image"].values)
    # Even steps of disparity are what the eye would see.
    low, high = float(found.disparity.min()), float(found.disparity.max())
    nearness = (high - np.asarray(found.disparity.values)) / ((high - low) or 1)
    maps = [image / _peak(image), nearness, np.asarray(found.confidence.values)]
    if image.ndim == 3:
        maps = [entry if entry.ndim == 3 else np.repeat(entry[..., None], 3, axis=2) for entry in maps]
    picture = np.concatenate(maps, axis=1).repeat(_ENLARGED, axis=0).repeat(_ENLARGED, axis=1)
    write_png(path, picture, peak=1)


def _peak(values: np.ndarray) -> float:
    """Value that a picture shows white: but for a thousandth of them, all are less bright."""
    return float(np.quantile(values, 0.999)) or float(np.max(values)) or 1.0


def _tiled(images: list[np.ndarray]) -> np.ndarray:
    """Lay images of one size out in rows, as near to a square as can be; empty places stay black."""
    columns = int(np.ceil(np.sqrt(len(images))))
    empty = [np.zeros_like(images[0])] * (-len(images) % columns)
    every = images + empty
    rows = [np.concatenate(every[i : i + columns], axis=1) for i in range(0, len(every), columns)]
    return np.concatenate(rows, axis=0)


def _coordinates(data: xr.DataArray | xr.Dataset) -> dict[str, Any]:
    """Give the coordinates and attributes as plain values."""
    coordinates = {str(name): values.values.tolist() for name, values in data.coords.items() if name != "weight"}
    records = {name: json.loads(data.attrs[name]) for name in ("camera", "grid") if name in data.attrs}
    return {"coordinates": coordinates, **data.attrs, **records}
