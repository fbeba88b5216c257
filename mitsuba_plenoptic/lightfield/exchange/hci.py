"""Folders of the 4D Light Field Benchmark (HCI) as light fields; `mitsuba_plenoptic.benchmark.exchange` writes them.

A folder has views ``input_Cam000.png`` and so on, row by row, and ``parameters.cfg``. What this package wrote has its
own section there, with the camera, the radiance of white, and the number of channels, as views are always in colour.
"""

from __future__ import annotations

import configparser
import json
from pathlib import Path

import numpy as np
import xarray as xr

from ...camera import PlenopticCamera
from ...errors import InputError, naming, refuse_if, refusing, require_count, require_number
from ...io.files import read_text
from ...runtime.limits import require_memory
from ..geometry import light_field
from ..grid import bin_grid
from .pictures import read_picture

PARAMETERS, SECTION = "parameters.cfg", "mitsuba_plenoptic"

_LARGEST, _MOST_VIEWS = 2**20, 1000

# Bytes of a value of three channels while views are gathered and checked.
_NUMBER_BYTES = 3 * (4 + 4)


def is_hci(path: Path) -> bool:
    """Return whether a path is a folder of the 4D Light Field Benchmark."""
    return (path / PARAMETERS).is_file()


def read_hci(folder: str | Path) -> xr.DataArray:
    """Read a light field from a folder of the 4D Light Field Benchmark.

    Parameters
    ----------
    folder : path
        A folder that ``convert --format hci`` or another program wrote.

    Returns
    -------
    xarray.DataArray
        With the camera, in units of its capture, if this package wrote the folder; else without, from 0 to 1.

    Raises
    ------
    InputError
        If a file is missing, damaged or too large, or the views differ in size.
    """
    folder = Path(folder)
    parser = configparser.ConfigParser(interpolation=None)
    text = read_text(folder / PARAMETERS, _LARGEST)
    with naming(folder / PARAMETERS), refusing("it cannot be read as the parameters of a light field:"):
        parser.read_string(text)
        columns, rows = (
            require_count(name, int(parser["extrinsics"][name]), maximum=_MOST_VIEWS)
            for name in ("num_cams_x", "num_cams_y")
        )
        ours = dict(parser[SECTION]) if parser.has_section(SECTION) else None
        camera = None if ours is None else PlenopticCamera.from_dict(json.loads(ours["camera"]))
        white = 1.0 if ours is None else require_number("white", float(ours["white"]), positive=True)
        grey = ours is not None and ours["channels"] == "1"
    views: list[np.ndarray] = []
    for number in range(rows * columns):
        path = folder / f"input_Cam{number:03d}.png"
        picture = read_picture(path)
        if not views:
            require_memory(float(_NUMBER_BYTES) * rows * columns * picture[..., :1].size, f"{folder}: a light field")
        refuse_if(
            bool(views) and picture.shape != views[0].shape,
            f"{path}: it has the shape {picture.shape}, the views before {views[0].shape if views else ()}",
        )
        views.append(picture)
    values = np.stack(views).reshape(rows, columns, *views[0].shape) * np.float32(white)
    values = np.ascontiguousarray(values[..., 0]) if grey and values.ndim == 5 else values
    bins = None if camera is None else bin_grid(camera)
    if bins is not None and bins.shape != values.shape[2:4]:
        raise InputError(
            f"{folder}: its views of {values.shape[2:4]} pixels do not fit its camera of {bins.shape} lenses"
        )
    return light_field(values, None, camera, bins)
