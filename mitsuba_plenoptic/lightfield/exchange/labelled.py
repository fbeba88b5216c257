"""Light fields with their axes, weights and camera, as NetCDF 3 and Zarr, which xarray reads and writes."""

from __future__ import annotations

import math
from pathlib import Path

import xarray as xr

from ...errors import InputError, refuse_if
from ...io.files import atomic_output, require_file, require_size
from ...runtime.limits import require_memory
from ..geometry import camera_of, require_light_field

# Bytes that reading takes for each of a file: the file, and the arrays of which a light field is made and checked.
_PER_BYTE = 3

# Files in which Zarr keeps shapes and attributes, and their bytes at most.
_ZARR_RECORDS = ("zarr.json", ".zgroup", ".zarray", ".zattrs", ".zmetadata")
_LARGEST_RECORD = 2**24


def write_labelled(path: str | Path, lf: xr.DataArray) -> None:
    """Write a light field whose file `read_labelled` or ``xarray.open_dataarray`` opens.

    Parameters
    ----------
    path : path
        A name that ends in ``.nc`` for NetCDF 3, or in ``.zarr`` for a folder of Zarr, which needs the package zarr.
    lf : xarray.DataArray
        The light field.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    path, lf = Path(path), require_light_field(lf)
    with atomic_output(path, ".nc", ".zarr") as temporary:
        if path.suffix.lower() == ".nc":
            lf.to_netcdf(temporary, engine="scipy")
        else:
            require_zarr(path)
            # The third format has no texts of fixed length yet, as the names of the channels are.
            lf.to_zarr(temporary, zarr_format=2)


def read_labelled(path: str | Path) -> xr.DataArray:
    """Read a light field that `write_labelled` wrote.

    NetCDF 4 is HDF5, whose files can link to others, and is not read here.

    Parameters
    ----------
    path : path
        The file.

    Raises
    ------
    InputError
        If there is none, or the file is damaged or something else.
    """
    path = Path(path)
    try:
        if path.suffix.lower() == ".nc":
            require_memory(_PER_BYTE * require_file(path).stat().st_size, f"{path}: a light field")
            with path.open("rb") as file:
                begins = file.read(3)
            refuse_if(
                begins != b"CDF",
                f"{path}: it is not NetCDF 3; open other formats with xarray and convert them in Python",
            )
            stored = xr.load_dataarray(path, engine="scipy")
        else:
            refuse_if(
                not (path / "zarr.json").is_file() and not (path / ".zgroup").is_file(),
                f"{path}: there is no such folder of Zarr",
            )
            require_zarr(path)
            _require_zarr_memory(path)
            stored = xr.load_dataarray(path, engine="zarr")
    except InputError:
        raise
    except Exception as error:
        # NetCDF, Zarr and xarray report damage by many types of exception; all mean the same to the user.
        raise InputError(f"{path}: it cannot be read as a light field: {error}") from None
    try:
        lf = require_light_field(stored)
        if lf.attrs.get("camera"):
            camera_of(lf)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return lf


def _require_zarr_memory(path: Path) -> None:
    """Refuse a folder whose arrays, or the chunks in which they are read, would not fit into memory."""
    import zarr

    for file in path.rglob("*"):
        if file.name in _ZARR_RECORDS:
            require_size(file, _LARGEST_RECORD)
    sizes = [
        array.dtype.itemsize * max(math.prod(array.shape), math.prod(array.chunks))
        for _, array in zarr.open_group(str(path), mode="r").arrays()
    ]
    require_memory(_PER_BYTE * float(sum(sizes)), f"{path}: a light field")


def require_zarr(path: Path) -> None:
    """Refuse a file of Zarr where the package is not installed."""
    try:
        import zarr  # noqa: F401
    except ImportError:
        raise InputError(f"{path}: Zarr needs a package: pip install zarr") from None
