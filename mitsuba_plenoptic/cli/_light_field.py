"""What the commands on light fields share: their source and its options."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
import xarray as xr

from ..lightfield.exchange import open_light_field
from ._common import native_output_dropped

Source = Annotated[
    Path,
    typer.Argument(
        metavar="SOURCE",
        help="A capture (.exr), a light field of LFToolbox (.mat), a mosaic (.png with --view-count, .eslf.png for "
        "the samples of each lens together), or a raw picture of a real camera (.png with --white).",
    ),
]

White = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        show_default="computed from the camera",
        help="White image of the same camera, .exr or .png. Of a raw picture it tells where the micro-images are.",
    ),
]

ViewCount = Annotated[
    int | None,
    typer.Option(metavar="N", help="For a mosaic: how many views it has along each axis, 14 in Lytro's ESLF files."),
]

Linear = Annotated[
    bool,
    typer.Option("--linear", help="PNG files hold values proportional to light, as raw data does, instead of sRGB."),
]


def load_light_field(source: Path, white: Path | None, view_count: int | None, linear: bool) -> xr.DataArray:
    """Read or decode a light field without the remarks that OpenEXR itself prints about a damaged file.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    with native_output_dropped():
        return open_light_field(source, white=white, views=view_count, linear=linear)
