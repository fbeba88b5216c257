"""``mitsuba-plenoptic demosaic``: from a mosaic of colour filters to three channels."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..errors import InputError
from ..io.captures import write_capture
from ..io.files import require_apart, require_writable
from ..mosaic import MOSAICS
from .inputs import named_camera, read_recorded, require_linear
from .options import CameraFile, CaptureFile, CaptureOutput, Linear, number


def demosaic(
    capture: CaptureFile,
    output: CaptureOutput,
    mosaic: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(MOSAICS),
            show_default="as the capture tells",
            help="Colour filters of the first pixels of two rows.",
        ),
    ] = None,
    white: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            show_default="computed from the camera",
            help="A capture or picture of a white scene by the same camera, without a mosaic.",
        ),
    ] = None,
    camera: CameraFile = None,
    linear: Linear = False,
    black_level: Annotated[
        float, number("Number without light in a raw picture of 16 bits; needs --camera and --linear.")
    ] = 0,
) -> None:
    """Estimate all three colours of every pixel, micro-image by micro-image.

    Nothing is taken from a neighbouring lens's micro-image or from the dark
    between them. A raw picture (.png or .tiff) that 'expose' wrote tells all
    that is needed; one of a real camera needs its [bold]--camera[/bold].

    [bold]Examples:[/bold]

      mitsuba-plenoptic demosaic bayer.exr -o colours.exr

      mitsuba-plenoptic demosaic bayer.tiff -o colours.exr

      mitsuba-plenoptic demosaic raw.tiff -o colours.exr --mosaic GRBG --camera lytro --linear
    """
    require_writable(output, ".exr")
    require_apart(output, capture, white)
    # Brings libraries that take a while to load.
    from ..lightfield import demosaic as interpolate

    require_linear(linear, capture, white)
    known = named_camera(camera)
    if black_level and not (linear and known):
        raise InputError(f"--black-level {black_level:g}: it is for raw pictures with --linear and --camera")
    reference = None if white is None else read_recorded(white, known, linear)
    found = interpolate(read_recorded(capture, known, linear, black_level), mosaic=mosaic, white=reference)
    write_capture(output, found)
    typer.echo(f"{output}: {found.camera.shape[1]} x {found.camera.shape[0]} pixels of three colours")
