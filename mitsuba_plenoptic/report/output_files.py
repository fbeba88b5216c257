"""Linear images as 8-bit pictures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from PIL import Image

from ..errors import InputError, refuse_if, require_number
from ..io.exr import image_channels, write_exr_parts
from ..io.files import atomic_output, require_writable
from ..io.ground_truth import COORDINATES
from ..lightfield.views import view_mosaic
from ..reconstruction import Reconstruction, write_reconstruction


def write_png(path: str | Path, image: np.ndarray, *, peak: float | None = None) -> None:
    """Write a linear image as an 8-bit PNG, encoded by `to_bytes`; a file is replaced only by a complete one."""
    with atomic_output(path, ".png") as temporary:
        Image.fromarray(to_bytes(image, peak)).save(temporary, format="PNG")


def to_bytes(image: np.ndarray, peak: float | None = None) -> np.ndarray:
    """Encode a linear image (rows, columns[, 3]) in 8 bits, sRGB.

    `peak`, by default the image's maximum, becomes white, and what is negative or not a number becomes black.
    """
    values = np.nan_to_num(np.asarray(image, dtype=np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    if peak is None:
        peak = float(values.max())
    # An image that is all black stays so.
    values = np.clip(values / peak, 0, 1) if peak > 0 else np.zeros_like(values)
    return np.round(255 * _srgb(values)).astype(np.uint8)


def shrink(image: np.ndarray, longest: int) -> np.ndarray:
    """Average blocks of pixels, whole blocks only, until neither side is longer than `longest`."""
    rows, columns = image.shape[:2]
    factor = -(-max(rows, columns) // longest)
    if factor == 1:
        return image
    # A long and narrow image keeps at least one block on its short side.
    down, across = min(factor, rows), min(factor, columns)
    whole = image[: rows // down * down, : columns // across * across]
    blocks = whole.reshape(rows // down, down, columns // across, across, *image.shape[2:])
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))


def _srgb(linear: np.ndarray) -> np.ndarray:
    """Encode linear values from 0 to 1 (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


_MOST_STOPS = 100.0

_DEFAULT_PERCENTILE = 99.5


@dataclass(frozen=True)
class Brightness:
    """A rule for the value that becomes white; what is brighter is white, too."""

    # In stops, the same for every picture: the value 2^-exposure becomes white, 1 at 0.
    exposure: float | None = None
    # Instead, the percentage of the bins or pixels that do not surpass the value, above 0 and up to 100. Default: 99.5
    # where there is no exposure. If it is black, the brightest becomes white.
    percentile: float | None = None

    def __post_init__(self) -> None:
        if self.exposure is not None and self.percentile is not None:
            raise InputError(f"exposure = {self.exposure:g}, percentile = {self.percentile:g}: give one of the two")
        if self.exposure is not None:
            require_number("exposure", self.exposure, minimum=-_MOST_STOPS, maximum=_MOST_STOPS)
        if self.percentile is not None:
            require_number("percentile", self.percentile, positive=True, maximum=100)

    def white(self, images: Sequence[np.ndarray]) -> float:
        """Return the value that becomes white in pictures that are looked at together; NaN counts as nothing."""
        if self.exposure is not None:
            return float(2.0**-self.exposure)
        values = np.concatenate([image[np.isfinite(image)] for image in images])
        if not values.size:
            return 1.0
        percentile = _DEFAULT_PERCENTILE if self.percentile is None else self.percentile
        for value in (np.percentile(values, percentile), values.max()):
            if value > 0:
                return float(value)
        return 1.0


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
    empty = [np.zeros_like(images[0])] * (-len(images) % columns)
    every = images + empty
    rows = [np.concatenate(every[i : i + columns], axis=1) for i in range(0, len(every), columns)]
    return np.concatenate(rows, axis=0)
