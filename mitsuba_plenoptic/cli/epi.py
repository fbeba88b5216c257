"""``mitsuba-plenoptic epi``: from a capture to an epipolar image."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..io.files import require_apart
from ..lightfield import epipolar_image
from ..lightfield.exchange import open_light_field
from ..lightfield.views import AXES
from ..report.output_files import require_picture_path, write_epipolar_image
from .inputs import brightness_of, named_camera
from .options import CameraFile, Exposure, LightFieldSource, Linear, Percentile, ViewCount, White, number, output_option


def epi(
    source: LightFieldSource,
    output: Annotated[Path, output_option("FILE", "File to write: .exr, or .png four times as large.")],
    axis: Annotated[str, typer.Option(metavar="|".join(AXES), help="Direction of the line.")] = "horizontal",
    at: Annotated[
        float | None,
        number(
            "Place of the line in the object plane in focus: y (up) of a horizontal, x (left) of a vertical one.",
            "nearest to the axis",
            unit="MM",
        ),
    ] = None,
    through: Annotated[
        float | None,
        number(
            "Place on the pupil: y (up) of a horizontal, x (left) of a vertical line.",
            "nearest to the middle",
            unit="MM",
        ),
    ] = None,
    white: White = None,
    view_count: ViewCount = None,
    linear: Linear = False,
    camera: CameraFile = None,
    exposure: Exposure = None,
    percentile: Percentile = None,
) -> None:
    """Show one line of the scene from every view along the same direction.

    A point of the scene draws a line: upright in focus, slanted by its depth.

    [bold]Example:[/bold]

      mitsuba-plenoptic epi raw.exr -o epi.png --at 2.5
    """
    require_apart(require_picture_path(output), source, white)
    brightness = brightness_of(exposure, percentile, output)
    image = epipolar_image(
        open_light_field(source, white=white, views=view_count, linear=linear, camera=named_camera(camera)),
        axis,
        at=at,
        through=through,
    )
    write_epipolar_image(output, image, brightness)
    rows, columns = image.shape[:2]
    typer.echo(f"{output}: {rows} views of {columns} pixels")
