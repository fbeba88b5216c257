"""NetCDF files of labelled data: velocity fields, particles and volumes."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from ...errors import refuse_if, refusing
from ...runtime import atomic_output, require_file, require_memory

_PER_BYTE = 3
"""Bytes that reading takes for each of a file."""


def write_netcdf(path: str | Path, data: xr.Dataset) -> None:
    """Write a data set as NetCDF 3, which ``xarray.open_dataset`` and most other programs read.

    Parameters
    ----------
    path : path
        File to write, whose name ends in ``.nc``.
    data : xarray.Dataset
        The data set.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    with atomic_output(Path(path), ".nc") as temporary:
        data.to_netcdf(temporary, engine="scipy")


def read_netcdf(path: str | Path, what: str = "a data set") -> xr.Dataset:
    """Return the data set in a file of NetCDF 3.

    NetCDF 4 is HDF5, whose files can link to others, and is not read.

    Parameters
    ----------
    path : path
        The file.
    what : str
        Name of its content in messages.

    Raises
    ------
    InputError
        If it is another file, or damaged.
    """
    path = require_file(path)
    with refusing(f"{path}: it cannot be read as {what}:"):
        require_memory(_PER_BYTE * path.stat().st_size, f"{path}: {what}")
        with path.open("rb") as file:
            begins = file.read(3)
        refuse_if(begins != b"CDF", f"{path}: it is not NetCDF 3; convert other formats with xarray in Python")
        return xr.load_dataset(path, engine="scipy")
