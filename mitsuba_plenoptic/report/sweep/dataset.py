"""The dataset of a sweep as a NetCDF file, written image by image."""

from __future__ import annotations

import io
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...io.captures import Capture
from ..stage_store import software
from .points import DISTANCE, WAVELENGTH, Grid, SweepSettings

_UNITS = {WAVELENGTH: "nm", DISTANCE: "mm", "focus_distance": "mm"} | dict.fromkeys(
    ("focal_length", "aperture_radius", "mla_distance", "mla_focal_length", "mla_pitch", "detector_distance"), "mm"
)


class Layout:
    """The dataset in its file, image by image."""

    def __init__(self, file: Any, settings: SweepSettings, grid: Grid, first: Capture) -> None:
        self.variables = file.variables
        axes = [name for name in grid if name != DISTANCE]
        self.shape = tuple(len(grid[name]) for name in axes) or (1,)
        # A grid of distances alone has one capture, without an axis.
        self._scalar = not axes
        rows, columns = first.camera.shape
        bin_columns, bin_rows = first.camera.bin_count
        sizes = {name: len(values) for name, values in grid.items()} | {"row": rows, "column": columns}
        if DISTANCE in grid:
            sizes |= {"bin_row": bin_rows, "bin_column": bin_columns}
        channels = ("channel",) if first.image.ndim == 3 else ()
        file.dimensions = sizes | dict.fromkeys(channels, 3)
        for name, values in grid.items():
            variable = file.create_variable(name, (name,), data=np.array(values))
            variable.attrs.update({"units": _UNITS[name]} if name in _UNITS else {})

        def add(name: str, dimensions: tuple[str, ...], facts: dict[str, str], image: bool = True) -> None:
            shape = [file.dimensions[d].size for d in dimensions]
            # One image to a chunk, as they are written and read.
            chunks = [1 if d in grid else size for d, size in zip(dimensions, shape, strict=True)]
            storage = {"chunks": tuple(chunks), "compression": "gzip", "shuffle": True} if image else {}
            file.create_variable(name, dimensions, "f4" if image else "f8", **storage).attrs.update(facts)

        radiance = {"units": "1", "long_name": "mean radiance over the lens"}
        add("capture", (*axes, "row", "column", *channels), {**radiance, "coordinates": "pixel_size"})
        add("pixel_size", tuple(axes), {"units": "mm", "long_name": "width of a pixel"}, image=False)
        if DISTANCE in grid:
            over = (*axes, DISTANCE)
            add("reconstruction", (*over, "bin_row", "bin_column", *channels), {**radiance, "coordinates": "bin_size"})
            add("bin_size", over, {"units": "mm", "long_name": "width of a bin in the object plane"}, image=False)
        file.attrs.update(
            {
                "title": f"Sweep of the scene {Path(settings.scene).stem}",
                "model": first.model,
                "settings": json.dumps(asdict(settings), sort_keys=True),
                "software": json.dumps(software(), sort_keys=True),
            }
        )
        self.distances = grid.get(DISTANCE, ())

    def put(self, index: tuple[Any, ...], capture: Capture, images: list[np.ndarray]) -> None:
        """Write one capture and its reconstructions."""
        place = () if self._scalar else tuple(int(i) for i in index)
        self.variables["capture"][(*place, ...)] = capture.image
        self.variables["pixel_size"][place] = capture.camera.pixel_size
        for number, (distance, image) in enumerate(zip(self.distances, images, strict=True)):
            self.variables["reconstruction"][(*place, number, ...)] = image
            self.variables["bin_size"][(*place, number)] = capture.camera.bin_size(distance)


class Sink(io.FileIO):
    """A file that keeps its write errors until it is asked: HDF5 crashes at the end of the process after one."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        """Write all of it; after an error, drop it."""
        view = memoryview(data).cast("B")
        size = len(view)
        try:
            while len(view) and not self.error:
                view = view[super().write(view) :]
        except OSError as error:
            self.error = error
        return size

    def truncate(self, size: int | None = None) -> int:
        """Set the size; after an error, do not."""
        try:
            return self.tell() if self.error else super().truncate(size)
        except OSError as error:
            self.error = error
            return self.tell()

    def check(self, path: Path) -> None:
        """Raise the error that a write met."""
        if self.error:
            raise InputError(f"{path}: it cannot be written: {self.error.strerror}")
