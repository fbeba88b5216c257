"""``mitsuba-plenoptic stack``: from a capture to a focal stack."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..io.files import require_apart
from ..lightfield import focal_stack
from ..lightfield.exchange import open_light_field
from ..lightfield.refocus import METHODS
from ..report.output_files import require_picture_path, write_stack
from ..runtime.progress import progress_bar
from .inputs import brightness_of, named_camera
from .options import (
    CameraFile,
    Distances,
    Exposure,
    LightFieldSource,
    Linear,
    Percentile,
    ViewCount,
    White,
    output_option,
)


def stack(
    source: LightFieldSource,
    output: Annotated[
        Path,
        output_option(
            "FILE",
            "File to write: OpenEXR with a part for each distance if it ends in .exr, pictures side by side if "
            "in .png.",
        ),
    ],
    distance: Distances,
    method: Annotated[
        str, typer.Option(metavar="|".join(METHODS), help="Shift views and add, or slice the spectrum.")
    ] = "shift",
    white: White = None,
    view_count: ViewCount = None,
    linear: Linear = False,
    camera: CameraFile = None,
    exposure: Exposure = None,
    percentile: Percentile = None,
) -> None:
    """Make a focal stack: one image for each distance, in focus there and blurred elsewhere.

    The capture is decoded into views, which are moved against each other and
    added. All images have the same size, one pixel per microlens.
    'reconstruct' refocuses the capture itself, by rays and by waves.

    [bold]Example:[/bold]

      mitsuba-plenoptic stack raw.exr -o stack.exr --distance 210 --distance 240 --distance 280
    """
    require_apart(require_picture_path(output), source, white)
    brightness = brightness_of(exposure, percentile, output)
    lf = open_light_field(source, white=white, views=view_count, linear=linear, camera=named_camera(camera))
    with progress_bar("Refocusing") as progress:
        images = focal_stack(lf, distance, method=method, progress=progress)
    write_stack(output, images, brightness)
    rows, columns = images.shape[1:3]
    typer.echo(f"{output}: {len(images)} images of {columns} x {rows} bins")
