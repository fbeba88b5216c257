"""``mitsuba-plenoptic expose`` and ``demosaic``: what a real detector records, and colours from its mosaic."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..detector import MOSAICS, Detector
from ..detector import expose as record
from ..errors import InputError
from ..io.captures import read_capture, write_capture
from ..io.files import require_apart, require_writable
from ..io.raw import RAW_SUFFIXES, write_raw
from .inputs import (
    CameraFile,
    CaptureFile,
    CaptureOutput,
    Linear,
    RawOutput,
    named_camera,
    number,
    read_recorded,
    require_linear,
)


def expose(
    capture: CaptureFile,
    output: RawOutput,
    photons: Annotated[float, number("Photons that hit a pixel of value 1 during the exposure.")],
    quantum_efficiency: Annotated[
        float, number("Electrons per photon, up to 1.", unit="FRACTION")
    ] = Detector.quantum_efficiency,
    full_well: Annotated[float, number("Electrons at which a pixel saturates.")] = Detector.full_well,
    dark_electrons: Annotated[float, number("Mean electrons without light.")] = Detector.dark_electrons,
    read_noise: Annotated[float, number("Standard deviation of the reading, in electrons.")] = Detector.read_noise,
    bits: Annotated[int, number("Bits of a digital number, up to 16.")] = Detector.bits,
    gain: Annotated[
        float | None, number("Numbers per electron.", "the full well is the largest number", unit="K")
    ] = None,
    black_level: Annotated[
        int | None, number("Number without any electron.", "four deviations of the dark noise")
    ] = None,
    mosaic: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(MOSAICS),
            show_default="none",
            help="Colour filters of the first pixels of two rows; each pixel then records one of three channels.",
        ),
    ] = None,
    seed: Annotated[int, number("Seed of the noise.")] = 0,
) -> None:
    """Add what a real detector does: photon and read noise, saturation, digital numbers.

    The sensor is linear after EMVA Standard 1288. The result is a capture in
    the units of the first, so that every command takes it. A name that ends
    in .png or .tiff keeps the digital numbers instead, in 16 bits, for other
    programs and for 'demosaic'.

    [bold]Examples:[/bold]

      mitsuba-plenoptic expose raw.exr -o noisy.exr --photons 2000

      mitsuba-plenoptic expose colours.exr -o bayer.exr --photons 2000 --mosaic RGGB

      mitsuba-plenoptic expose colours.exr -o bayer.tiff --photons 2000 --mosaic RGGB
    """
    require_writable(output, ".exr", *RAW_SUFFIXES)
    require_apart(output, capture)
    detector = Detector(
        quantum_efficiency=quantum_efficiency,
        full_well=full_well,
        dark_electrons=dark_electrons,
        read_noise=read_noise,
        bits=bits,
        gain=gain,
        black_level=black_level,
        mosaic=mosaic,
    )
    exposed = record(read_capture(capture), detector, photons=photons, seed=seed)
    (write_raw if output.suffix.lower() in RAW_SUFFIXES else write_capture)(output, exposed)
    electrons = detector.quantum_efficiency * photons
    saturated, rows, columns = exposed.metadata["exposure"]["saturated_pixels"], *exposed.image.shape[:2]
    typer.echo(
        f"{output}: {electrons:.4g} electrons in a pixel of value 1; a full well is {full_well:g}; "
        f"{saturated} pixels ({saturated / (rows * columns):.2%}) are saturated"
    )


def demosaic(
    capture: CaptureFile,
    output: CaptureOutput,
    mosaic: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(MOSAICS),
            show_default="as the capture states",
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
    between them. A raw picture (.png or .tiff) that 'expose' wrote holds all
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
