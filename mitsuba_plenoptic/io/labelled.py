"""Labelled arrays in NetCDF 3 and Zarr, with a digest of all values, names and attributes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import naming, refuse_if, refusing
from ..runtime import Array, Named, atomic_output, of_one_file, require_file, require_memory, require_zarr
from .versions import DIGEST, digest_of, require_seal

if TYPE_CHECKING:
    import xarray as xr

# Bytes that reading takes for each of a file: the file, and the arrays that are made of it and checked.
_PER_BYTE = 3


def write_labelled_data(path: str | Path, data: xr.Dataset) -> None:
    """Write a data set as NetCDF 3, or as Zarr to a folder whose name ends in ``.zarr``, with its digest."""
    path = Path(path)
    stamped = data.assign_attrs({DIGEST: digest_of(*_content(data))})
    with atomic_output(path, ".nc", ".zarr") as temporary:
        if path.suffix.lower() == ".nc":
            stamped.to_netcdf(temporary, engine="scipy")
        else:
            require_zarr(path)
            # The third format has no texts of fixed length yet, as the names of the channels are.
            stamped.to_zarr(temporary, zarr_format=2)


@of_one_file
def read_labelled_data(path: str | Path, what: str = "data set") -> xr.Dataset:
    """Return the data set in a NetCDF 3 file or a Zarr folder, after a check of the digest that it states.

    Light fields, volumes and particles are written so. Files without a digest are read.

    Parameters
    ----------
    path : path
        The file or folder.
    what : str
        Word for the content in messages.

    Returns
    -------
    xarray.Dataset
    """
    # It takes half a second to load.
    import xarray as xr

    path = Path(path)
    with refusing(f"{path}: it cannot be read as a {what}:"):
        if path.suffix.lower() == ".nc":
            require_memory(_PER_BYTE * require_file(path).stat().st_size, f"{path}: a {what}")
            with path.open("rb") as file:
                begins = file.read(3)
            refuse_if(
                begins != b"CDF",
                f"{path}: it is not NetCDF 3; open other formats with xarray and convert them in Python",
            )
            data = xr.load_dataset(path, engine="scipy")
        else:
            refuse_if(
                not (path / "zarr.json").is_file() and not (path / ".zgroup").is_file(),
                f"{path}: {'it is no' if path.exists() else 'there is no such'} folder of Zarr, and no .nc file",
            )
            require_zarr(path)
            # Without values so far.
            data = xr.open_dataset(path, engine="zarr")
            require_memory(_PER_BYTE * float(data.nbytes), f"{path}: a {what}")
            data.load()
        with naming(path):
            stated = data.attrs.pop(DIGEST, None)
            record, values = _content(data)
            require_seal({**record, DIGEST: stated}, values)
    return data


def _content(data: xr.Dataset) -> tuple[Named, list[dict[str, Array]]]:
    """Return the names and attributes of a data set, and its values, which do not depend on the format of a file."""
    record: Named = {"": _texts(data.attrs)}
    values = {}
    for name, variable in data.variables.items():
        record[str(name)] = [list(map(str, variable.dims)), name in data.coords, _texts(variable.attrs)]
        stored = variable.values
        if stored.dtype.kind in "iub":
            stored = stored.astype(np.int64)
        elif stored.dtype.kind == "f":
            stored = stored.astype(stored.dtype.newbyteorder("="))
        else:
            stored = np.frombuffer("\0".join(map(str, stored.ravel().tolist())).encode(), np.uint8)
        values[str(name)] = stored
    return record, [values]


def _texts(attributes: dict) -> dict[str, str]:
    """Return attributes as texts, since files make arrays of lists, and single numbers of arrays of one."""
    return {str(name): json.dumps(np.ravel(value).tolist()) for name, value in attributes.items()}
