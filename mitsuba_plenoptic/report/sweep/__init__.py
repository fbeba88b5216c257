"""Parameter sweeps: captures and reconstructions over a grid of cameras, wavelengths and distances, as one dataset."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import xarray as xr

from ...errors import InputError
from ...io.files import atomic_output, remove_leftovers, require_writable
from ...runtime.batches import BatchMap
from ...runtime.variant import set_variant
from ..stage_store import StageOptions, StageStore
from .dataset import Layout, Sink
from .points import Grid, Points, SweepSettings, check_grid, merge_grids, parse_grid, read_grid

__all__ = ["SweepSettings", "check_grid", "merge_grids", "parse_grid", "read_grid", "sweep"]


def sweep(
    settings: SweepSettings,
    grid: Grid,
    output: Path,
    *,
    batch_map: BatchMap | None = None,
    stages: StageOptions | None = None,
) -> xr.Dataset:
    """Render, and reconstruct where distances are given, every point of a grid.

    Each point is kept in a folder beside the output, ``out.points`` for ``out.nc``: a sweep that was stopped, or
    whose grid has grown, computes only what is missing. The dataset is written point by point, so that memory does
    not grow with the grid.

    Parameters
    ----------
    settings : SweepSettings
        What does not vary.
    grid : mapping of names to numbers
        What does: parameters of the scene; ``wavelength`` of wave captures in nanometres; ``distance``, to which each
        capture is refocused.
    output : path
        NetCDF-4 file to write, which ends in ``.nc``.
    batch_map : callable, optional
        By waves: computes the sums, for example `Cluster`.
    stages : StageOptions, optional
        How progress is reported, and what becomes of checkpoints.

    Returns
    -------
    xarray.Dataset
        The file, read as it is used: ``capture`` over the grid, ``row`` and ``column`` (and ``channel``), with the
        coordinate ``pixel_size``; and, where distances are given, ``reconstruction`` over the grid, ``distance``,
        ``bin_row`` and ``bin_column``, with ``bin_size``. Images are in units of radiance.

    Raises
    ------
    InputError
        If the grid has an unknown name, a value that is no number or twice the same, or none at all; if its images
        differ in size; or if the scene, a camera or a distance is refused.
    """
    try:
        import h5netcdf
    except ImportError:
        raise InputError("sweep: datasets need h5netcdf: pip install h5netcdf h5py") from None
    output = require_writable(output, ".nc")
    grid = check_grid(grid)
    set_variant(settings.variant)
    store = StageStore(output.with_suffix(".points"), stages)
    points = Points(settings, grid, store)
    points.check()
    remove_leftovers(output)
    with atomic_output(output) as temporary, Sink(temporary, "w+") as sink:
        with h5netcdf.File(sink, "w") as file:
            for index, (capture, images) in enumerate(points.compute(batch_map)):
                if not index:
                    layout = Layout(file, settings, grid, capture)
                layout.put(np.unravel_index(index, layout.shape), capture, images)
                sink.check(output)
                store.notify("points", index + 1, math.prod(layout.shape))
        sink.check(output)
    return xr.open_dataset(output, engine="h5netcdf")
