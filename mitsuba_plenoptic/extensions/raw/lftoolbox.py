"""Files of the Light Field Toolbox for MATLAB (LFToolbox) by D. G. Dansereau.

LFToolbox's light fields are MATLAB files with an array ``LF(j, i, l, k, c)``: row and column of the view, row and
column of the lens, and channel; a second or fourth channel holds weights. This package has the same order. The manual
of LFToolbox calls the first four axes t, s, v, u, with the letters of pupil and field exchanged.

``LensletGridModel`` describes the micro-image centres: spacings, the offset of the first centre, rotation, counts, and
``FirstPosShiftRow``, the first (1 or 2) of the rows shifted by half a spacing. It counts pixels from 1 and centres them
on integers; here pixel k covers [k, k + 1), so that offsets differ by a half.
"""

import json
import math
from pathlib import Path

import numpy as np
import scipy.io
import xarray as xr

from ...camera import PlenopticCamera
from ...errors import InputError, naming, refuse_if, refusing, require_choice, require_number
from ...runtime import Named, Sizes, atomic_output, h5py_module, require_file, require_memory, stored_array
from ...views import LensGrid, bin_grid, grid_of, light_field, open_fraction, require_light_field, warn_of_dark

# What is read of a lens grid.
_MODEL = ("HSpacing", "VSpacing", "HOffset", "VOffset", "Rot", "UMax", "VMax", "FirstPosShiftRow", "Orientation")

# Bytes of one variable, at most, in MATLAB's files of version 5.
_MAX_BYTES = 2**31 - 1

_TYPES = {"uint8": np.uint8, "uint16": np.uint16, "single": np.float32}


def write_lftoolbox(path: str | Path, lf: xr.DataArray, *, precision: str = "uint16") -> None:
    """Write a light field in LFToolbox's format, with its weights as the last channel, and its white as ``White``.

    Integers are scaled so that the largest value is full scale; the variable ``MaxLum`` keeps the largest value, as in
    LFToolbox. The variable ``Camera`` (a JSON text) keeps the camera, which LFToolbox does not read.

    Parameters
    ----------
    path : path
        File to write, in MATLAB's version 5 format.
    lf : xarray.DataArray
        The light field.
    precision : {"uint8", "uint16", "single"}
        MATLAB type of the values.
    """
    lf = require_light_field(lf)
    require_choice("precision", precision, _TYPES)
    values = lf.values
    if values.ndim == 4:
        values = values[..., None]
    kind = np.dtype(_TYPES[precision])
    size = values[..., 0].size * (values.shape[4] + 1) * kind.itemsize
    refuse_if(
        size > _MAX_BYTES,
        f"{path}: a light field of shape {lf.shape} takes {size} bytes; the format holds {_MAX_BYTES}",
    )
    peak = float(values.max(initial=0)) or 1.0
    if kind.kind == "f":
        peak = 1.0
    stored = np.concatenate([values / np.float32(peak), lf["weight"].values[..., None]], axis=4)
    if kind.kind == "u":
        warn_of_dark(path, values)
        stored = np.round(np.clip(stored, 0, 1) * (2 ** (8 * kind.itemsize) - 1))
    variables: Named = {"LF": stored.astype(kind), "MaxLum": peak}
    if (grid := grid_of(lf)) is not None:
        refuse_if(bool(grid.warp), "camera: a lenslet grid model has no mla_warp and no mla_tilt; leave them out")
        rows, columns = grid.shape
        variables["LensletGridModel"] = {
            "HSpacing": grid.spacing[0],
            "VSpacing": grid.spacing[1],
            "HOffset": grid.offset[0] + 0.5,
            "VOffset": grid.offset[1] + 0.5,
            "Rot": grid.rotation,
            "UMax": float(columns),
            "VMax": float(rows),
            # Beyond the last row: no row is shifted.
            "FirstPosShiftRow": float(rows + 1 if grid.shifted_rows is None else grid.shifted_rows + 1),
            "Orientation": "horz",
        }
    if "camera" in lf.attrs:
        variables["Camera"] = lf.attrs["camera"]
    if "white" in lf.coords:
        variables["White"] = np.asarray(lf["white"].values, np.float32)
    variables["GeneratedByInfo"] = {"mfilename": "mitsuba_plenoptic"}
    with atomic_output(path, ".mat") as temporary, temporary.open("wb") as file:
        scipy.io.savemat(file, variables, do_compression=True)


def read_lftoolbox(path: str | Path) -> xr.DataArray:
    """Read a light field that LFToolbox or `write_lftoolbox` wrote.

    Parameters
    ----------
    path : path
        A MATLAB file; version 7.3, which LFToolbox writes, needs the package h5py.

    Returns
    -------
    xarray.DataArray
        Integers are scaled to 0 to 1 and by ``MaxLum``. The weights of LFToolbox are how bright its white was, and
        become the coordinate `white`, from which `weight` is found. Without them, views that are black throughout have
        none. The coordinates are physical if the file holds the camera.
    """
    path = require_file(path)
    with path.open("rb") as file:
        is_hdf5 = b"MATLAB 7.3" in file.read(128)
    # Damage shows as many exception types; all mean the same to the user.
    with naming(path), refusing("it cannot be read as a light field:"):
        variables = _read_hdf5(path) if is_hdf5 else _read_version_5(path)
        stored = variables["LF"]
        if stored.ndim == 4:
            # MATLAB drops a last dimension of 1.
            stored = stored[..., None]
        values = stored.astype(np.float32)
        if stored.dtype.kind == "u":
            values /= np.iinfo(stored.dtype).max
        weight = white = None
        if values.shape[4] in (2, 4):
            values, weight = values[..., :-1], np.ascontiguousarray(values[..., -1])
            white = variables.get("White", weight).reshape(weight.shape)
            if "White" not in variables:
                weight = open_fraction(white.transpose(2, 3, 0, 1)).transpose(2, 3, 0, 1)
        values = values * np.float32(require_number("MaxLum", variables.get("MaxLum", 1.0), positive=True))
        values = np.ascontiguousarray(values if values.shape[4] == 3 else values[..., 0])
        model = variables.get("LensletGridModel")
        text = variables.get("Camera")
        lenses = None if model is None else grid_of_model(model)
        camera = None if text is None else PlenopticCamera.from_dict(json.loads(text))
        bins = None if camera is None else bin_grid(camera)
        if bins is not None and bins.shape != values.shape[2:4]:
            raise InputError(f"its light field of shape {values.shape} does not fit its camera of {bins.shape} lenses")
        return light_field(values, weight, camera, bins, lenses, white)


def _check(shape: Sizes) -> None:
    refuse_if(
        len(shape) not in (4, 5) or (len(shape) == 5 and shape[4] not in (1, 2, 3, 4)) or min(shape) < 1,
        f"LF has the shape {shape}: it must be (t, s, v, u, c) with 1 to 4 channels",
    )
    # Bytes of a value of a light field while it is read: as stored (at most 8), and twice in single precision.
    require_memory(16.0 * float(np.prod(shape, dtype=np.float64)), f"LF has the shape {shape}")


def _read_version_5(path: Path) -> Named:
    variables = scipy.io.whosmat(path)
    for name, shape, kind in variables:
        if name in ("LF", "White"):
            integers = (f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))
            refuse_if(kind not in ("double", "single", *integers), "LF is not an array of numbers")
            _check(shape)
    # One number, one structure, or one line of text.
    small = [
        name
        for name, shape, _ in variables
        if name in ("LensletGridModel", "Camera", "MaxLum")
        if math.prod(shape) == 1
    ]
    content = scipy.io.loadmat(path, variable_names=["LF", "White", *small], simplify_cells=True)
    refuse_if("LF" not in content, "it has no variable LF")
    refuse_if(content["LF"].dtype.kind not in "fiu", "LF is not an array of numbers")
    return content


def _read_hdf5(path: Path) -> Named:
    h5py = h5py_module("a MATLAB 7.3 file (one saved with '-v7' does not)")
    with h5py.File(path, "r") as file:
        stored = stored_array(file, "LF")
        refuse_if(stored is None, "it has no variable LF")
        # HDF5 lists MATLAB's dimensions in the opposite order.
        _check(stored.shape[::-1])
        variables: Named = {"LF": np.transpose(stored[()])}
        largest = stored_array(file, "MaxLum")
        if largest is not None:
            variables["MaxLum"] = float(largest[0, 0])
        if "LensletGridModel" in file:
            model = variables["LensletGridModel"] = {}
            for name in _MODEL:
                entry = stored_array(file["LensletGridModel"], name)
                if entry is not None and entry.size <= 16:
                    values = entry[()].ravel()
                    model[name] = "".join(map(chr, values)) if name == "Orientation" else float(values[0])
    return variables


def grid_of_model(model: Named) -> LensGrid | None:
    """Return the grid of a lenslet grid model, None if the model describes the transposed image."""
    if str(model.get("Orientation", "horz")).lower() != "horz":
        return None
    rows = int(model["VMax"])
    first = int(model["FirstPosShiftRow"])
    return LensGrid(
        spacing=(float(model["HSpacing"]), float(model["VSpacing"])),
        offset=(float(model["HOffset"]) - 0.5, float(model["VOffset"]) - 0.5),
        shape=(rows, int(model["UMax"])),
        rotation=float(model["Rot"]),
        shifted_rows=None if first > rows else (first - 1) % 2,
    )
