"""``mitsuba-plenoptic reconstruct``: from a capture to refocused images."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from .. import reconstruction
from ..io.captures import read_capture
from ..report.output_files import reconstruction_paths, write_reconstructions
from ..runtime.progress import progress_bar
from ..runtime.variant import set_variant
from .options import CaptureFile, Distances, Variant, number, output_option


def reconstruct(
    capture: CaptureFile,
    output: Annotated[
        Path,
        output_option(
            "FILE",
            "File to write: float32 OpenEXR if it ends in .exr, an 8-bit picture if in .png. With "
            "several distances each goes into a file of its own: out.exr becomes out_210.exr and so on.",
        ),
    ],
    distance: Distances,
    method: Annotated[
        str,
        typer.Option(
            metavar="|".join(reconstruction.METHODS),
            help="How light is followed back: by rays, as one coherent wave, or as one wave for each interleaved "
            "subset of lenses.",
        ),
    ] = "ray",
    footprint: Annotated[
        str,
        typer.Option(
            metavar="|".join(reconstruction.FOOTPRINTS),
            help="For rays: spread a pixel over what its lens sees, or put it into one bin.",
        ),
    ] = "lens",
    interleave: Annotated[
        str,
        typer.Option(
            metavar="K|auto",
            help="For partial: every K-th lens along both axes shares a wave; auto lets no two lenses interfere.",
        ),
    ] = "2",
    wavelength: Annotated[
        float | None, number("For waves: wavelength in nanometres.", "the capture's", unit="NM")
    ] = None,
    relay: Annotated[
        bool,
        typer.Option(
            "--relay/--no-relay", help="For waves: whether the microlenses act again on the way back, as they should."
        ),
    ] = True,
    oversample: Annotated[int, number("Bins per microlens along each axis; info tells what suits.")] = 1,
    white: Annotated[
        Path | None,
        typer.Option(
            metavar="WHITE.exr",
            show_default="computed from the camera",
            help="A capture of a white scene by the same camera; the result is divided by it.",
        ),
    ] = None,
    variant: Variant = None,
) -> None:
    """Refocus a capture to one or several distances.

    A reconstruction has one bin per microlens, unless told otherwise, and the
    orientation of an ordinary photograph. The distance may be inf. Pictures of one run share one scale,
    so that their brightness compares. Bins that no light can reach, at the
    borders of a crop, are NaN in OpenEXR and black in a picture.

    [bold]Examples:[/bold]

      mitsuba-plenoptic reconstruct raw.exr -o out.png --distance 240

      mitsuba-plenoptic reconstruct raw.exr -o out.exr --distance 210 --distance 240

      mitsuba-plenoptic reconstruct raw.exr -o out.png --method partial --distance 280

      mitsuba-plenoptic reconstruct raw.exr -o far.png --distance inf --white white.exr
    """
    paths = reconstruction_paths(output, distance)
    recorded = read_capture(capture)
    reference = None if white is None else read_capture(white)
    set_variant(variant)
    with progress_bar("Refocusing") as progress:
        results = reconstruction.reconstruct(
            recorded,
            distance,
            method=method,
            wavelength=wavelength,
            interleave=int(interleave) if interleave.isdecimal() and len(interleave) < 10 else interleave,
            footprint=footprint,
            relay=relay,
            oversample=oversample,
            white=reference,
            progress=progress,
        )
    write_reconstructions(paths, results, recorded.metadata)
    for path, result in zip(paths, results, strict=True):
        rows, columns = result.image.shape[:2]
        where = "rad at infinity" if math.isinf(result.distance) else f"mm at {result.distance:g} mm"
        typer.echo(f"{path}: {columns} x {rows} bins of {result.bin_size:.4g} {where}")
