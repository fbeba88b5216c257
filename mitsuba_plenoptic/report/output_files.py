"""Files of reconstructions, views, stacks and depth maps: OpenEXR or 8-bit pictures, by the suffix."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ..errors import refuse_if
from ..io.exr import image_channels, write_exr_parts
from ..io.files import require_writable
from ..io.ground_truth import COORDINATES
from ..lightfield.views import view_mosaic
from ..reconstruction import Reconstruction, write_reconstruction
from .images import Brightness, write_png

_AUTOMATIC = Brightness()

_SUFFIXES = (".exr", ".png")

# How many times as large lines of an epipolar image and pixels of a small map are drawn.
_ENLARGED = 4


def require_picture_path(path: str | Path) -> Path:
    """Check, before a long computation, that a file ends in .exr or .png and can be written."""
    return require_writable(path, *_SUFFIXES)


def reconstruction_paths(path: str | Path, distances: Sequence[float]) -> list[Path]:
    """Name a file for each distance, and check that all can be written.

    One distance gives `path` itself, several give ``name_210.exr``, ``name_240.exr``; none may be given twice.
    """
    path = require_picture_path(path)
    if len(distances) == 1:
        return [path]
    names = [f"{path.stem}_{distance:.12g}{path.suffix}" for distance in distances]
    for name, distance in zip(names, distances, strict=True):
        refuse_if(names.count(name) > 1, f"distance = {distance:g}: it is given twice")
    return [require_writable(path.with_name(name)) for name in names]


def write_reconstructions(
    paths: Sequence[Path],
    results: Sequence[Reconstruction],
    source: dict[str, Any] | None = None,
    brightness: Brightness = _AUTOMATIC,
) -> None:
    """Write each reconstruction into its file, as OpenEXR or as a picture by the suffix.

    Pictures share one scale. OpenEXR files keep in their headers the metadata of the capture, `source`.
    """
    peak = brightness.white([result.image for result in results])
    for path, result in zip(paths, results, strict=True):
        if path.suffix.lower() == ".png":
            write_png(path, result.image, peak=peak)
        else:
            write_reconstruction(path, result, source)


def write_views(path: str | Path, lf: xr.DataArray, brightness: Brightness = _AUTOMATIC) -> None:
    """Write the views of a light field: a part each named by its position on the pupil, or a mosaic as PNG.

    Ground truth that the light field has is in each part, too, in the channels of its own file.
    """
    truth = {channel: lf.coords[name].values for channel, name in COORDINATES.items() if name in lf.coords}
    parts = {
        f"v={float(lf.v[j]):.4g} u={float(lf.u[i]):.4g}": image_channels(np.asarray(lf.values[j, i]))
        | {name: values[j, i] for name, values in truth.items()}
        for j in range(lf.sizes["v"])
        for i in range(lf.sizes["u"])
    }
    _write(path, "views", lf, parts, view_mosaic(lf), brightness.white([lf.values]))


def write_epipolar_image(path: str | Path, image: xr.DataArray, brightness: Brightness = _AUTOMATIC) -> None:
    """Write an epipolar image, as PNG enlarged."""
    values = np.asarray(image.values)
    _write(path, "epipolar image", image, _images(epipolar=values), _enlarged(values), brightness.white([values]))


def write_stack(path: str | Path, stack: xr.DataArray, brightness: Brightness = _AUTOMATIC) -> None:
    """Write a focal stack: a part each named by its distance, or the images side by side as PNG."""
    images = {f"{float(image.distance):.6g} mm": np.asarray(image.values) for image in stack}
    _write(
        path, "focal stack", stack, _images(**images), _tiled(list(images.values())), brightness.white([stack.values])
    )


def write_depth(path: str | Path, found: xr.Dataset, brightness: Brightness = _AUTOMATIC) -> None:
    """Write a depth map: depth, disparity, confidence and the all-in-focus image as parts, or pictures as PNG.

    The true depth is a part, too, where it is known.

    The PNG shows, from left to right, the all-in-focus image, the depth from near (white) to far (black), and the
    confidence.
    """
    parts = {str(name): np.asarray(values) for name, values in found.items()}
    # Even steps of disparity are what the eye would see.
    low, high = float(parts["disparity"].min()), float(parts["disparity"].max())
    closeness = (high - parts["disparity"]) / ((high - low) or 1)
    maps = [parts["image"] / brightness.white([parts["image"]]), closeness, parts["confidence"]]
    if parts["image"].ndim == 3:
        maps = [entry if entry.ndim == 3 else np.repeat(entry[..., None], 3, axis=2) for entry in maps]
    _write(path, "depth", found, _images(**parts), _enlarged(np.concatenate(maps, axis=1)), 1.0)


def _write(
    path: str | Path,
    kind: str,
    data: xr.DataArray | xr.Dataset,
    parts: dict[str, dict[str, np.ndarray]],
    picture: np.ndarray,
    peak: float,
) -> None:
    """Write the parts with the coordinates and attributes of the data, or the picture, by the suffix."""
    path = require_picture_path(path)
    if path.suffix.lower() == ".png":
        write_png(path, picture, peak=peak)
        return
    coordinates = {str(name): values.values.tolist() for name, values in data.coords.items() if values.ndim < 2}
    records = {name: json.loads(data.attrs[name]) for name in ("camera", "grid") if name in data.attrs}
    write_exr_parts(path, parts, {"kind": kind, "coordinates": coordinates, **data.attrs, **records})


def _images(**images: np.ndarray) -> dict[str, dict[str, np.ndarray]]:
    """Return parts of one image each."""
    return {name: image_channels(image) for name, image in images.items()}


def _enlarged(image: np.ndarray) -> np.ndarray:
    return image.repeat(_ENLARGED, axis=0).repeat(_ENLARGED, axis=1)


def _tiled(images: list[np.ndarray]) -> np.ndarray:
    """Lay images of one size out in rows, as near to a square as can be; empty positions stay black."""
    columns = int(np.ceil(np.sqrt(len(images))))
    every = images + [np.zeros_like(images[0])] * (-len(images) % columns)
    rows = [np.concatenate(every[i : i + columns], axis=1) for i in range(0, len(every), columns)]
    return np.concatenate(rows, axis=0)
