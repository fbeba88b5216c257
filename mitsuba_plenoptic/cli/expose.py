"""``mitsuba-plenoptic expose``: from a noise-free capture to what a real detector records."""

from __future__ import annotations

from typing import Annotated

import typer

from ..detector import Detector
from ..detector import expose as record
from ..io.captures import read_capture, write_capture
from ..io.files import require_apart, require_writable
from ..io.raw import RAW_SUFFIXES, write_raw
from ..mosaic import MOSAICS
from .options import CaptureFile, RawOutput, number


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
