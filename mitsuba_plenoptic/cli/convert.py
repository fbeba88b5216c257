"""``mitsuba-plenoptic convert``: light fields for and from other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..io.files import require_apart
from ..lightfield.exchange import open_light_field, require_light_field_path, save_light_field
from .inputs import named_camera
from .options import CameraFile, LightFieldSource, Linear, Truth, ViewCount, White, output_option


def convert(
    source: LightFieldSource,
    output: Annotated[
        Path,
        output_option(
            "FILE",
            "File to write: .nc or .zarr for NetCDF or Zarr, .mat for LFToolbox, .eslf.png for the samples of each "
            "lens together, .png for a 16-bit mosaic of views.",
        ),
    ],
    white: White = None,
    view_count: ViewCount = None,
    linear: Linear = False,
    camera: CameraFile = None,
    truth: Truth = None,
) -> None:
    """Decode a capture into a light field, or translate between formats of light fields.

    NetCDF and Zarr keep all about it, axes, weights and camera, for xarray and
    for the other commands.

    [bold]Examples:[/bold]

      mitsuba-plenoptic convert raw.exr -o lf.nc

      mitsuba-plenoptic convert raw.exr -o lf.mat

      mitsuba-plenoptic convert photo.png --white white.png -o lf.mat

      mitsuba-plenoptic convert lytro.eslf.png --view-count 14 -o lf.mat
    """
    require_light_field_path(output)
    require_apart(output, source, white, truth)
    lf = open_light_field(
        source, white=white, views=view_count, linear=linear, camera=named_camera(camera), truth=truth or True
    )
    save_light_field(output, lf)
    typer.echo(f"{output}: {lf.sizes['u']} x {lf.sizes['v']} views of {lf.sizes['s']} x {lf.sizes['t']} pixels")
