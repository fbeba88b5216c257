"""``mitsuba-plenoptic epi``: from a capture to an epipolar image."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..lightfield import epipolar_image
from ..lightfield.views import AXES
from ..report.light_fields import require_picture_path, write_epipolar_image
from ._light_field import Linear, Source, ViewCount, White, load_light_field


def epi(
    source: Source,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE", help="File to write: .exr, or .png four times as large.")
    ],
    axis: Annotated[str, typer.Option(metavar="|".join(AXES), help="Direction of the line.")] = "horizontal",
    at: Annotated[
        float,
        typer.Option(
            metavar="MM",
            help="Place of the line in the object plane in focus: y (up) of a horizontal, x (left) of a vertical one.",
        ),
    ] = 0.0,
    through: Annotated[
        float,
        typer.Option(metavar="MM", help="Place on the pupil: y (up) of a horizontal, x (left) of a vertical line."),
    ] = 0.0,
    white: White = None,
    view_count: ViewCount = None,
    linear: Linear = False,
) -> None:
    """Show one line of the scene from every view along the same direction.

    A point of the scene draws a line: upright in focus, slanted by its depth.

    [bold]Example:[/bold]

      mitsuba-plenoptic epi raw.exr -o epi.png --at 2.5
    """
    require_picture_path(output)
    image = epipolar_image(load_light_field(source, white, view_count, linear), axis, at=at, through=through)
    write_epipolar_image(output, image)
    rows, columns = image.shape[:2]
    typer.echo(f"{output}: {rows} views of {columns} pixels")
