"""``mitsuba-plenoptic views``: from a capture to its sub-aperture views."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..io.files import require_apart
from ..lightfield import pick_views
from ..lightfield.exchange import open_light_field
from ..report.output_files import require_picture_path, write_views
from . import options
from .inputs import brightness_of, named_camera


def views(
    source: options.LightFieldSource,
    output: Annotated[
        Path,
        options.output_option(
            "FILE", "File to write: OpenEXR with a part for each view if it ends in .exr, a mosaic if in .png."
        ),
    ],
    count: Annotated[int | None, options.number("Write N x N views, evenly spread over the pupil.", "all")] = None,
    white: options.White = None,
    view_count: options.ViewCount = None,
    linear: options.Linear = False,
    camera: options.CameraFile = None,
    truth: options.Truth = None,
    exposure: options.Exposure = None,
    percentile: options.Percentile = None,
) -> None:
    """Show the scene from many places on the main lens.

    Each view is an image with one pixel a lens, as a camera with a small
    aperture at that place would take it. The mosaic shows the views as they
    lie on the pupil, the upper left first, seen from behind the camera.

    [bold]Examples:[/bold]

      mitsuba-plenoptic views raw.exr -o views.png --count 5

      mitsuba-plenoptic views raw.exr -o centre.png --count 1
    """
    require_apart(require_picture_path(output), source, white, truth)
    brightness = brightness_of(exposure, percentile, output)
    lf = open_light_field(
        source, white=white, views=view_count, linear=linear, camera=named_camera(camera), truth=truth or True
    )
    if count is not None:
        lf = pick_views(lf, count)
    write_views(output, lf, brightness)
    typer.echo(f"{output}: {lf.sizes['u']} x {lf.sizes['v']} views of {lf.sizes['s']} x {lf.sizes['t']} pixels")
