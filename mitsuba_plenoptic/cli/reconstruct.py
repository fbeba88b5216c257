"""``mitsuba-plenoptic reconstruct``: from a capture to refocused images."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from .. import reconstruction
from ..report.brightness import Brightness
from ..report.output_files import reconstruction_paths, write_reconstructions
from ..runtime.progress import progress_bar
from ..runtime.variant import set_variant
from .inputs import named_camera, read_recorded
from .options import CameraFile, CaptureFile, Distances, Exposure, Linear, Percentile, Variant, number, output_option


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
            "subset of lenses; or deconvolved, by what this camera makes of each bin's light.",
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
    camera: CameraFile = None,
    linear: Linear = False,
    oversample: Annotated[int, number("Bins per microlens along each axis; info tells what suits.")] = 1,
    white: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            show_default="computed from the camera",
            help="A capture or picture of a white scene by the same camera; the result is divided by it.",
        ),
    ] = None,
    response: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(reconstruction.RESPONSES),
            show_default="as the capture was made",
            help="For deconvolved: how light goes through the camera.",
        ),
    ] = None,
    iterations: Annotated[
        int | None,
        number("For deconvolved: steps.", "until only noise is left, where a capture tells its exposure; else 30"),
    ] = None,
    accelerate: Annotated[
        bool,
        typer.Option(
            "--accelerate/--no-accelerate", help="For deconvolved: whether each step starts from an extrapolated point."
        ),
    ] = True,
    photons: Annotated[
        float | None,
        number("For deconvolved: photons that a pixel of value 1 has counted.", "what 'expose' has kept"),
    ] = None,
    volume: Annotated[
        bool,
        typer.Option("--volume", help="For deconvolved: all distances together explain the capture, not each alone."),
    ] = False,
    exposure: Exposure = None,
    percentile: Percentile = None,
    variant: Variant = None,
) -> None:
    """Refocus a capture to one or several distances.

    A reconstruction has one bin per microlens, unless told otherwise, and the
    orientation of an ordinary photograph. The distance may be inf. Pictures of one run share one scale,
    so that their brightness compares. Bins that no light can reach, at the
    borders of a crop, are NaN in OpenEXR and black in a picture. A raw picture
    (.png or .tiff) of a real camera needs its [bold]--camera[/bold].

    [bold]Examples:[/bold]

      mitsuba-plenoptic reconstruct raw.exr -o out.png --distance 240

      mitsuba-plenoptic reconstruct raw.exr -o out.exr --distance 210 --distance 240

      mitsuba-plenoptic reconstruct raw.exr -o out.png --method partial --distance 280

      mitsuba-plenoptic reconstruct raw.exr -o far.png --distance inf --white white.exr

      mitsuba-plenoptic reconstruct raw.exr -o fine.exr --method deconvolved --oversample 4 --distance 280

      mitsuba-plenoptic reconstruct raw.tiff -o out.png --distance 600 --camera camera.json --linear
    """
    paths = reconstruction_paths(output, distance)
    brightness = Brightness(exposure, percentile)
    known = named_camera(camera)
    recorded = read_recorded(capture, known, linear)
    reference = None if white is None else read_recorded(white, known, linear)
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
            response=response,
            iterations=iterations,
            accelerate=accelerate,
            photons=photons,
            volume=volume,
            progress=progress,
        )
    write_reconstructions(paths, results, recorded.metadata, brightness)
    for path, result in zip(paths, results, strict=True):
        rows, columns = result.image.shape[:2]
        where = "rad at infinity" if math.isinf(result.distance) else f"mm at {result.distance:g} mm"
        typer.echo(f"{path}: {columns} x {rows} bins of {result.bin_size:.4g} {where}{_told(result.facts)}")


def _told(facts: dict[str, Any]) -> str:
    """Say what a deconvolution tells of itself."""
    if not facts:
        return ""
    ended = "stopped by the noise" if facts["stopped_by_noise"] else "as many as were to be made"
    near = "; in focus, where finer bins tell little more" if facts["in_focus"] else ""
    return (
        f"; {facts['iterations']} iterations, {ended}, {facts['residual']:.2%} of the capture left; resolution limit "
        f"{facts['resolution_limit']:.3g} line pairs/mm{near}"
    )
