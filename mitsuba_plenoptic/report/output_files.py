"""Output files of reconstructions, views, stacks and depth maps: OpenEXR, picture, figure or animation by suffix."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..choices import PICTURES
from ..errors import refuse_if
from ..io import TRUTH_COORDINATES, image_channels, write_exr_parts
from ..refocus import Reconstruction, write_reconstruction
from ..runtime import Array, Named, Shape, require_writable
from ..views import view_mosaic
from .animations import write_animation
from .images import Drawing, enlarge, enlargement, write_png

if TYPE_CHECKING:
    import xarray as xr


def _plots() -> Any:
    """Return the module of figures, whose libraries take a third of a second to load."""
    return importlib.import_module(".plots", __package__)


def reconstruction_paths(path: str | Path, distances: Sequence[float], drawing: Drawing) -> list[Path]:
    """Return a file path for each distance, after a check that all can be written.

    A figure shows all distances in one file, `path`. Otherwise one distance gives `path`, and several give
    ``name_210.exr``, ``name_240.exr``; no distance may be given twice.
    """
    path = require_writable(path, *PICTURES)
    names = [f"{path.stem}_{distance:.12g}{path.suffix}" for distance in distances]
    for name, distance in zip(names, distances, strict=True):
        refuse_if(names.count(name) > 1, f"distance = {distance:g}: it is given twice")
    if len(distances) == 1 or drawing.is_figure(path):
        return [path]
    return [require_writable(path.with_name(name)) for name in names]


def write_reconstructions(
    paths: Sequence[Path], results: Sequence[Reconstruction], source: Named | None, drawing: Drawing
) -> None:
    """Write each reconstruction into its file, as OpenEXR or as a picture by the suffix.

    Pictures share one scale. OpenEXR files keep in their headers the metadata of the capture, `source`.
    """
    peak = drawing.brightness.peak([result.image for result in results])
    if drawing.is_figure(paths[0]):
        _plots().contact_sheet(results, peak).save(paths[0], drawing.dpi)
        return
    for path, result in zip(paths, results, strict=True):
        if path.suffix.lower() == ".png":
            write_png(path, _enlarged(result.image, drawing), peak=peak)
        else:
            write_reconstruction(path, result, source)


def write_views(path: str | Path, lf: xr.DataArray, drawing: Drawing) -> None:
    """Write the views of a light field: as parts named by position on the pupil, or as a mosaic.

    The light field's ground truth, if any, is added to each part, in the channels of ground truth files.
    """
    truth = {channel: lf.coords[name].values for channel, name in TRUTH_COORDINATES.items() if name in lf.coords}
    parts = {
        f"v={float(lf.v[j]):.4g} u={float(lf.u[i]):.4g}": image_channels(lf.values[j, i])
        | {name: values[j, i] for name, values in truth.items()}
        for j, i in np.ndindex(lf.shape[:2])
    }
    white = drawing.brightness.peak([lf.values])
    picture = view_mosaic(lf)
    write_drawn(path, "views", lf, parts, picture, white, drawing, lambda: _plots().views_figure(lf, white))


def write_epipolar_image(path: str | Path, image: xr.DataArray, drawing: Drawing) -> None:
    """Write an epipolar image; a PNG is enlarged."""
    values = image.values
    white = drawing.brightness.peak([values])
    parts = as_parts(epipolar=values)
    kind = "epipolar image"
    write_drawn(path, kind, image, parts, values, white, drawing, lambda: _plots().epipolar_figure(image, white))


def write_stack(path: str | Path, stack: xr.DataArray, drawing: Drawing) -> None:
    """Write a focal stack: as parts named by distance or disparity, or as a PNG with the images side by side."""
    by = str(stack.dims[0])
    images = {f"{float(image[by]):.6g} {stack[by].units}": image.values for image in stack}
    white = drawing.brightness.peak([stack.values])
    # Rows of one picture, nearly square; empty positions stay black.
    columns = math.ceil(math.sqrt(len(stack)))
    tiles = [*stack.values, *np.zeros_like(stack.values[: -len(stack) % columns])]
    picture = np.vstack([np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)])
    parts = as_parts(**images)
    write_drawn(path, "focal stack", stack, parts, picture, white, drawing, lambda: _plots().stack_figure(stack, white))


def write_focal_sweep(path: Path, stack: xr.DataArray, drawing: Drawing) -> int:
    """Write a focal stack as an animation, there and back; return the number of its frames."""
    by = str(stack.dims[0])
    frames = [(image.values, f"{float(image[by]):.4g} {stack[by].units}") for image in stack]
    frames += frames[-2:0:-1]
    write_animation(path, frames, drawing.brightness.peak([stack.values]), drawing.scale)
    return len(frames)


def write_orbit(path: Path, lf: xr.DataArray, drawing: Drawing) -> int:
    """Write views on a circle of the pupil as an animation; return the number of its frames."""
    frames = [(lf.values[j, i], "") for j, i in orbit(lf)]
    write_animation(path, frames, drawing.brightness.peak([image for image, _ in frames]), drawing.scale)
    return len(frames)


def orbit(lf: xr.DataArray) -> list[Shape]:
    """Return the views (row, column) nearest to a circle of three quarters of the pupil's radius, each once."""
    u = lf.u.values
    v = lf.v.values
    radius = 0.75 * max(np.abs(u).max(), np.abs(v).max())
    angles = np.linspace(0, 2 * np.pi, 8 * max(len(u), len(v)), endpoint=False)
    near = [
        (int(np.abs(v - radius * np.sin(angle)).argmin()), int(np.abs(u - radius * np.cos(angle)).argmin()))
        for angle in angles
    ]
    return list(dict.fromkeys(near))


def write_depth(path: str | Path, depth: xr.Dataset, drawing: Drawing) -> None:
    """Write a depth map: depth, disparity, confidence and the all-in-focus image as parts, or as PNG.

    The true depth is a part, too, if it is known.

    A PNG is a labelled figure; with a scale it shows, from left to right and without labels, the all-in-focus image,
    the disparity from near (white) to far (black), and the confidence.
    """
    if drawing.scale is None and Path(path).suffix.lower() == ".png":
        drawing = replace(drawing, figure=True)
    parts = {str(name): np.asarray(values) for name, values in depth.items()}
    # Even steps of disparity are what the eye would see.
    disparity = parts["disparity"]
    closeness = (disparity.max() - disparity) / (np.ptp(disparity) or 1)
    image = parts["image"]
    white = drawing.brightness.peak([image])
    maps = [image / white, closeness, parts["confidence"]]
    if image.ndim == 3:
        maps = [entry if entry.ndim == 3 else np.dstack([entry] * 3) for entry in maps]
    picture = np.concatenate(maps, axis=1)
    stored = as_parts(**parts)
    write_drawn(path, "depth", depth, stored, picture, 1.0, drawing, lambda: _plots().depth_figure(depth, white))


def write_drawn(
    path: str | Path,
    kind: str,
    data: xr.DataArray | xr.Dataset,
    parts: dict[str, dict[str, Array]],
    picture: Array,
    peak: float,
    drawing: Drawing,
    figure: Callable[[], Any],
) -> None:
    """Write a data file of parts with coordinates and attributes, a picture, or a figure, chosen by the suffix."""
    path = require_writable(path, *PICTURES)
    if drawing.is_figure(path):
        figure().save(path, drawing.dpi)
        return
    if path.suffix.lower() == ".png":
        write_png(path, _enlarged(picture, drawing), peak=peak)
        return
    coordinates = {str(name): values.values.tolist() for name, values in data.coords.items() if values.ndim < 2}
    records = {name: json.loads(data.attrs[name]) for name in ("camera", "grid") if name in data.attrs}
    write_exr_parts(path, parts, {"kind": kind, "coordinates": coordinates, **data.attrs, **records})


def _enlarged(picture: Array, drawing: Drawing) -> Array:
    """Return a picture with bins repeated as requested, or enough to make a small picture visible."""
    return enlarge(picture, drawing.scale or enlargement(picture))


def as_parts(**images: Array) -> dict[str, dict[str, Array]]:
    """Return images as parts of a file, one image per part."""
    return {name: image_channels(image) for name, image in images.items()}
