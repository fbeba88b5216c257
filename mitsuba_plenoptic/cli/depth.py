"""``mitsuba-plenoptic depth``: from a capture to a depth map."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Annotated

import typer

from ..io.files import require_apart
from ..lightfield import depth_error, depth_map
from ..lightfield.depth import is_focused
from ..lightfield.exchange import open_light_field, open_micro_images
from ..report.output_files import require_picture_path, write_depth
from ..runtime.progress import progress_bar
from .inputs import brightness_of, named_camera
from .options import (
    CameraFile,
    Exposure,
    LightFieldSource,
    Linear,
    Percentile,
    Truth,
    ViewCount,
    White,
    number,
    output_option,
)

_LITTLE = 0.1
"""Fraction of the bins with a confidence above half, below which a user is warned."""


def depth(
    source: LightFieldSource,
    output: Annotated[
        Path,
        output_option(
            "FILE",
            "File to write: OpenEXR with the parts depth, disparity, confidence and image if it ends in .exr; "
            "if in .png pictures of the all-in-focus image, the depth (near is white) and the confidence.",
        ),
    ],
    near: Annotated[
        float | None, number("Nearest distance to search.", "as near as the capture shows depth", unit="MM")
    ] = None,
    far: Annotated[
        float | None, number("Farthest distance to search.", "as far as the capture shows depth", unit="MM")
    ] = None,
    planes: Annotated[int | None, number("Number of distances to try.", "64, more for a wide search")] = None,
    white: White = None,
    view_count: ViewCount = None,
    linear: Linear = False,
    camera: CameraFile = None,
    truth: Truth = None,
    exposure: Exposure = None,
    percentile: Percentile = None,
) -> None:
    """Estimate depth, and an image in focus everywhere, from how well the views agree.

    Depth is measured from the main lens along the axis. The confidence is an
    estimate of the probability that it is within 1 %; below half the depth is
    unknown. It is 0 where the views agree best at an end of the search. Where
    ground truth is known, the depth's error is printed.

    [bold]Example:[/bold]

      mitsuba-plenoptic depth raw.exr -o depth.exr --near 195 --far 310
    """
    require_apart(require_picture_path(output), source, white, truth)
    brightness = brightness_of(exposure, percentile, output)
    known = named_camera(camera)
    lf = open_light_field(source, white=white, views=view_count, linear=linear, camera=known, truth=truth or True)
    images = None
    if lf.attrs.get("camera") and is_focused(lf):
        images = open_micro_images(source, white=white, linear=linear, camera=known)
    with progress_bar("Comparing views") as progress:
        found = depth_map(lf, near, far, micro_images=images, planes=planes, progress=progress)
    write_depth(output, found, brightness)
    sure = found.confidence > 0.5
    where = found.depth.where(sure)
    fraction = f"{100 * float(sure.mean()):.0f} % of the bins with a confidence above half"
    if float(sure.mean()) < _LITTLE:
        warnings.warn(
            "depth: hardly any bin tells it: the scene has too little texture, or is nearer than --near or farther "
            "than --far; look at the confidence before you use a depth",
            stacklevel=2,
        )
    span = f", from {float(where.min()):.4g} to {float(where.max()):.4g} mm" if bool(sure.any()) else ""
    typer.echo(f"{output}: {fraction}{span}")
    if "truth" in found and (error := depth_error(found)).share:
        typer.echo(
            f"error there against ground truth: median {error.median:.2%} of the distance, 90th percentile "
            f"{error.percentile_90:.2%}"
        )
