"""The command ``dual``: pictures of the photodiodes of dual and quad pixels."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from ... import choices
from ...cli import inputs, options


def dual(
    capture: options.CaptureFile,
    *,
    output: Annotated[Path, options.ends_in(*choices.PICTURES)],
    layout: Literal["2x1", "1x2", "2x2"] = "2x1",
    picture: options.Picture,
) -> None:
    """Show the pictures of dual or quad pixels, one for each photodiode of a lens.

    The camera's microlenses must cover 2 x 2 pixels each, as in the presets full_frame_dual, phone_quad and
    phone_quad_bayer. Objects nearer than the plane in focus lie further to the right in the left picture.

    Parameters
    ----------
    output : FILE
        File to write: OpenEXR with the parts left, right and sum (or top and bottom, or four) if it ends in .exr, the
        pictures side by side if in .png, a labelled figure if in .pdf.
    layout
        Photodiodes of a lens: beside each other, above, or four.

    Examples
    --------
    $ mitsuba-plenoptic dual raw.exr -o halves.exr
    $ mitsuba-plenoptic dual raw.exr -o quarters.png --layout 2x2
    """
    import numpy as np

    from ...io import read_capture
    from ...report import as_parts, plots, write_drawn
    from ...runtime import require_output
    from ...views import view_mosaic
    from .halves import dual_pixel, photodiode_names

    require_output(output, capture)
    drawing = inputs.drawing_of(picture, output)
    along, across = layout.split("x")
    halves = dual_pixel(read_capture(capture), (int(along), int(across)))
    white = drawing.brightness.peak([halves.values])
    pictures = {name: halves.values[j, i] for (j, i), name in np.ndenumerate(photodiode_names(halves))}
    parts = as_parts(**pictures, sum=halves.sum(("v", "u")).values)
    write_drawn(
        output,
        "photodiodes",
        halves,
        parts,
        view_mosaic(halves),
        white,
        drawing,
        lambda: plots.views_figure(halves, white),
    )
    views, lenses = (f"{halves.sizes[x]} x {halves.sizes[y]}" for x, y in (("u", "v"), ("s", "t")))
    typer.echo(f"{output}: {views} pictures of {lenses} lenses")
